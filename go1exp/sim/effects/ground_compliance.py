"""``effect=ground_compliance``: the feet sink into the ground."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch

from go1exp import robot
from go1exp.config.schema.physics import ContactConfig
from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor

FEET = tuple(f"{leg}_foot" for leg in robot.LEGS)

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
    time_constant: Tensor

    @classmethod
    def nominal(cls, contact: ContactConfig) -> Mapping[str, float]:
        """Return the contact's own time constant."""
        return {"time_constant": contact.time_constant}

    def edit_model(self, model: ModelFields) -> None:
        """Set the feet's, which have priority in a contact."""
        feet = model.ids("geom", FEET)
        before = model.field("geom_solref")[:, feet, 0]
        changed = self.time_constant != NULL
        model.field("geom_solref")[:, feet, 0] = torch.where(changed, self.time_constant, before)
