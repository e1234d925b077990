"""``actuator=dc_motor``: the firmware's law, as far as the motor can follow."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import torch

from go1exp.config.schema.joint_values import JointValues, each_within
from go1exp.config.schema.registry import actuator
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.envelope import envelope
from go1exp.sim.actuator.pd import Gain
from go1exp.sim.actuator.setup import Gains

if TYPE_CHECKING:
    from torch import Tensor

Torque = Annotated[JointValues, each_within(1.0, 500.0)]
"""N m at the joint, behind its reduction."""
Speed = Annotated[JointValues, each_within(1.0, 500.0)]
"""rad/s at the joint, behind its reduction."""


@actuator("dc_motor", gains=True)
class DCMotor(Gains):
    """Proportional-derivative joint control, clipped at what a DC motor can make at that speed.

    tau = kp (target - q) - kd qd within ``envelope``. All limits are the joint's own: the calf, geared down by a
    further 1.5, has 1.5 times the torque of hip and thigh at 1 / 1.5 of their speed (35.55 N m and 20.06 rad/s against
    23.7 N m and 30.1 rad/s in the vendor's URDF). No measured curve is published. With ``stall`` at the peak torque, as
    in Isaac Lab, torque falls from zero speed on, which is pessimistic: about 30 N m have been seen at standstill on
    one Go1 (walk-these-ways, issue 67), and 30 to 35 N m puts the corner of hip and thigh at 6 to 10 rad/s.
    """

    joint_values = ("kp", "kd", "stall", "speed")

    def __init__(
        self,
        setup: ActuatorSetup,
        *,
        kp: Gain = 20.0,
        kd: Gain = 0.5,
        stall: Torque | None = None,
        speed: Speed | None = None,
    ) -> None:
        """Keep the gains, N m/rad and N m s/rad, and the line.

        Args:
            setup: the actuators.
            kp: position gain, N m/rad.
            kd: speed gain, N m s/rad.
            stall: torque of the line at rest, N m; None, or a joint left out: the robot's peak torque.
            speed: where the line reaches zero, rad/s; None, or a joint left out: the robot's top speed.
        """
        self.kp, self.kd = setup.rows(kp), setup.rows(kd)
        self._effort = setup.effort_limit
        self._stall, self._speed = line(setup, stall, speed)

    def torque(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None = None) -> Tensor:
        """Return the joint torques (N, J), N m; target and q in rad, qd in rad/s; feedforward is in the clipped sum."""
        tau = torch.sub(target, q).mul_(self.kp).addcmul_(self.kd, qd, value=-1.0)
        if feedforward is not None:
            tau.add_(feedforward)
        return torch.clamp(tau, *envelope(qd, self._effort, self._stall, self._speed))

    def reset(self, mask: Tensor) -> None:
        """Nothing to forget."""


def line(setup: ActuatorSetup, stall: JointValues | None, speed: JointValues | None) -> tuple[Tensor, Tensor]:
    """Return stall torques and top speeds (J,) of motors, where they are not given those of the robot's limits."""
    return _or(setup, stall, setup.effort_limit), _or(setup, speed, setup.velocity_limit)


def _or(setup: ActuatorSetup, values: JointValues | None, usual: Tensor) -> Tensor:
    """Spread ``values`` over the joints (J,); those that they do not name have the ``usual`` ones."""
    if values is None:
        return usual
    given = setup.tensor(values)
    return torch.where(given.isnan(), usual, given)
