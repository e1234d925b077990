"""``effect=quadratic_drag``: friction in proportion to the square of speed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param

if TYPE_CHECKING:
    from torch import Tensor


@effect("quadratic_drag")
class QuadraticDrag(Effect):
    """Friction in proportion to the square of the joint's speed: tau = -drag qd |qd|.

    Churned grease and air. Ranges of 0 to 0.05 N m s2/rad2 are likely (a judgement); at 10 rad/s the tolerance is 0.2 N
    m. Only fast motion shows it; there it resembles ``viscous`` and a torque that falls with speed
    (``torque_speed_limit``).
    """

    title = "drag that grows with the square of speed"
    params = (Param("drag", "N m s2/rad2", 0.0, 0.05, 0.0, 0.002, "joint", "torque per speed squared"),)
    drag: Tensor

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the torque against the motion."""
        return -self.drag * qd * qd.abs()
