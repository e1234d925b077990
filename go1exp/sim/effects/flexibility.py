"""``effect=flexibility``: the gears between motor and joint are a spring."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Gears, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("flexibility")
class Flexibility(Effect):
    """The gears twist under load: rotor angle - joint angle = compliance torque, and the drive reads the rotor.

    Rotor and joint swing against each other at sqrt((1 / J_rotor + 1 / J_joint) / compliance); the law is that of
    ``sim/effects/two_mass.py``. Stiffnesses of 60 to 400 N m/rad are likely at robots of this size (a judgement). Dry
    friction stays at the joint. To a slow drive it looks like a smaller kp, below the resonance like ``lag`` or
    ``armature``. A drive with kd > J_rotor / physics step (2.2 N m s/rad for a hip at 2 ms)
    shakes the rotor.
    """

    title = "compliance of the gears"
    params = (
        Param("compliance", "rad/(N m)", 0.0, 0.02, 0.0, 5e-4, "joint", "twist per torque"),
        Param("damping", "-", 0.02, 1.0, 0.05, math.inf, "joint", "damping ratio of the rotor on this spring"),
    )
    identification = Identification(
        levels=({"compliance": 0.001}, {"compliance": 0.004}),
    )
    compliance: Tensor
    damping: Tensor

    def on_gears(self, gears: Gears) -> Gears:
        """Add the compliance."""
        return dataclasses.replace(gears, compliance=gears.compliance + self.compliance, damping=self.damping)
