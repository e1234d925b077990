"""``effect=kp_scale``: the position gain of the actuators is off."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_GAIN_SETS, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("kp_scale", gains=True)
class KpScale(Effect):
    """The actuators' position gain is a multiple of the configured one: kp = scale kp.

    Walk-these-ways randomises 0.8 to 1.3; +-5 to 30 % are likely (estimate). At rest it is not identifiable
    against ``strength``, in a narrow band not against ``command_delay``. New values count from ``Plant.refresh`` on.
    """

    title = "a change of the position gain"
    params = (Param("scale", "-", 0.2, 2.0, 1.0, 0.1, "joint", "real gain over configured gain"),)
    identification = Identification(
        nominal=True,
        rank=0,
        weighs_on_legs=True,
        uniform=True,
        confounded=("armature", "link_mass", "strength"),
        separated_by=TWO_GAIN_SETS,
    )
    scale: Tensor

    def on_gains(self, kp: Tensor, kd: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gains with the real kp."""
        return kp * self.scale, kd
