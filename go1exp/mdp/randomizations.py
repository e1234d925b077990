"""Domain randomisation: terms that change a robot's model, and terms that change the state it starts from.

*Model terms* get the per-environment model fields and a mask of the rows to draw anew, at start-up or at every reset
(``when``). They declare the fields they write, so that the backend makes just those per environment. *State terms*
write the state of a reset. All draws are independent per element. Table I of the paper.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, Protocol

import torch

from go1exp import robot
from go1exp.mdp.derived import quat_from_rotvec, quat_multiply
from go1exp.mdp.kinematics import KinematicState
from go1exp.randomness import Stream
from go1exp.registry import FractionRange, PositiveRange, Range, randomization

if TYPE_CHECKING:
    from torch import Tensor

FEET = tuple(f"{leg}_foot" for leg in robot.LEGS)
Operation = Literal["set", "add", "scale"]
"""``set``: the draw itself; ``add``: nominal + draw; ``scale``: nominal x draw."""


class ModelFields(Protocol):
    """The per-environment model as a randomisation sees it (provided by the physics backend)."""

    def field(self, name: str) -> Tensor:
        """Live values ``(N, ...)`` of a model field, such as ``body_mass``."""

    def nominal(self, name: str) -> Tensor:
        """The compiled model's values ``(...)`` of that field."""

    def ids(self, kind: str, names: tuple[str, ...]) -> Tensor:
        """Indices of named bodies or geoms."""


def _vary(
    model: ModelFields, name: str, where: tuple[Tensor | int, ...], mask: Tensor, op: Operation, draw: Tensor
) -> None:
    """Write ``op(nominal, draw)`` into ``field[mask][where]``."""
    live, nominal = model.field(name), model.nominal(name)
    index = (slice(None), *where)
    start = nominal[where]
    new = {"set": lambda: draw.to(live.dtype), "add": lambda: start + draw, "scale": lambda: start * draw}[op]()
    keep = mask.reshape(-1, *([1] * (new.dim() - 1)))
    live[index] = torch.where(keep, new, live[index])


@randomization("foot_friction", kind="model", fields=("geom_friction",))
def foot_friction(
    model: ModelFields, stream: Stream, mask: Tensor, *, range: PositiveRange = (0.4, 1.1), operation: Operation = "set"
) -> None:
    """Sliding friction coefficient of each foot; the foot's value is the contact's. Table I: new, (0.4, 1.1)."""
    draw = stream.uniform(len(FEET), low=range[0], high=range[1])
    _vary(model, "geom_friction", (model.ids("geom", FEET), 0), mask, operation, draw)


@randomization("foot_restitution", kind="model", fields=("geom_solref",))
def foot_restitution(model: ModelFields, stream: Stream, mask: Tensor, *, range: FractionRange = (0.0, 0.2)) -> None:
    """Coefficient of restitution of each foot, by the damping ratio of its contact.

    MuJoCo has no restitution; its contact is a spring-damper of damping ratio z, which returns the fraction
    e = exp(-pi z / sqrt(1 - z^2)) of a free mass's speed, so z = -ln e / sqrt(pi^2 + ln^2 e), and 1 for e = 0.
    Text of the paper, section II-B.1 (no range is printed; 0 to 0.2 is chosen).
    """
    e = stream.uniform(len(FEET), low=range[0], high=range[1]).clamp(min=1e-6, max=0.999)
    log_e = torch.log(e)
    ratio = -log_e / torch.sqrt(math.pi**2 + log_e.square())
    _vary(model, "geom_solref", (model.ids("geom", FEET), 1), mask, "set", ratio)


@randomization("center_of_mass", kind="model", fields=("body_ipos",), derived=True)
def center_of_mass(model: ModelFields, stream: Stream, mask: Tensor, *, range: Range = (-0.025, 0.025)) -> None:
    """Centre of mass of the trunk, moved per axis by a draw in m. Table I: add, (-0.025, 0.025)."""
    draw = stream.uniform(1, 3, low=range[0], high=range[1])
    _vary(model, "body_ipos", (model.ids("body", ("trunk",)),), mask, "add", draw)


@randomization("link_mass", kind="model", fields=("body_mass", "body_inertia"), derived=True)
def link_mass(model: ModelFields, stream: Stream, mask: Tensor, *, range: PositiveRange = (0.8, 1.3)) -> None:
    """Mass of every link, scaled by a factor of its own; inertia scales along. Table I: scale, (0.8, 1.3)."""
    bodies = model.ids("body", ("trunk", *robot.JOINTS))
    factor = stream.uniform(len(bodies), low=range[0], high=range[1])
    _vary(model, "body_mass", (bodies,), mask, "scale", factor)
    _vary(model, "body_inertia", (bodies,), mask, "scale", factor.unsqueeze(-1))


@randomization("body_velocity", kind="state")
def body_velocity(state: KinematicState, stream: Stream, *, range: Range = (-0.25, 0.25)) -> None:
    """Initial trunk velocity: all six components, m/s and rad/s. Table I: add, (-0.25, 0.25)."""
    draw = stream.uniform(6, low=range[0], high=range[1])
    state.base_lin_vel_w.add_(draw[:, :3])
    state.base_ang_vel_b.add_(draw[:, 3:])


@randomization("body_position", kind="state")
def body_position(state: KinematicState, stream: Stream, *, range: Range = (-0.5, 0.5)) -> None:
    """Initial horizontal position about the spawn point, m per axis. Table I: add, (-0.5, 0.5)."""
    state.base_pos_w[:, :2].add_(stream.uniform(2, low=range[0], high=range[1]))


@randomization("body_orientation", kind="state")
def body_orientation(state: KinematicState, stream: Stream, *, range: Range = (-0.02, 0.02)) -> None:
    """Initial orientation: a rotation vector of three draws in rad. Table I: add, (-0.02, 0.02)."""
    turn = quat_from_rotvec(stream.uniform(3, low=range[0], high=range[1]).to(state.base_quat_w.dtype))
    state.base_quat_w.copy_(quat_multiply(turn, state.base_quat_w))


@randomization("joint_positions", kind="state")
def joint_positions(
    state: KinematicState,
    stream: Stream,
    *,
    range: Range = (-0.3, 0.3),
    operation: Literal["add", "scale"] = "scale",
) -> None:
    """Initial joint angles: q0 (1 + draw) for ``scale``, q0 + draw rad for ``add``; cut at the hard limits.

    Table I: scale, (-0.3, 0.3). A plain product would fold the legs flat; the text says a difference from the initial
    value.
    """
    draw = stream.uniform(robot.NUM_JOINTS, low=range[0], high=range[1])
    q = state.joint_pos * (1.0 + draw) if operation == "scale" else state.joint_pos + draw
    limits = torch.as_tensor(robot.JOINT_POS_LIMITS, dtype=q.dtype, device=q.device)
    state.joint_pos.copy_(torch.minimum(torch.maximum(q, limits[:, 0]), limits[:, 1]))


@randomization("joint_velocities", kind="state")
def joint_velocities(state: KinematicState, stream: Stream, *, range: Range = (-2.5, 2.5)) -> None:
    """Initial joint speeds, rad/s. Table I: scale, (-2.5, 2.5), which of a nominal zero is zero; added here."""
    state.joint_vel.add_(stream.uniform(robot.NUM_JOINTS, low=range[0], high=range[1]))
