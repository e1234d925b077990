"""``effect=kd_scale``: the velocity gain of the actuators is off."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_KD, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("kd_scale", gains=True)
class KdScale(Effect):
    """The actuators' velocity gain is a multiple of the configured one: kd = scale kd.

    Walk-these-ways randomises 0.5 to 1.5; +-15 to 75 % are likely (estimate). While the actuator does not saturate it
    is ``viscous``, unless kd is varied or the torque is measured well; and ``torque_delay`` takes kp delay away from
    kd. New values count from ``Plant.refresh`` on.
    """

    title = "a change of the velocity gain"
    params = (Param("scale", "-", 0.0, 3.0, 1.0, 0.15, "joint", "real gain over configured gain"),)
    identification = Identification(
        nominal=True,
        rank=1,
        excitation="torque_off",
        confounded=("viscous",),
        separated_by=TWO_KD,
    )
    scale: Tensor

    def on_gains(self, kp: Tensor, kd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gains with the real kd."""
        return kp, kd * self.scale
