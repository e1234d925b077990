"""What every actuator is told when it is built."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch

from go1exp import robot

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class ActuatorSetup:
    """The robot and the batch that an actuator will drive.

    Attributes:
        num_envs: N.
        physics_dt: period of its calls, s.
        effort_limit: peak torque of hip, thigh, calf, N m.
        velocity_limit: top speed of hip, thigh, calf, rad/s.
        device: of the tensors to come.
        dtype: of the joint state to come (float64 on the CPU backend).
    """

    num_envs: int
    physics_dt: float
    effort_limit: tuple[float, float, float]
    velocity_limit: tuple[float, float, float]
    device: torch.device
    dtype: torch.dtype

    def per_joint(self, hip_thigh_calf: tuple[float, float, float]) -> Tensor:
        """Spread three values over the joints, (12,), on the right device."""
        return torch.as_tensor(robot.per_joint(hip_thigh_calf), dtype=self.dtype, device=self.device)


class Actuator(Protocol):
    """Turns position targets into torques at the physics rate; owns whatever history that takes."""

    def torque(self, target: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return joint torques (N, 12), N m, for targets and angles in rad and speeds in rad/s."""

    def reset(self, mask: Tensor) -> None:
        """Forget the history of the rows of ``mask`` (N,) bool."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return the history."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue with that history."""
