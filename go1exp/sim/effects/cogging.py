"""``effect=cogging``: torque that is periodic in the angle."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification, Periodic

if TYPE_CHECKING:
    from torch import Tensor


@effect("cogging")
class Cogging(Effect):
    """A torque that is periodic in the joint's angle: tau = amplitude sin(count q + phase).

    Slots that attract magnets, teeth that mesh. Amplitudes of 0.1 to 0.8 N m are likely (estimate). ``count``
    periods make one turn of the joint; its usual value of 38 is six for each turn of a rotor behind the Go1's gear
    ratio of 6.333, an assumption (not published). It conserves energy, but data that are not sorted by
    angle show it as ``coulomb``. A step must not skip a period: count times speed times step should stay below 1.
    """

    title = "cogging torque"
    params = (
        Param("amplitude", "N m", 0.0, 2.0, 0.0, 0.05, "joint", "largest torque"),
        Param("count", "-", 1.0, 150.0, 38.0, math.inf, "joint", "periods per turn of the joint"),
        Param("phase", "rad", -math.pi, math.pi, 0.0, math.inf, "joint", "phase at angle zero"),
    )
    identification = Identification(
        # Over a radian of motion, neighbouring counts differ by half a period.
        periodic=Periodic("amplitude", "phase", "count", counts=tuple(float(count) for count in range(18, 64, 3))),
        free_shapes=("phase", "count"),
        excitation="slow_ramps",
    )
    amplitude: Tensor
    count: Tensor
    phase: Tensor

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque at this angle."""
        return self.amplitude * torch.sin(self.count * q + self.phase)
