"""Quantities that follow from a Snapshot, and the few rotations that a hot loop needs.

Everywhere else ``scipy.spatial.transform.Rotation`` is the tool; these run on ``(N, ...)`` tensors on any device.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp import robot
from go1exp.types import Snapshot

if TYPE_CHECKING:
    from torch import Tensor

SYNC_PAIRS = ((1, 2), (0, 3))
"""Legs of a trot that move together: front left with rear right, front right with rear left (``robot.LEGS``)."""

ASYNC_PAIRS = ((1, 0), (2, 3), (1, 3), (0, 2))
"""Legs of a trot that move in opposition: across the body and along each side."""


def rotate_inverse(quat: Tensor, vector: Tensor) -> Tensor:
    """Express a world vector (N, 3) in the frame whose orientation is ``quat`` (N, 4), w-x-y-z."""
    w, axis = quat[:, :1], quat[:, 1:]
    t = 2.0 * torch.linalg.cross(axis, vector)
    return vector - w * t + torch.linalg.cross(axis, t)


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product (N, 4), w-x-y-z: the rotation ``b`` followed, in the fixed frame, by ``a``."""
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    scalar = aw * bw - (av * bv).sum(-1, keepdim=True)
    return torch.cat([scalar, aw * bv + bw * av + torch.linalg.cross(av, bv)], dim=-1)


def quat_from_rotvec(rotvec: Tensor) -> Tensor:
    """Unit quaternion (N, 4) of a rotation by ``|rotvec|`` rad about ``rotvec`` (N, 3)."""
    angle = rotvec.norm(dim=-1, keepdim=True)
    half = 0.5 * angle
    scale = torch.where(angle > 1e-9, torch.sin(half) / angle.clamp(min=1e-9), torch.full_like(angle, 0.5))
    return torch.cat([torch.cos(half), scale * rotvec], dim=-1)


def is_moving(s: Snapshot, speed_threshold: float) -> Tensor:
    """(N,) bool: told to move, or moving faster than ``speed_threshold`` m/s all the same (Isaac Lab, Spot task)."""
    assert s.base_lin_vel_b is not None
    return (s.command.norm(dim=-1) > 0) | (s.base_lin_vel_b[:, :2].norm(dim=-1) > speed_threshold)


def joint_deviation(s: Snapshot) -> Tensor:
    """(N, 12) joint angle minus nominal stance, rad."""
    return s.joint_pos - torch.as_tensor(robot.NOMINAL_STANCE, dtype=s.joint_pos.dtype, device=s.joint_pos.device)


def foot_speed_xy(s: Snapshot) -> Tensor:
    """(N, 4) horizontal speed of the feet, m/s."""
    assert s.foot_vel_w is not None
    return s.foot_vel_w[..., :2].norm(dim=-1)
