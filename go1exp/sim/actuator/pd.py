"""``actuator=pd``: the firmware's law, ideal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import torch

from go1exp.config.schema.joint_values import JointValues, each_within
from go1exp.config.schema.registry import actuator
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.setup import Gains

if TYPE_CHECKING:
    from torch import Tensor

Gain = Annotated[JointValues, each_within(0.0)]
"""One gain for all joints, hip-thigh-calf, or one for each; not negative."""


@actuator("pd", gains=True)
class PD(Gains):
    """Proportional-derivative joint control, clipped at the peak torque: tau = kp (target - q) - kd qd."""

    joint_values = ("kp", "kd")

    def __init__(self, setup: ActuatorSetup, *, kp: Gain = 20.0, kd: Gain = 0.5) -> None:
        """Keep the gains, kp in N m/rad and kd in N m s/rad (20 and 0.5: the paper, section II-B.2)."""
        self.kp, self.kd = setup.rows(kp), setup.rows(kd)
        self._limit = setup.effort_limit

    def torque(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None = None) -> Tensor:
        """Return the joint torques (N, J), N m; target and q in rad, qd in rad/s; feedforward is in the clipped sum."""
        tau = torch.sub(target, q).mul_(self.kp).addcmul_(self.kd, qd, value=-1.0)
        if feedforward is not None:
            tau.add_(feedforward)
        return torch.clamp(tau, -self._limit, self._limit)

    def reset(self, mask: Tensor) -> None:
        """Nothing to forget."""
