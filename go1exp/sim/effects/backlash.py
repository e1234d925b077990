"""``effect=backlash``: the gears between motor and joint have play."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Gears, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("backlash")
class Backlash(Effect):
    """The joint is free within a gap of the gears: no torque passes while |rotor angle - joint angle| < gap / 2.

    Flanks meet without bouncing; the drive reads the rotor. The law is that of ``sim/effects/two_mass.py``, where
    ``flexibility`` is in series. 5 to 40 mrad are likely (a judgement). It shows at reversals and as a small cycle at
    rest; within the gap the joint has lost its rotor, which ``armature`` mimics in part.
    """

    title = "play in the gears"
    params = (Param("gap", "rad", 0.0, 0.1, 0.0, 0.001, "joint", "free angle from flank to flank"),)
    identification = Identification(
        levels=({"gap": 0.002}, {"gap": 0.015}),
        excitation="slow_ramps",
    )
    gap: Tensor

    def on_gears(self, gears: Gears) -> Gears:
        """Add the gap."""
        return dataclasses.replace(gears, gap=gears.gap + self.gap)
