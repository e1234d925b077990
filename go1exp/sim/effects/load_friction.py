"""``effect=load_friction``: gears under load rub more."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("load_friction")
class LoadFriction(Effect):
    """Dry friction that grows with the load of the gears: bound + coefficient |drive torque - external * outside|.

    The drive's torque is what the motor makes, as the drive reports it, before the transmission; ``outside`` is the
    torque of the links' weight, Coriolis and centrifugal forces. ``external`` says how much of that counts. At 1 this
    is the law of Duclusaud et al. (BAM, arXiv 2410.08650), model M3: a weight that turns a joint whose drive is off
    rubs too, and one that is held counts twice. At other values it is the directional law of their M5, without its
    Stribeck part, with coefficients of the motor ``coefficient`` and of the load ``coefficient * external``. At 0 the
    load is the drive's torque alone, and a joint that is pushed while its drive is off has no such friction.

    BAM's files have 0.02 to 0.26 for servos at 1; at 0 a held weight takes twice that for the same friction. The forces
    on the feet of a robot that stands are not in ``outside``, so that its gears rub too little at 1. At a constant load
    this is ``coulomb``; in slow motion it resembles ``strength`` and ``kp_scale``. Identification tries 0 and 1.
    """

    title = "friction that grows with load"
    params = (
        Param("coefficient", "-", 0.0, 0.5, 0.0, 0.01, "joint", "friction per torque of the gears' load"),
        Param("external", "-", 0.0, 2.0, 0.0, math.inf, "joint", "share of the load from outside that counts"),
    )
    identification = Identification(
        laws=({"external": 0.0}, {"external": 1.0}),
        simpler="coulomb",
        excitation="slow_ramps",
        confounded=("coulomb",),
        told_apart_by="record slow_ramps through poses of different load, and torque_off",
    )
    coefficient: Tensor
    external: Tensor

    def on_load(self, bound: Tensor, torque: Tensor, outside: Tensor) -> Tensor:
        """Return the bound with the share of the load."""
        return bound + self.coefficient * (torque - self.external * outside).abs()
