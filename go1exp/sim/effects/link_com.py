"""``effect=link_com``: the centre of mass of the moved links is elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_ATTITUDES, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("link_com")
class LinkCom(Effect):
    """Centre of mass of the link that a joint moves, shifted in that link's frame; mass and inertia about it stay.

    By ``forward`` and ``left`` along its x and y axes, and by ``along`` against z, which is down the leg: with all
    joints of a Go1 at zero the legs hang straight and every link has the trunk's axes. 1 to 20 mm are likely, along
    the calf from the mass of the foot, across from motors and cables (estimate). A shift along a joint's own axis
    does not turn that joint. In one pose the torque of gravity is also that of ``link_mass``, of an
    ``encoder_offset`` or of ``base_tilt``.
    """

    title = "a shift of link mass"
    params = (
        Param("along", "m", -0.05, 0.05, 0.0, 0.002, "joint", "shift away from the trunk"),
        Param("forward", "m", -0.05, 0.05, 0.0, 0.002, "joint", "shift along the link's x axis"),
        Param("left", "m", -0.05, 0.05, 0.0, 0.002, "joint", "shift along the link's y axis"),
    )
    identification = Identification(
        nominal=True,
        rank=7,
        confounded=("base_tilt", "encoder_offset"),
        separated_by=TWO_ATTITUDES,
    )
    fields = ("body_ipos",)
    along: Tensor
    forward: Tensor
    left: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Shift it."""
        shift = torch.stack([self.forward, self.left, -self.along], dim=-1)
        model.field("body_ipos")[:, model.ids("body", self.setup.joints)] += shift
