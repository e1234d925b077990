"""Settings of the physics engines, and of the contact of a foot with the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, ValidationError

from go1exp.config.schema.registry import Strict, as_json, one_of
from go1exp.config.schema.settings import adapter

Threads = Annotated[int, Field(ge=0, le=1024)]
"""Of the physics or of torch; 0 takes all cores."""

PhysicsStep = Annotated[float, Field(ge=1e-5, le=0.02)]
"""A physics step, s."""

RecordedStep = Annotated[float, Field(ge=1e-5, le=0.002)]
"""A physics step of a robot that is recorded, s."""


class Engine(Strict):
    """What the settings of every engine tell."""

    @property
    def on_gpu(self) -> bool:
        """Whether its tensors are on a GPU."""
        return False

    @property
    def captures(self) -> bool:
        """Whether work on its tensors is recorded once and replayed."""
        return False

    def as_reference(self) -> CpuBackend:
        """Return the settings of the engine that policies are evaluated on, wherever they were trained: MuJoCo's."""
        return CpuBackend("cpu", threads=0)


def fitting_step(policy_dt: float, physics_dt: float) -> float:
    """Return the largest physics step, at most ``physics_dt``, of which the policy's period is a whole multiple, s."""
    return policy_dt / math.ceil(policy_dt / physics_dt - 1e-6)


@dataclass(frozen=True)
class CpuBackend(Engine):
    """MuJoCo's batch on a thread pool.

    Attributes:
        name: ``cpu``.
        threads: threads of the physics; 0 takes all cores.
    """

    name: Literal["cpu"]
    threads: Threads

    def as_reference(self) -> CpuBackend:
        """Return these settings, with their threads."""
        return self


@dataclass(frozen=True)
class WarpBackend(Engine):
    """MuJoCo Warp on one GPU.

    Attributes:
        name: ``warp``.
        device: ``cuda``, one of several as ``cuda:1``, or ``cpu``, slow, to look for faults.
        graph: run the whole policy step as one CUDA graph.
        nconmax: contacts and near pairs of shapes per environment, on average over the batch. Over a height field every
            shape of the robot is near it: 26 pairs.
        njmax: constraint rows of one environment: 4 for each contact, one for each joint at its stop or with dry
            friction.
    """

    name: Literal["warp"]
    device: Annotated[str, one_of(r"cpu|cuda(:\d+)?", "cpu, cuda, or one of several as cuda:1")]
    graph: bool
    nconmax: Annotated[int, Field(ge=32, le=1000)]
    njmax: Annotated[int, Field(ge=64, le=2000)]

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.graph and self.device == "cpu":
            raise ValueError("graph = True: a CUDA graph needs a CUDA device; use graph=false with device=cpu")

    @property
    def on_gpu(self) -> bool:
        """Whether the device is a GPU."""
        return self.device != "cpu"

    @property
    def captures(self) -> bool:
        """Whether a CUDA graph is used."""
        return self.graph


@dataclass(frozen=True)
class PhysxBackend(Engine):
    """PhysX 5 on the processor, in single precision: for evaluating policies trained with MuJoCo, not for training.

    Attributes:
        name: ``physx``.
        threads: threads of the physics; 0 takes all cores. Robots are solved one by one: the same bits at any number.
        solver: ``tgs``, which divides a step by its iterations, or ``pgs``, which repeats the whole step.
        position_iterations: iterations of the solver in a physics step.
        velocity_iterations: iterations after those, for velocities alone.
        contact_offset: distance at which shapes are looked at for a contact, m; they touch at 0.
    """

    name: Literal["physx"]
    threads: Threads
    solver: Literal["tgs", "pgs"]
    position_iterations: Annotated[int, Field(ge=1, le=255)]
    velocity_iterations: Annotated[int, Field(ge=0, le=255)]
    contact_offset: Annotated[float, Field(gt=0, le=0.1)]


BackendConfig = CpuBackend | WarpBackend | PhysxBackend

BACKENDS: dict[str, type] = {"cpu": CpuBackend, "warp": WarpBackend, "physx": PhysxBackend}
"""By their names, which are also the choices of the group ``backend``."""


@dataclass(frozen=True)
class ContactConfig(Strict):
    """Contact of the feet with the ground (docs/contact.md).

    Attributes:
        time_constant: of the spring-damper under each foot, s: a foot sinks as its square. At least two physics steps.
        cone: friction cone: ``elliptic``, the same in every direction, or ``pyramidal``, weaker by 0.71 on diagonals.
        impratio: how much harder friction is than the normal force; more means less creep of a loaded foot.
    """

    time_constant: Annotated[float, Field(ge=0.002, le=0.1)]
    cone: Literal["pyramidal", "elliptic"]
    impratio: Annotated[float, Field(ge=1, le=100)]


MUJOCO_CONTACT = ContactConfig(time_constant=0.02, cone="pyramidal", impratio=1.0)
"""MuJoCo's own: a mattress. Runs of go1exp 0.1 were trained on it."""


def read_contact(given: object) -> ContactConfig | None:
    """Return a contact from plain data; None if that is none."""
    try:
        return adapter(ContactConfig).validate_json(as_json(given))
    except ValidationError:
        return None


def contact_text(contact: ContactConfig) -> str:
    """Return a contact in words: ``5 ms, pyramidal, impratio 1``."""
    return f"{1e3 * contact.time_constant:g} ms, {contact.cone}, impratio {contact.impratio:g}"
