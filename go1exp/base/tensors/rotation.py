"""The few rotations that a hot loop needs, on ``(N, ...)`` tensors on any device.

Everywhere else ``scipy.spatial.transform.Rotation`` is the tool.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


def rotate(quat: Tensor, vector: Tensor) -> Tensor:
    """Express a vector (..., 3) of the frame whose orientation is ``quat`` (..., 4), w-x-y-z, in the world."""
    return rotate_inverse(torch.cat([quat[..., :1], -quat[..., 1:]], dim=-1), vector)


def rotate_inverse(quat: Tensor, vector: Tensor) -> Tensor:
    """Express a world vector (..., 3) in the frame whose orientation is ``quat`` (..., 4), w-x-y-z."""
    w, axis = quat[..., :1], quat[..., 1:]
    t = 2.0 * torch.linalg.cross(axis, vector)
    return vector - w * t + torch.linalg.cross(axis, t)


def projected_gravity(quat: Tensor) -> Tensor:
    """Direction of gravity (N, 3), unit length, in the frame of orientation ``quat`` (N, 4), w-x-y-z."""
    zero = torch.zeros_like(quat[:, 0])
    return rotate_inverse(quat, torch.stack([zero, zero, zero - 1.0], dim=-1))


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
