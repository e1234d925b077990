"""``effect=foot_friction``: another friction of the feet."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp import robot
from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor

FEET = tuple(f"{leg}_foot" for leg in robot.LEGS)


@effect("foot_friction")
class FootFriction(Effect):
    """Sliding friction of the feet, scaled: a foot slips beyond scale x mu x the normal force of its contact.

    The model's foot has mu = 0.8 and the higher priority in a contact, so that its value is the contact's, whatever it
    stands on. Real ground has 0.3 to 1.2. A randomisation of ``foot_friction`` with ``operation: scale`` starts from
    this; with ``set`` it replaces this. It shows while a foot slips only, and resembles a slope of the ground.
    """

    title = "a change of foot friction"
    params = (Param("scale", "-", 0.1, 2.5, 1.0, 0.1, "robot", "friction over the model's"),)
    identification = Identification(
        nominal=True,
        rank=22,
        needs_ground=True,
        levels=({"scale": -0.3}, {"scale": 0.3}),
        excitation="squat",
    )
    fields = ("geom_friction",)
    scale: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Scale it."""
        model.field("geom_friction")[:, model.ids("geom", FEET), 0] *= self.scale
