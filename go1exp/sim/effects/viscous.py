"""``effect=viscous``: friction in proportion to speed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_KD, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("viscous")
class Viscous(Effect):
    """Friction in proportion to the joint's speed: tau = -damping qd.

    Published Go1 models have 0.01 to 0.5 N m s/rad, the larger ones in place of kd. It acts on the joint, not in the
    drive: the drive's torque limit and its report do not include it. While the drive does not saturate it cannot be
    told from a larger kd (``kd_scale``), unless kd is varied, the drive switched off or its torque measured well.
    """

    title = "viscous friction"
    params = (Param("damping", "N m s/rad", 0.0, 2.0, 0.0, 0.02, "joint", "torque per speed"),)
    identification = Identification(
        nominal=True,
        rank=5,
        excitation="torque_off",
        confounded=("kd_scale",),
        told_apart_by=TWO_KD,
    )
    damping: Tensor

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque against the motion."""
        return -self.damping * qd
