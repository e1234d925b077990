"""Contact of the feet: ``effect=foot_friction``, ``ground_compliance``."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from go1exp import robot
from go1exp.config.schema.physics import ContactConfig
from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Identification, Param


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
        nominal=True, rank=22, needs_ground=True, levels=({"scale": -0.3}, {"scale": 0.3}), excitation="squat"
    )
    fields = ("geom_friction",)

    def edit_model(self, model: ModelFields) -> None:
        """Scale it."""
        model.field("geom_friction")[:, model.ids("geom", robot.FEET), 0] *= self.scale


NULL = 0.0
"""Leaves the time constant of the model, that of ``contact``."""

LEAST = 0.004
"""Smallest time constant that a step of 2 ms carries, s."""


@effect("ground_compliance")
class GroundCompliance(Effect):
    """Softness of the feet's contacts, as the time constant of MuJoCo's spring-damper: a foot sinks as its square.

    Stiffness is 1 / (time_constant damping_ratio)^2 per effective mass (MuJoCo, "solver parameters"); the damping ratio
    stays, so a randomisation of ``foot_restitution``, which sets that one, acts as well. Below twice the physics step
    MuJoCo raises it to that. 0 leaves that of ``contact``. It shows at touch-down and in the height of the stance, like
    a foot of another radius.
    """

    title = "compliance of the ground"
    params = (
        Param("time_constant", "s", NULL, 0.1, NULL, 0.003, "robot", "of the contact's spring-damper", least=LEAST),
    )
    identification = Identification(
        nominal=True,
        rank=23,
        needs_ground=True,
        levels=({"time_constant": 0.01}, {"time_constant": -0.008}),
        excitation="drop",
    )
    fields = ("geom_solref",)

    @classmethod
    def nominal(cls, contact: ContactConfig) -> Mapping[str, float]:
        """Return the contact's own time constant."""
        return {"time_constant": contact.time_constant}

    def edit_model(self, model: ModelFields) -> None:
        """Set the feet's, which have priority in a contact."""
        feet = model.ids("geom", robot.FEET)
        before = model.field("geom_solref")[:, feet, 0]
        changed = self.time_constant != NULL
        model.field("geom_solref")[:, feet, 0] = torch.where(changed, self.time_constant, before)
