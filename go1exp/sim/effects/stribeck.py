"""``effect=stribeck``: friction is larger near rest."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("stribeck")
class Stribeck(Effect):
    """Dry friction that fades with speed: bound = bound + strength exp(-(|qd| / speed)^exponent).

    Stribeck (1902): a film of lubricant carries a joint that moves. A joint breaks away late and with a jerk. It comes
    on top of ``coulomb``, from which slow and fast motion together tell it. Friction models of servos have speeds of
    0.1 to 1 rad/s and exponents of 1 upwards (BAM, ICRA 2025); LuGre's exponent is 2.
    """

    title = "friction that falls with speed"
    params = (
        Param("strength", "N m", 0.0, 2.0, 0.0, 0.05, "joint", "further friction at rest"),
        Param("speed", "rad/s", 0.01, 2.0, 0.2, math.inf, "joint", "speed at which exp(-1) of it is left"),
        Param("exponent", "-", 0.5, 4.0, 2.0, math.inf, "joint", "how suddenly it fades"),
    )
    identification = Identification(
        shapes=({"speed": 0.1}, {"speed": 0.5}),
        free_shapes=("speed",),
        simpler="coulomb",
        excitation="slow_ramps",
    )
    strength: Tensor
    speed: Tensor
    exponent: Tensor

    def on_friction(self, bound: Tensor, torque: Tensor, qd: Tensor) -> Tensor:
        """Return the bound with what is left of the further friction."""
        return bound + self.strength * torch.exp(-((qd.abs() / self.speed) ** self.exponent))
