"""The state that resets and events may write."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from go1exp import robot

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
