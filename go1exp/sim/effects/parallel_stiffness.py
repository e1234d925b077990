"""``effect=parallel_stiffness``: a spring beside the actuator."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import LARGEST_ANGLE, LEAST_ANGLE, MEAN_ANGLE, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("parallel_stiffness")
class ParallelStiffness(Effect):
    """A spring between the links beside the actuator: tau = -stiffness (q - rest).

    Cables and covers: 0.5 to 5 N m/rad (estimate). It acts on the joint, so the actuator neither limits nor reports it;
    ``rest`` is the true angle without its torque. It resembles ``kp_scale`` and, within a small range of angles,
    gravity.
    """

    title = "a spring beside the actuator"
    params = (
        Param("stiffness", "N m/rad", 0.0, 20.0, 0.0, 0.1, "joint", "torque per angle"),
        Param("rest", "rad", -5.0, 5.0, 0.0, math.inf, "joint", "angle without torque"),
    )
    identification = Identification(
        shapes=tuple({"rest": angle} for angle in (MEAN_ANGLE, LEAST_ANGLE, LARGEST_ANGLE)),
        free_shapes=("rest",),
        excitation="slow_ramps",
    )
    stiffness: Tensor
    rest: Tensor

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the spring's torque."""
        return -self.stiffness * (q - self.rest)
