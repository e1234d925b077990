"""Which physics engine, and how it is set up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from go1exp.config.schema.registry import STRICT


@dataclass(frozen=True)
class CpuBackend:
    """MuJoCo's batch on a thread pool.

    Attributes:
        name: ``cpu``.
        threads: threads of the physics; 0 takes all cores.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    on_gpu: ClassVar[bool] = False
    """Whether its tensors are on a GPU."""
    captures: ClassVar[bool] = False
    """Whether work on its tensors is recorded once and replayed."""

    name: Literal["cpu"]
    threads: Annotated[int, Field(ge=0)]

    def as_reference(self) -> CpuBackend:
        """Return the settings of the engine that policies are judged on, wherever they were trained: MuJoCo's own."""
        return self


@dataclass(frozen=True)
class WarpBackend:
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

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    name: Literal["warp"]
    device: Annotated[str, Field(pattern=r"^(cpu|cuda(:\d+)?)$")]
    graph: bool
    nconmax: Annotated[int, Field(ge=32, le=1000)]
    njmax: Annotated[int, Field(ge=64, le=2000)]

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.graph and self.device == "cpu":
            raise ValueError("graph = True: a CUDA graph needs a CUDA device; use graph=false with device=cpu")

    @property
    def on_gpu(self) -> bool:
        """Whether its tensors are on a GPU."""
        return self.device != "cpu"

    @property
    def captures(self) -> bool:
        """Whether work on its tensors is recorded once and replayed."""
        return self.graph

    def as_reference(self) -> CpuBackend:
        """Return the settings of the engine that policies are judged on, wherever they were trained: MuJoCo's own."""
        return CpuBackend("cpu", threads=0)


@dataclass(frozen=True)
class PhysxBackend:
    """PhysX 5 on the processor, in single precision: it judges policies that were made with MuJoCo, and trains none.

    Attributes:
        name: ``physx``.
        threads: threads of the physics; 0 takes all cores. Robots are solved one by one: the same bits at any number.
        solver: ``tgs``, which divides a step by its iterations, or ``pgs``, which repeats the whole step.
        position_iterations: iterations of the solver in a physics step.
        velocity_iterations: iterations after those, for speeds alone.
        contact_offset: distance at which shapes are looked at for a contact, m; they touch at 0.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    on_gpu: ClassVar[bool] = False
    """Whether its tensors are on a GPU."""
    captures: ClassVar[bool] = False
    """Whether work on its tensors is recorded once and replayed."""

    name: Literal["physx"]
    threads: Annotated[int, Field(ge=0)]
    solver: Literal["tgs", "pgs"]
    position_iterations: Annotated[int, Field(ge=1, le=255)]
    velocity_iterations: Annotated[int, Field(ge=0, le=255)]
    contact_offset: Annotated[float, Field(gt=0, le=0.1)]

    def as_reference(self) -> CpuBackend:
        """Return the settings of the engine that policies are judged on, wherever they were trained: MuJoCo's own."""
        return CpuBackend("cpu", threads=0)


BackendConfig = CpuBackend | WarpBackend | PhysxBackend

BACKENDS: dict[str, type] = {"cpu": CpuBackend, "warp": WarpBackend, "physx": PhysxBackend}
"""By their names, which are also the choices of the group ``backend``."""
