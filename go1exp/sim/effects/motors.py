"""Torque of the motors: ``effect=strength``, ``strength_drift``, ``torque_speed_limit``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.joint_values import JointValues
from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.motors import envelope
from go1exp.sim.effects.base import TWO_GAIN_SETS, Effect, Identification, Param

if TYPE_CHECKING:
    from torch import Tensor


@effect("strength")
class Strength(Effect):
    """The motor makes a multiple of the torque that its actuator asks for: tau = scale demand.

    Walk-these-ways randomises 0.9 to 1.1 on a Go1; +-5 to 30 % are likely (estimate). Slow motion cannot tell it
    from ``kp_scale``, and dynamics scaled the other way round (payload and armature together) look much the same.
    """

    title = "a change of actuator strength"
    params = (Param("scale", "-", 0.3, 3.0, 1.0, 0.05, "joint", "torque made over torque asked for"),)
    identification = Identification(
        nominal=True,
        rank=2,
        weighs_on_legs=True,
        of_gains=True,
        uniform=True,
        confounded=("armature", "kp_scale", "link_mass"),
        separated_by=TWO_GAIN_SETS,
    )
    order = 10

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque made."""
        return torque * self.scale


@effect("strength_drift")
class StrengthDrift(Effect):
    """The motor weakens in the course of an episode: tau = max(1 - rate t, floor) demand.

    Windings and magnets warm up, the battery goes down: -10 to -30 % (estimate), here spread over an episode of some
    20 s. t is the time since the episode began. The mean of it is ``strength``.
    """

    title = "a loss of actuator strength over time"
    params = (
        Param("rate", "1/s", 0.0, 0.2, 0.0, 0.0025, "joint", "strength lost per time"),
        Param("floor", "-", 0.1, 1.0, 0.5, math.inf, "joint", "strength at which the loss ends"),
    )
    memory = ("_time",)
    order = 20

    def __init__(self, setup: ActuatorSetup, **values: JointValues) -> None:
        """Begin an episode."""
        super().__init__(setup, **values)
        self._time = setup.zeros()[:, :1]

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque made; the step's time passes."""
        remaining = torch.maximum(1.0 - self.rate * self._time, self.floor)
        self._time += self.setup.physics_dt
        return torque * remaining

    def reset(self, mask: Tensor) -> None:
        """Begin an episode in the rows of ``mask`` (N,)."""
        self._time.masked_fill_(mask.unsqueeze(1), 0.0)

    def elapse(self, seconds: Tensor) -> None:
        """Weaken from the strength that ``seconds`` (N,) have left."""
        self._time.copy_(seconds.unsqueeze(1))


@effect("torque_speed_limit")
class TorqueSpeedLimit(Effect):
    """The motor's torque stays within its peak and below a line that falls with speed (``sim/actuator/motors.py``).

    With E the robot's peak torque and V its top speed (``robot.effort_limit``, ``robot.velocity_limit``)::

        high = peak E min(1, stall (1 - droop qd / V))      low = peak E max(-1, -stall (1 + droop qd / V))

    ``droop`` = 0 is a supply without limit: no line. At 1 torque ends at V, at 1.25 already at 0.8 V, as with a battery
    that is down by a fifth (and ``peak`` 0.8). ``stall`` = 1 lets torque fall from rest on, as Isaac Lab and mjlab have
    it for the Go1; the 30 N m at rest that the authors of walk-these-ways report make it 1.27. No measured line is
    published. A small ``droop`` does nothing until a motion reaches the line: big fast steps show it, walking does
    not. It comes last in the actuator, so that ``strength`` shrinks what it limits.

    With ``peak`` 1 and ``droop`` 0 torques pass as they are, without a limit beyond the actuator's and the model's own.
    """

    title = "a tighter torque-speed limit"
    params = (
        Param("peak", "-", 0.2, 1.0, 1.0, 0.05, "joint", "peak torque over the robot's"),
        Param("droop", "-", 0.0, 2.5, 0.0, 0.1, "joint", "the robot's top speed over that at which the line ends"),
        Param("stall", "-", 1.0, 3.0, 1.0, math.inf, "joint", "torque of the line at rest over the peak"),
    )
    identification = Identification(
        common=True,  # few joints ever reach a limit, and one supply feeds them all, or all of a part
        levels=(
            *({"peak": -change} for change in (0.1, 0.3, 0.55, 0.7)),
            *({"droop": change} for change in (0.2, 0.6, 1.0, 1.6)),
        ),
        limits_torque="peak",
        free_shapes=("stall",),
        excitation="steps",
    )
    order = 50

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque within the limits."""
        effort = self.peak * self.setup.effort_limit
        low, high = envelope(qd, effort, self.stall * effort, self.setup.velocity_limit / self.droop)
        absent = (self.peak == 1.0) & (self.droop == 0.0)
        return torch.where(absent, torque, torque.clamp(low, high))
