"""``effect=lag``: the motor's torque follows its demand gradually."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import SHARP_EDGES, Identification

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.config.schema.joint_values import JointValues


@effect("lag")
class Lag(Effect):
    """The motor's torque follows the demand as a first-order lag: time d(tau)/dt = demand - tau.

    The current loop's bandwidth: 2 to 15 ms (estimate). Solved exactly for a demand that changes linearly between
    two steps, so that no step makes it unstable and a time of zero is the demand itself. To first order the same as
    ``torque_delay``; fast chirps, which it damps and a delay does not, tell them apart. An episode begins settled.
    """

    title = "a lag of torque"
    params = (Param("time", "s", 0.0, 0.05, 0.0, 0.001, "joint", "time constant"),)
    identification = Identification(
        confounded=("torque_delay",),
        separated_by=SHARP_EDGES,
    )
    memory = ("_made", "_asked", "_fresh")
    order = 40
    time: Tensor

    def __init__(self, setup: ActuatorSetup, **values: JointValues) -> None:
        """Begin settled."""
        super().__init__(setup, **values)
        self._made, self._asked = setup.zeros(), setup.zeros()
        self._fresh = torch.ones(setup.num_envs, 1, dtype=torch.bool, device=setup.device)
        self._kept, self._before, self._now = setup.zeros(), setup.zeros(), setup.zeros()
        self._absent = torch.ones_like(self._kept, dtype=torch.bool)
        self.prepare()

    def prepare(self) -> None:
        """Work out the weights of torque made, last demand and demand."""
        steps = self.setup.physics_dt / self.time  # infinite at time 0, where only the demand counts
        self._kept.copy_(torch.exp(-steps))
        mean = -torch.expm1(-steps) / steps  # of the weight with which the past counts over the step
        self._before.copy_(mean - self._kept)
        self._now.copy_(1.0 - mean)
        self._absent.copy_(self.time == 0.0)

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque made, given the demand."""
        made = (self._kept * self._made).addcmul_(self._before, self._asked).addcmul_(self._now, torque)
        made = torch.where(self._fresh | self._absent, torque, made)
        self._made.copy_(made)
        self._asked.copy_(torque)
        self._fresh.zero_()
        return made

    def reset(self, mask: Tensor) -> None:
        """Begin settled at the next demand in the rows of ``mask`` (N,)."""
        self._fresh |= mask.unsqueeze(1)
