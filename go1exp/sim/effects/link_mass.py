"""``effect=link_mass``: the moved links weigh more or less."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_GAIN_SETS, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("link_mass")
class LinkMass(Effect):
    """Mass and inertia of the link that a joint moves, scaled by one factor; its centre of mass stays.

    A link of another density. Published Go1 models differ by 12 % (thigh 0.90 to 1.01 kg, calf 0.196 to 0.218). In one
    pose the torque of gravity is also that of ``link_com``; ``strength`` scales it the other way round.
    """

    title = "a change of link mass"
    params = (Param("scale", "-", 0.5, 2.0, 1.0, 0.05, "joint", "mass over the model's"),)
    identification = Identification(
        nominal=True,
        rank=6,
        weighs_on_legs=True,
        uniform=True,
        confounded=("armature", "kp_scale", "strength"),
        separated_by=TWO_GAIN_SETS,
    )
    fields = ("body_mass", "body_inertia")
    scale: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Scale both."""
        links = model.ids("body", self.setup.joints)
        model.field("body_mass")[:, links] *= self.scale
        model.field("body_inertia")[:, links] *= self.scale.unsqueeze(-1)
