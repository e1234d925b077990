"""``actuator=pd``: the firmware's law, ideal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.actuator.setup import ActuatorSetup
from go1exp.memory import Memory
from go1exp.registry import NonNegative, actuator

if TYPE_CHECKING:
    from torch import Tensor


@actuator("pd")
class PD(Memory):
    """Proportional-derivative joint control, clipped at the peak torque: tau = kp (target - q) - kd qd."""

    def __init__(self, setup: ActuatorSetup, *, kp: NonNegative = 20.0, kd: NonNegative = 0.5) -> None:
        """Keep the gains, kp in N m/rad and kd in N m s/rad (20 and 0.5: the paper, section II-B.2)."""
        self._kp, self._kd = kp, kd
        self._limit = setup.per_joint(setup.effort_limit)

    def torque(self, target: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the joint torques (N, 12), N m; target and q in rad, qd in rad/s."""
        tau = torch.sub(target, q).mul_(self._kp).sub_(qd, alpha=self._kd)
        return torch.clamp(tau, -self._limit, self._limit)

    def reset(self, mask: Tensor) -> None:
        """Nothing to forget."""
