"""``effect=asymmetric_friction``: dry friction that depends on the direction."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("asymmetric_friction")
class AsymmetricFriction(Effect):
    """Further dry friction, ``forward`` while the angle grows and ``backward`` while it falls.

    tau = -forward at qd > 0, +backward at qd < 0, and anything between the two to hold a joint at rest. That is,
    exactly and at rest too, a symmetric bound and a constant torque::

        tau = -(forward + backward) / 2 sign(qd) + (backward - forward) / 2

    The bound goes to the joint's dry friction, the constant acts on the joint; neither half alone is friction, together
    they only brake. So data cannot tell this effect from ``coulomb`` with a constant torque, such as that of an
    ``encoder_offset`` in one pose. Differences of up to 0.6 N m are likely (a judgement).
    """

    title = "dry friction that depends on direction"
    params = (
        Param("forward", "N m", 0.0, 2.0, 0.0, 0.05, "joint", "further friction while the angle grows"),
        Param("backward", "N m", 0.0, 2.0, 0.0, 0.05, "joint", "further friction while the angle falls"),
    )
    identification = Identification(
        simpler="coulomb", simpler_if_equal=("forward", "backward"), excitation="slow_ramps"
    )
    forward: Tensor
    backward: Tensor

    def on_joint(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the constant half of the difference."""
        return 0.5 * (self.backward - self.forward)

    def on_friction(self, bound: Tensor, torque: Tensor, qd: Tensor) -> Tensor:
        """Return the bound with the mean of both directions."""
        return bound + 0.5 * (self.forward + self.backward)
