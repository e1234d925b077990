"""``effect=fixed_point``: gains and torques travel to the actuators as whole numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.robot.go1_fields import KD_STEP, KP_STEP, TORQUE_STEP
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_KD, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("fixed_point", gains=True)
class FixedPoint(Effect):
    """Gains, feed-forward torques and reported torques are cut towards zero to whole steps, ``steps`` times a Go1's.

    A Go1's packets carry kp in steps of 1/32 N m/rad, kd of 1/16 N m s/rad, torque of 1/256 N m both ways
    (``robot/go1_fields.py``, read off the vendor's client), so that kd = 0.3 becomes 0.25 and kd = 0.5 stays. Targets
    are floats and stay as they are. The torque that acts is not cut, only what the actuator reports of it: policies
    that observe it, recordings and the replay of ``gap`` have its steps. The packets' range is never reached by a Go1.
    What moves differently are gains and torques that are fed forward, so recordings at one gain cannot tell it from
    ``kp_scale``, ``kd_scale``, ``viscous``.
    """

    title = "fixed-point numbers in commands and reported torques"
    params = (Param("steps", "-", 0.0, 8.0, 0.0, 1.0, "robot", "steps over those of a Go1's packets; 0: none"),)
    identification = Identification(
        levels=({"steps": 4.0},),
        excitation="torque_off",
        confounded=("viscous",),
        separated_by=TWO_KD,
    )
    order = -10
    steps: Tensor

    def _cut(self, values: Tensor, step: float) -> Tensor:
        """Return values (N, J) in whole steps, towards zero; as they are where there are none."""
        size = self.steps * step
        return torch.where(size > 0.0, torch.trunc(values / size) * size, values)

    def on_feedforward(self, torque: Tensor) -> Tensor:
        """Return the torque that the packets carry."""
        return self._cut(torque, TORQUE_STEP)

    def on_report(self, torque: Tensor) -> Tensor:
        """Return the torque that the packets carry back."""
        return self._cut(torque, TORQUE_STEP)

    def on_gains(self, kp: Tensor, kd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gains that the packets carry."""
        return self._cut(kp, KP_STEP), self._cut(kd, KD_STEP)
