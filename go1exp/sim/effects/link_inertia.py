"""``effect=link_inertia``: the moved links resist turning more or less."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Param

if TYPE_CHECKING:
    from torch import Tensor


@effect("link_inertia")
class LinkInertia(Effect):
    """Rotational inertia of the link that a joint moves, about its centre of mass, scaled by one factor.

    Mass that sits further from, or nearer to, the centre than the model says: +-20 % are likely (estimate). It shows
    at fast motion only, like ``armature``, from which the coupling between joints tells it.
    """

    title = "a change of link inertia"
    params = (Param("scale", "-", 0.5, 2.0, 1.0, 0.1, "joint", "inertia over the model's"),)
    fields = ("body_inertia",)
    scale: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Scale it."""
        model.field("body_inertia")[:, model.ids("body", self.setup.joints)] *= self.scale.unsqueeze(-1)
