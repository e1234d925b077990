"""``effect=coulomb``: dry friction."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("coulomb")
class Coulomb(Effect):
    """Dry friction of a joint: up to ``bound`` against the motion, and as much as needed to hold a joint at rest.

    tau = -bound sign(qd). Coulomb (1785); MuJoCo's ``frictionloss``, a constraint that is solved with the motion, so
    that a joint sticks without creeping or chattering. Published Go1 models have 0.2 to 1.0 N m. Slow motion in one
    direction cannot tell it from ``viscous``, a constant load not from ``load_friction``. New values count from
    ``Plant.refresh`` on.
    """

    title = "dry friction"
    params = (Param("bound", "N m", 0.0, 3.0, 0.0, 0.05, "joint", "friction torque"),)
    identification = Identification(nominal=True, rank=4, excitation="slow_ramps")
    fields = ("dof_frictionloss",)
    bound: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Raise the friction bound of the joints."""
        model.field("dof_frictionloss")[:, -self.bound.shape[1] :] += self.bound
