"""Domain randomisation: terms that change a robot's model, and terms that change the state it starts from.

*Model terms* get the per-environment model fields and a mask of the rows to draw anew, at start-up or at every reset
(``when``). They declare the fields they write, so that the backend makes just those per environment. *State terms*
write the state of a reset. All draws are independent per element. Table I of the paper.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import torch
from pydantic import AfterValidator, Field

from go1exp import robot
from go1exp.base.tensors.memory import constant_like
from go1exp.base.tensors.randomness import Stream
from go1exp.base.tensors.rotation import quat_from_rotvec, quat_multiply
from go1exp.config.schema.registry import PositiveRange, Range, SpeedRange, ordered, randomization
from go1exp.mdp.kinematics import KinematicState
from go1exp.robot.actuators import ModelFields

if TYPE_CHECKING:
    from torch import Tensor


def restitution(damping_ratio: np.ndarray) -> np.ndarray:
    """Return the share of its speed that a mass keeps when it meets a spring-damper which can push but not pull.

    With z the damping ratio and w = sqrt(|1 - z^2|): e = exp(-z/w atan2(2 z w, 2 z^2 - 1)) below z = 1, exp(-2) at 1,
    and exp(-z/w ln((z + w) / (z - w))) above.
    Schwager and Poeschel, "Coefficient of restitution and linear-dashpot model revisited", Granular Matter 9 (2007).
    """
    z = np.asarray(damping_ratio, dtype=float)
    w = np.sqrt(np.maximum(np.abs(1.0 - z**2), 1e-18))
    under = np.where(z < 1.0, np.arctan2(2.0 * z * w, 2.0 * z**2 - 1.0), 0.0)
    over = np.log((z + w) / np.maximum(z - w, 1e-18))
    return np.exp(-z / w * np.where(z < 1.0, under, over))


@functools.cache
def _restitution_table(device: torch.device) -> tuple[Tensor, Tensor]:
    """Damping ratios and their restitution on a grid, restitution rising."""
    ratio = np.geomspace(4.0, 0.1, 400)
    return torch.tensor(restitution(ratio), device=device), torch.tensor(ratio, device=device)


def damping_ratio(e: Tensor) -> Tensor:
    """Invert ``restitution`` by linear interpolation; any shape, values from 0.015 to 0.74."""
    known, ratio = _restitution_table(e.device)
    right = torch.searchsorted(known, e.to(known.dtype).contiguous()).clamp(1, len(known) - 1)
    share = (e - known[right - 1]) / (known[right] - known[right - 1])
    return ratio[right - 1] + share * (ratio[right] - ratio[right - 1])


JOINT_POS_LIMITS = tuple(tuple(bound) for bound in robot.JOINT_POS_LIMITS.T.tolist())
"""Lower and upper, rad."""

Operation = Literal["set", "add", "scale"]
"""``set``: the draw itself; ``add``: nominal + draw; ``scale``: nominal x draw."""


def _vary(
    model: ModelFields, name: str, where: tuple[Tensor | int, ...], mask: Tensor, op: Operation, draw: Tensor
) -> None:
    live, nominal = model.field(name), model.nominal(name)
    index = (slice(None), *where)
    start = nominal[index]
    new = {"set": lambda: draw.to(live.dtype), "add": lambda: start + draw, "scale": lambda: start * draw}[op]()
    keep = mask.reshape(-1, *([1] * (new.dim() - 1)))
    live[index] = torch.where(keep, new, live[index])


@randomization("foot_friction", kind="model", fields=("geom_friction",))
def foot_friction(
    model: ModelFields,
    stream: Stream,
    mask: Tensor,
    *,
    range: PositiveRange = (0.4, 1.1),
    operation: Literal["set", "scale"] = "set",
) -> None:
    """Sliding friction coefficient of each foot; the foot's value is the contact's. Table I: new, (0.4, 1.1)."""
    draw = stream.uniform(len(robot.FEET), low=range[0], high=range[1])
    _vary(model, "geom_friction", (model.ids("geom", robot.FEET), 0), mask, operation, draw)


Restitution = Annotated[float, Field(ge=0.02, le=0.7)]
"""Below, a contact of MuJoCo would have to be far too soft; above, a physics step of 2 ms cannot resolve it."""

RestitutionRange = Annotated[tuple[Restitution, Restitution], AfterValidator(ordered)]
ContactTime = Annotated[float, Field(ge=0.002, le=0.1)]

FEET_CONTACT = "contact of the feet"
"""What two terms set, so that a configuration may have one of them only."""


def _set_contact(model: ModelFields, mask: Tensor, time: Tensor, ratio: Tensor) -> None:
    """Set each foot's spring: 1 / its natural frequency, s, and its damping ratio; (N, 4) or (N, 1)."""
    feet = model.ids("geom", robot.FEET)
    _vary(model, "geom_solref", (feet, 0), mask, "set", time / ratio)
    _vary(model, "geom_solref", (feet, 1), mask, "set", ratio)


def _spring(model: ModelFields) -> tuple[Tensor, Tensor]:
    """Return the feet's nominal spring (1 or N, 4): 1 / its natural frequency, s, and its damping ratio."""
    time, ratio = model.nominal("geom_solref")[:, model.ids("geom", robot.FEET)].unbind(-1)
    return time * ratio, ratio


@randomization("foot_restitution", kind="model", fields=("geom_solref",), sets=FEET_CONTACT)
def foot_restitution(model: ModelFields, stream: Stream, mask: Tensor, *, range: RestitutionRange = (0.1, 0.3)) -> None:
    """Coefficient of restitution of each foot, 0.02 to 0.7, by the damper of its contact; the spring stays.

    MuJoCo's contact is a spring-damper; its default ratio of 1 returns exp(-2) = 0.135 of the speed, less what gravity
    takes on the way out: at 1 m/s and a time constant of 5 ms 0.3 comes out as 0.25, 0.2 as 0.1 (docs/contact.md).
    Text of the paper, section II-B.1, which prints no range: 0.1 to 0.3 is chosen.
    """
    ratio = damping_ratio(stream.uniform(len(robot.FEET), low=range[0], high=range[1]))
    _set_contact(model, mask, _spring(model)[0], ratio)


@randomization("ground_stiffness", kind="model", fields=("geom_solref",), sets=FEET_CONTACT)
def ground_stiffness(
    model: ModelFields,
    stream: Stream,
    mask: Tensor,
    *,
    range: Annotated[tuple[ContactTime, ContactTime], AfterValidator(ordered)] = (0.004, 0.02),
    restitution: RestitutionRange | None = None,
) -> None:
    """Stiffness of the ground under all feet, as the time constant of a contact with a damping ratio of 1, s.

    A foot sinks as its square: 0.004 is a hard floor, 0.02 MuJoCo's own and like a mattress. Below two physics steps
    MuJoCo takes two. ``restitution``, if given, is drawn for each foot as ``foot_restitution`` does. Not in the paper.
    """
    time = stream.uniform(1, low=range[0], high=range[1])
    ratio = _spring(model)[1]
    if restitution is not None:
        ratio = damping_ratio(stream.uniform(len(robot.FEET), low=restitution[0], high=restitution[1]))
    _set_contact(model, mask, time, ratio)


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
def body_velocity(state: KinematicState, stream: Stream, *, range: SpeedRange = (-0.25, 0.25)) -> None:
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
    state: KinematicState, stream: Stream, *, range: Range = (-0.3, 0.3), operation: Literal["add", "scale"] = "scale"
) -> None:
    """Initial joint angles: q0 (1 + draw) for ``scale``, q0 + draw rad for ``add``; cut at the hard limits.

    Table I: scale, (-0.3, 0.3). A plain product would fold the legs flat; the text says a difference from the initial
    value.
    """
    draw = stream.uniform(robot.NUM_JOINTS, low=range[0], high=range[1])
    q = state.joint_pos * (1.0 + draw) if operation == "scale" else state.joint_pos + draw
    low, high = (constant_like(bound, q) for bound in JOINT_POS_LIMITS)
    state.joint_pos.copy_(torch.minimum(torch.maximum(q, low), high))


@randomization("joint_velocities", kind="state")
def joint_velocities(state: KinematicState, stream: Stream, *, range: Range = (-2.5, 2.5)) -> None:
    """Initial joint velocities, rad/s. Table I: scale, (-2.5, 2.5), which of a nominal zero is zero; added here."""
    state.joint_vel.add_(stream.uniform(robot.NUM_JOINTS, low=range[0], high=range[1]))
