"""``effect=dead_band``: an actuator does nothing about small errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_GAIN_SETS, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("dead_band")
class DeadBand(Effect):
    """Within ``band`` of its target an actuator takes the angle that its encoder reads for the target.

    Servos have it so that they do not buzz at rest: Feetech's STS3215 by a register of 0 to 32 steps of its encoder
    (1.5 mrad each, so 0.05 rad, the bound), one of which it is delivered with. Beyond it the whole error counts, and
    the torque jumps by kp times the band. A joint at rest resembles one with ``coulomb`` friction or ``backlash``; the
    torque that it begins with grows with kp here, and not there.
    """

    title = "a dead band of the actuator"
    params = (Param("band", "rad", 0.0, 0.05, 0.0, 0.001, "joint", "largest error that is left alone"),)
    identification = Identification(
        levels=({"band": 0.002}, {"band": 0.005}, {"band": 0.015}, {"band": 0.03}),
        excitation="slow_ramps",
        confounded=("coulomb", "backlash"),
        separated_by=TWO_GAIN_SETS,
    )
    band: Tensor

    def on_error(self, target: Tensor, q: Tensor) -> Tensor:
        """Return the target, or the angle where that is as good."""
        return torch.where((target - q).abs() > self.band, target, torch.where(self.band > 0.0, q.to(target), target))
