"""``effect=payload``: the trunk carries something."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification
from go1exp.sim.effects.point_mass import FIELDS, join

if TYPE_CHECKING:
    from torch import Tensor


@effect("payload")
class Payload(Effect):
    """A point mass on the trunk at (x, y, z) in its frame: mass, centre and inertia change together (Steiner).

    Walk-these-ways randomises -1 to 3 kg; published Go1 models disagree by 0.4 kg about the trunk itself. A negative
    mass is taken away; the largest is four fifths of the robot's own 12.7 kg. A held trunk shows none of it. Fast
    motion resembles ``strength`` the other way round; standing, its place looks like ``com_offset``.
    """

    title = "a payload on the trunk"
    params = (
        Param("mass", "kg", -1.0, 10.0, 0.0, 0.2, "robot", "mass carried"),
        Param("x", "m", -0.3, 0.3, 0.0, math.inf, "robot", "its place, forward of the trunk's origin"),
        Param("y", "m", -0.2, 0.2, 0.0, math.inf, "robot", "to the left"),
        Param("z", "m", -0.2, 0.3, 0.1, math.inf, "robot", "up; 0.1 lies on top"),
    )
    identification = Identification(
        nominal=True,
        rank=20,
        needs_ground=True,
        free_shapes=("x", "y", "z"),
        excitation="squat",
    )
    fields = FIELDS
    order = 10  # after a shift of the trunk's own centre
    mass: Tensor
    x: Tensor
    y: Tensor
    z: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Join the point mass to the trunk."""
        place = torch.cat([self.x, self.y, self.z], dim=1).unsqueeze(1)
        join(model, model.ids("body", ("trunk",)), self.mass, place)
