"""``effect=point_load``: something hangs on a link."""

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


@effect("point_load")
class PointLoad(Effect):
    """A point mass on the link that a joint moves, at (x, y, z) in its frame: mass, centre, inertia change (Steiner).

    A boot, a sensor at the foot, a cable clamp on the shank: 0.01 to 0.3 kg are likely (a judgement); the tolerance is
    a twentieth of a Go1's calf, the bound the mass of its thigh twice. At its null place it hangs where a Go1's thigh
    and calf end, 0.213 m from their joints. At the link's centre of mass it is ``link_mass``, but without its inertia;
    elsewhere ``link_mass`` and ``link_com`` make its weight, and ``link_inertia`` what is left of it.
    """

    title = "a point load on a link"
    params = (
        Param("mass", "kg", 0.0, 2.0, 0.0, 0.01, "joint", "mass carried"),
        Param("x", "m", -0.4, 0.4, 0.0, math.inf, "joint", "its place, along the link's x axis"),
        Param("y", "m", -0.4, 0.4, 0.0, math.inf, "joint", "along y"),
        Param("z", "m", -0.4, 0.4, -0.213, math.inf, "joint", "along z; the foot of a Go1 is at -0.213"),
    )
    identification = Identification(
        shapes=({"z": -0.213}, {"z": -0.1}, {"z": 0.1}, {"x": 0.1, "z": 0.0}, {"x": -0.1, "z": 0.0}),
        free_shapes=("x", "y", "z"),
        simpler="link_mass",
        confounded=("link_com", "link_inertia", "link_mass"),
        told_apart_by="record a chirp and slow_ramps at two attitudes of the trunk (hang=[[0,0],[0,0.5]])",
    )
    fields = FIELDS
    order = 10  # after what changes the link's own mass and centre
    mass: Tensor
    x: Tensor
    y: Tensor
    z: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Join it to the link."""
        place = torch.stack([self.x, self.y, self.z], dim=-1)
        join(model, model.ids("body", self.setup.joints), self.mass, place)
