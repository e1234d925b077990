"""``actuator=voltage``: a servo whose controller sets the voltage of a DC motor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import torch

from go1exp.config.schema.joint_values import JointValues, each_within
from go1exp.config.schema.registry import actuator
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.dc_motor import Speed, line
from go1exp.sim.actuator.pd import Gain
from go1exp.sim.actuator.setup import Gains

if TYPE_CHECKING:
    from torch import Tensor

Stall = Annotated[JointValues, each_within(0.01, 500.0)]
"""N m at the joint, behind its reduction; small servos have a tenth."""
Supply = Annotated[JointValues, each_within(0.1, 2.0)]
"""Supply voltage over the nominal one."""


@actuator("voltage", gains=True)
class Voltage(Gains):
    """A DC motor whose duty is clipped before the back EMF acts, and whose current is limited after it.

    duty = (kp (target - q) - kd qd) / stall within -1 to 1; tau = supply stall duty - (stall / speed) qd within the
    peak torque. So a joint at speed gets less than its error asks for although its duty is full, and one that is pushed
    is braked although its duty is none; ``pd`` and ``dc_motor`` clip torques. Hobby servos are such actuators: tau =
    (kt / R) (U - kt qd), Duclusaud et al. (BAM, arXiv 2410.08650), with stall = U kt / R and speed = U / kt at the
    nominal voltage. Inductance (below 1 ms) is left out. Gains are torques at rest and at the nominal voltage.
    """

    joint_values = ("kp", "kd", "stall", "speed", "supply")

    def __init__(
        self,
        setup: ActuatorSetup,
        *,
        kp: Gain = 20.0,
        kd: Gain = 0.0,
        stall: Stall | None = None,
        speed: Speed | None = None,
        supply: Supply = 1.0,
    ) -> None:
        """Keep the gains and the motor's line at the nominal voltage.

        Args:
            setup: the actuators; the peak torque is what the current limit allows.
            kp: position gain, N m/rad.
            kd: speed gain of the controller, beside the back EMF, N m s/rad.
            stall: torque at rest with full duty, N m; None, or a joint left out: the robot's peak torque.
            speed: without load at full duty, rad/s; None, or a joint left out: the robot's top speed.
            supply: voltage over the nominal one.
        """
        self.kp, self.kd = setup.rows(kp), setup.rows(kd)
        self._limit, self._supply = setup.effort_limit, setup.tensor(supply)
        self._stall, self._speed = line(setup, stall, speed)

    def torque(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None = None) -> Tensor:
        """Return the joint torques (N, J), N m; target and q in rad, qd in rad/s; feedforward is in the duty."""
        asked = torch.sub(target, q).mul_(self.kp).addcmul_(self.kd, qd, value=-1.0)
        if feedforward is not None:
            asked.add_(feedforward)
        driven = self._supply * torch.clamp(asked, -self._stall, self._stall)
        return torch.clamp(driven - self._stall / self._speed * qd, -self._limit, self._limit)

    def reset(self, mask: Tensor) -> None:
        """Nothing to forget."""
