"""``effect=strength_drift``: the motors weaken as an episode goes on."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.effects.base import Effect, Param

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.config.schema.joint_values import JointValues


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
    rate: Tensor
    floor: Tensor

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
