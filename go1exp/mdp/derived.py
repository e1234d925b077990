"""Quantities that follow from a Snapshot, and what an action means: joint targets about the nominal stance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp import robot
from go1exp.base.tensors.memory import constant_like
from go1exp.base.tensors.rotation import rotate
from go1exp.mdp.types import Snapshot

if TYPE_CHECKING:
    from torch import Tensor

NOMINAL_STANCE = tuple(robot.NOMINAL_STANCE.tolist())

SYNC_PAIRS = ((1, 2), (0, 3))
"""Legs of a trot that move together: front left with rear right, front right with rear left (``robot.LEGS``)."""

ASYNC_PAIRS = ((1, 0), (2, 3), (1, 3), (0, 2))
"""Legs of a trot that move in opposition: across the body and along each side."""

DIAGONAL_SIGNS = (1.0, -1.0, -1.0, 1.0)
"""Diagonal of each leg: FR and RL, or FL and RR."""


def is_moving(s: Snapshot, speed_threshold: float) -> Tensor:
    """(N,) bool: non-zero command, or faster than ``speed_threshold`` m/s without one (Isaac Lab, Spot task)."""
    return (s.command.norm(dim=-1) > 0) | (s.base_lin_vel_b[:, :2].norm(dim=-1) > speed_threshold)


def joint_deviation(s: Snapshot) -> Tensor:
    """(N, 12) joint angle minus nominal stance, rad."""
    return s.joint_pos - constant_like(NOMINAL_STANCE, s.joint_pos)


def foot_speed_xy(s: Snapshot) -> Tensor:
    """(N, 4) horizontal speed of the feet, m/s."""
    return s.foot_vel_w[..., :2].norm(dim=-1)


def slip_speed(s: Snapshot) -> Tensor:
    """(N, 4) horizontal speed of the sole, m/s: of the lowest point of each foot's sphere.

    A foot that stands still rolls with its leg, so that its centre moves: at 3 m/s by 0.3 m/s.
    """
    hip, turning = s.joint_pos.unflatten(-1, (4, 3))[..., 0], s.joint_vel.unflatten(-1, (4, 3))
    pitching = turning[..., 1] + turning[..., 2]  # thigh and calf turn about the axis that the hip has tilted
    of_leg = torch.stack([turning[..., 0], torch.cos(hip) * pitching, torch.sin(hip) * pitching], dim=-1)
    turn_w = rotate(s.base_quat_w.unsqueeze(1), s.base_ang_vel_b.unsqueeze(1) + of_leg)
    x = s.foot_vel_w[..., 0] - robot.FOOT_RADIUS * turn_w[..., 1]
    y = s.foot_vel_w[..., 1] + robot.FOOT_RADIUS * turn_w[..., 0]
    return torch.hypot(x, y)


def since_last_contact_began(s: Snapshot) -> Tensor:
    """(N, 4) time since each foot last touched down, bounces included, s."""
    return s.foot_contact_time + s.foot_air_time + s.foot_last_contact_time * (s.foot_air_time > 0)


def clock_angle(s: Snapshot, rate: float) -> Tensor:
    """(N,) angle of a gait clock that makes ``rate`` turns a second from the start of the episode, rad."""
    return 2.0 * math.pi * (rate * s.episode_time).frac()


def limited(action: Tensor, previous: Tensor, clip: float, step: float | None, highest: Tensor | None = None) -> Tensor:
    """Return the action in force (N, 12), which the policy observes as its last one, for a policy's output.

    Args:
        action: the output.
        previous: the action in force before; the lowest of several, if ``highest`` is given.
        clip: bound of an action.
        step: bound of its change from each of them; None for none.
        highest: the highest of several, which differ by at most ``step``.
    """
    action = action.clamp(-clip, clip)
    if step is None:
        return action
    return torch.maximum(torch.minimum(action, previous + step), (previous if highest is None else highest) - step)


def of_shape(action: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return ``action``; raise ValueError where it has not one row for each robot: torch would spread it out."""
    if not isinstance(action, torch.Tensor):
        raise ValueError(f"action is a {type(action).__name__}; needed is a torch.Tensor {tuple(shape)}")
    if tuple(action.shape) != tuple(shape):
        raise ValueError(f"action has shape {tuple(action.shape)}; needed is {tuple(shape)}, one row for each robot")
    return action


def joint_target(action: Tensor, nominal: Tensor, scale: float) -> Tensor:
    """Return position targets (N, 12), rad: nominal stance (12,) + ``scale`` (rad) x action in force (N, 12)."""
    return nominal + scale * action
