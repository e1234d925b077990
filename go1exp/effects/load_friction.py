"""``effect=load_friction``: gears under load rub more."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.effects.base import Effect, Param
from go1exp.effects.identification import Identification
from go1exp.schema.registry import effect

if TYPE_CHECKING:
    from torch import Tensor


@effect("load_friction")
class LoadFriction(Effect):
    """Dry friction that grows with the load of the gears: bound = bound + coefficient |drive torque|.

    Load is what the motor makes, as the drive reports it, before the transmission. The gears of a joint that is held or
    moves steadily carry just that; while the rotor speeds up they carry less, by its inertia times its acceleration,
    and a joint that is pushed while its drive is off has, by this law, no such friction. BAM (ICRA 2025; model M3)
    takes |motor torque - external torque| for the load, which for a held weight is twice this, so that its coefficient
    is half of this one. It finds 0.02 to 0.25 for servos. At a constant load it is ``coulomb``; in slow motion it
    resembles ``strength`` and ``kp_scale``.
    """

    title = "friction that grows with load"
    params = (Param("coefficient", "-", 0.0, 0.5, 0.0, 0.01, "joint", "friction per torque of the drive"),)
    identification = Identification(simpler="coulomb", excitation="slow_ramps")
    coefficient: Tensor

    def on_friction(self, bound: Tensor, torque: Tensor, qd: Tensor) -> Tensor:
        """Return the bound with the share of the drive's torque."""
        return bound + self.coefficient * torque.abs()
