"""Protocol of actuators, and the proportional-derivative ones: ``pd`` (ideal), ``dc_motor`` and ``voltage``."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeGuard, runtime_checkable

import torch

from go1exp.base.tensors.memory import Memory
from go1exp.config.schema.joint_values import JointValues, each_within
from go1exp.config.schema.registry import actuator
from go1exp.robot.actuators import ActuatorSetup

if TYPE_CHECKING:
    from torch import Tensor


class Actuator(Protocol):
    """Turns position targets into torques at the physics rate; owns whatever history that takes."""

    def torque(self, target: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return joint torques (N, J), N m, for targets and angles in rad and speeds in rad/s.

        An actuator that can be fed forward has a fourth argument, ``feedforward: Tensor | None = None``, (N, J), N m:
        added to its own torque before the limit, and delayed as the target is (``TakesFeedforward``).
        """

    def reset(self, mask: Tensor) -> None:
        """Forget the history of the rows of ``mask`` (N,) bool."""

    def state_dict(self) -> dict[str, Any]:
        """Return the history."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue with that history."""


class TakesFeedforward(Actuator, Protocol):
    """An actuator to which a torque can be added, as a Go1's motors add ``LowCmd.tau``."""

    def torque(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None = None) -> Tensor:
        """Return joint torques (N, J), N m, that of the law plus ``feedforward``, within the actuator's limit."""


def takes_feedforward(actuator: Actuator) -> TypeGuard[TakesFeedforward]:
    """Return whether an actuator, and the one that it may wrap, can be fed forward."""
    inner = getattr(actuator, "drive", None)
    itself = "feedforward" in inspect.signature(actuator.torque).parameters
    return itself and (inner is None or takes_feedforward(inner))


@runtime_checkable
class HasGains(Protocol):
    """An actuator whose gains, both (N, J), can be written in place: its own or the wrapped actuator's."""

    @property
    def kp(self) -> Tensor:
        """N m/rad."""

    @property
    def kd(self) -> Tensor:
        """N m s/rad."""


class Gains(Memory):
    """Base of actuators with a position gain ``kp`` and a speed gain ``kd``, both (N, J) and writable in place.

    Registered with ``gains=True``, so that effects on the gains know where they can act.
    """

    memory = ("kp", "kd")
    kp: Tensor
    """N m/rad."""
    kd: Tensor
    """N m s/rad."""


def envelope(qd: Tensor, effort: Tensor, stall: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
    """Return the smallest and the largest torque that a DC motor can make at a speed.

    Its supply drives a current against the back voltage, which grows with speed; its electronics limit that current::

        high = min(effort, stall (1 - qd / speed))      low = max(-effort, -stall (1 + qd / speed))

    Beyond ``speed`` the motor can only brake, at most with ``effort``. Law of Isaac Lab's DC motor and of mjlab's; with
    ``effort = stall = 23.7`` and ``speed = 30`` the largest torque of a Go1's hip is 15.8 N m at 10 rad/s, 0 at 30.

    Args:
        qd: speed (N, J), rad/s.
        effort: peak torque that the electronics allow, positive, broadcasting to (N, J), N m.
        stall: torque of the line at rest, positive, N m; with ``stall > effort`` torque falls from a corner on only.
        speed: where the line reaches zero, positive, rad/s; infinite: torque does not fall with speed.
    """
    share = qd / speed
    low = torch.maximum(-stall * (1.0 + share), -effort)
    high = torch.minimum(stall * (1.0 - share), effort)
    return torch.minimum(low, effort), torch.maximum(high, -effort)


Gain = Annotated[JointValues, each_within(0.0)]
"""One gain for all joints, hip-thigh-calf, or one for each; not negative."""


class _Controller(Gains):
    """Position and velocity gain of a motor's controller, without a history."""

    def _demand(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None) -> Tensor:
        """Return kp (target - q) - kd qd + feedforward, (N, J), N m."""
        tau = torch.sub(target, q).mul_(self.kp).addcmul_(self.kd, qd, value=-1.0)
        return tau if feedforward is None else tau.add_(feedforward)

    def reset(self, mask: Tensor) -> None:
        """Do nothing: there is no history."""


@actuator("pd", gains=True)
class PD(_Controller):
    """Proportional-derivative joint control, clipped at the peak torque: tau = kp (target - q) - kd qd."""

    joint_values = ("kp", "kd")

    def __init__(self, setup: ActuatorSetup, *, kp: Gain = 20.0, kd: Gain = 0.5) -> None:
        """Keep the gains, kp in N m/rad and kd in N m s/rad (20 and 0.5: the paper, section II-B.2)."""
        self.kp, self.kd = setup.rows(kp), setup.rows(kd)
        self._limit = setup.effort_limit

    def torque(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None = None) -> Tensor:
        """Return the joint torques (N, J), N m; target and q in rad, qd in rad/s; feedforward is in the clipped sum."""
        return torch.clamp(self._demand(target, q, qd, feedforward), -self._limit, self._limit)


Torque = Annotated[JointValues, each_within(1.0, 500.0)]
"""N m at the joint, behind its reduction."""
Speed = Annotated[JointValues, each_within(1.0, 500.0)]
"""rad/s at the joint, behind its reduction."""


@actuator("dc_motor", gains=True)
class DCMotor(_Controller):
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
            kd: velocity gain, N m s/rad.
            stall: torque of the line at rest, N m; None, or a joint left out: the robot's peak torque.
            speed: where the line reaches zero, rad/s; None, or a joint left out: the robot's top speed.
        """
        self.kp, self.kd = setup.rows(kp), setup.rows(kd)
        self._effort = setup.effort_limit
        self._stall, self._speed = line(setup, stall, speed)

    def torque(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None = None) -> Tensor:
        """Return the joint torques (N, J), N m; target and q in rad, qd in rad/s; feedforward is in the clipped sum."""
        return torch.clamp(
            self._demand(target, q, qd, feedforward), *envelope(qd, self._effort, self._stall, self._speed)
        )


def line(setup: ActuatorSetup, stall: JointValues | None, speed: JointValues | None) -> tuple[Tensor, Tensor]:
    """Return stall torques and top speeds (J,) of motors, where they are not given those of the robot's limits."""
    return _or(setup, stall, setup.effort_limit), _or(setup, speed, setup.velocity_limit)


def _or(setup: ActuatorSetup, values: JointValues | None, usual: Tensor) -> Tensor:
    """Spread ``values`` over the joints (J,); those that they do not name have the ``usual`` ones."""
    if values is None:
        return usual
    given = setup.tensor(values)
    return torch.where(given.isnan(), usual, given)


Stall = Annotated[JointValues, each_within(0.01, 500.0)]
"""N m at the joint, behind its reduction; small servos have a tenth."""
Supply = Annotated[JointValues, each_within(0.1, 2.0)]
"""Supply voltage over the nominal one."""


@actuator("voltage", gains=True)
class Voltage(_Controller):
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
            kd: velocity gain of the controller, without the back EMF, N m s/rad.
            stall: torque at rest with full duty, N m; None, or a joint left out: the robot's peak torque.
            speed: without load at full duty, rad/s; None, or a joint left out: the robot's top speed.
            supply: voltage over the nominal one.
        """
        self.kp, self.kd = setup.rows(kp), setup.rows(kd)
        self._limit, self._supply = setup.effort_limit, setup.tensor(supply)
        self._stall, self._speed = line(setup, stall, speed)

    def torque(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None = None) -> Tensor:
        """Return the joint torques (N, J), N m; target and q in rad, qd in rad/s; feedforward is in the duty."""
        duty = torch.clamp(self._demand(target, q, qd, feedforward), -self._stall, self._stall)
        driven = self._supply * duty
        return torch.clamp(driven - self._stall / self._speed * qd, -self._limit, self._limit)
