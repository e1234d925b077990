"""``effect=com_offset``: the trunk's centre of mass is elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("com_offset")
class ComOffset(Effect):
    """Centre of mass of the trunk, shifted in its own frame by (x, y, z).

    Cables, batteries and computers are not where the drawing has them: up to 50 mm are randomised (MuJoCo Playground;
    the paper, 25 mm). A held trunk shows none of it. Standing, it looks like ``base_tilt`` or a ``payload``.
    """

    title = "a shift of the trunk's centre of mass"
    params = (
        Param("x", "m", -0.1, 0.1, 0.0, 0.005, "robot", "shift forward"),
        Param("y", "m", -0.1, 0.1, 0.0, 0.005, "robot", "shift to the left"),
        Param("z", "m", -0.1, 0.1, 0.0, 0.005, "robot", "shift up"),
    )
    identification = Identification(nominal=True, rank=21, needs_ground=True, excitation="squat")
    fields = ("body_ipos",)
    x: Tensor
    y: Tensor
    z: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Shift it."""
        shift = torch.cat([self.x, self.y, self.z], dim=1)
        model.field("body_ipos")[:, model.ids("body", ("trunk",))] += shift.unsqueeze(1)
