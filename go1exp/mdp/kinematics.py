"""The kinematic state that resets and events write, and the foot positions that follow from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import torch

from go1exp import robot
from go1exp.base.tensors.rotation import rotate

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class KinematicState:
    """Position and velocity of N robots as tensors to be written in place (float64 on the CPU backend).

    Reset terms write every row; the caller keeps the rows that are being reset. Events write the rows they change.
    """

    base_pos_w: Tensor
    """(N, 3) m."""
    base_quat_w: Tensor
    """(N, 4) w-x-y-z."""
    base_lin_vel_w: Tensor
    """(N, 3) m/s."""
    base_ang_vel_b: Tensor
    """(N, 3) rad/s."""
    joint_pos: Tensor
    """(N, 12) rad."""
    joint_vel: Tensor
    """(N, 12) rad/s."""

    @classmethod
    def view(cls, qpos: Tensor, qvel: Tensor, held: tuple[float, float, float, float] | None = None) -> KinematicState:
        """View MuJoCo's qpos (N, 19) and qvel (N, 18): writing here writes there.

        The state of a robot whose trunk is ``held`` at an attitude w-x-y-z is its joints' alone, (N, 12), after that of
        a mount if there is one; its trunk rests at the origin, and writing that writes nowhere.
        """
        if held is None:
            return cls(qpos[:, :3], qpos[:, 3:7], qvel[:, :3], qvel[:, 3:6], qpos[:, 7:], qvel[:, 6:])
        still = torch.zeros(len(qpos), 3, dtype=qpos.dtype, device=qpos.device)
        quat = torch.tensor(held, dtype=qpos.dtype, device=qpos.device).repeat(len(qpos), 1)
        joints = slice(-robot.NUM_JOINTS, None)
        return cls(still, quat, still.clone(), still.clone(), qpos[:, joints], qvel[:, joints])


@cache
def _sides(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return signs (4,), front or rear and left or right: copied once, for a captured step cannot wait for the host."""
    front = [1.0 if leg[0] == "F" else -1.0 for leg in robot.LEGS]
    left = [1.0 if leg[1] == "L" else -1.0 for leg in robot.LEGS]
    return torch.tensor(front, dtype=dtype, device=device), torch.tensor(left, dtype=dtype, device=device)


def foot_positions(joint_pos: Tensor) -> Tensor:
    """Return the centres of the feet in the trunk's frame (N, 4, 3), m, at joint angles (N, 12), rad."""
    hip, thigh, calf = joint_pos.unflatten(1, (robot.NUM_LEGS, 3)).unbind(-1)
    front, left = _sides(joint_pos.dtype, joint_pos.device)
    offset, upper, lower = robot.LINK_LENGTHS
    # In the plane of the leg, which the hip then turns about x.
    forward = -upper * torch.sin(thigh) - lower * torch.sin(thigh + calf)
    down = upper * torch.cos(thigh) + lower * torch.cos(thigh + calf)
    side = left * offset
    y = side * torch.cos(hip) + down * torch.sin(hip)
    z = side * torch.sin(hip) - down * torch.cos(hip)
    return torch.stack([front * robot.HIP_OFFSET[0] + forward, left * robot.HIP_OFFSET[1] + y, z], dim=-1)


def lift(state: KinematicState, ground: Callable[[Tensor], Tensor] | None) -> None:
    """Raise each trunk until no foot is below the ground; one whose feet are clear stays where it is.

    Joint angles drawn by Table I would put feet up to 8 cm into the ground, and the robot be thrown out of it.

    Args:
        state: where the robots are to start; changed in place.
        ground: height of the ground at points (N, 4, 2), m; None for a plane at zero.
    """
    quat = state.base_quat_w.repeat_interleave(robot.NUM_LEGS, 0)
    feet = rotate(quat, foot_positions(state.joint_pos).flatten(0, 1)).unflatten(0, (-1, robot.NUM_LEGS))
    feet = feet + state.base_pos_w.unsqueeze(1)
    height = ground(feet[..., :2].float()) if ground is not None else 0.0
    missing = robot.FOOT_RADIUS + height - feet[..., 2]
    state.base_pos_w[:, 2] += missing.amax(-1).clamp(min=0.0)
