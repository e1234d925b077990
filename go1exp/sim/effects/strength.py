"""``effect=strength``: the motor's torque constant is off."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_GAIN_SETS, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("strength")
class Strength(Effect):
    """The motor makes a multiple of the torque that its actuator asks for: tau = scale demand.

    Walk-these-ways randomises 0.9 to 1.1 on a Go1; +-5 to 30 % are likely (estimate). Slow motion cannot tell it
    from ``kp_scale``, and dynamics scaled the other way round (payload and armature together) look much the same.
    """

    title = "a change of actuator strength"
    params = (Param("scale", "-", 0.3, 1.5, 1.0, 0.05, "joint", "torque made over torque asked for"),)
    identification = Identification(
        nominal=True,
        rank=2,
        weighs_on_legs=True,
        uniform=True,
        confounded=("armature", "kp_scale", "link_mass"),
        separated_by=TWO_GAIN_SETS,
    )
    order = 10
    scale: Tensor

    def on_actuator(self, torque: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque made."""
        return torque * self.scale
