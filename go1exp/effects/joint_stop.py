"""``effect=joint_stop``: the hard stops of the joints yield."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.drive import ModelFields
from go1exp.effects.base import Effect, Param
from go1exp.effects.identification import Identification
from go1exp.schema.registry import effect

if TYPE_CHECKING:
    from torch import Tensor


NULL = 0.02
"""MuJoCo's own time constant of a joint limit, s."""


@effect("joint_stop")
class JointStop(Effect):
    """Softness of the hard stops, as the time constant of MuJoCo's spring-damper beyond a joint's range.

    Rubber yields where a casting does not. It shows at the stops and nowhere else, where ``torque_speed_limit`` may act
    too. Below twice the physics step MuJoCo raises it to that.
    """

    title = "softness of the joint stops"
    params = (Param("time_constant", "s", 0.004, 0.2, NULL, 0.003, "joint", "of the stop's spring-damper"),)
    identification = Identification(
        levels=({"time_constant": 0.006}, {"time_constant": 0.03}),
        excitation="steps",
    )
    fields = ("jnt_solref",)
    time_constant: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Set it; the driven joints are the model's last."""
        stops = model.field("jnt_solref")[:, -self.time_constant.shape[1] :, 0]
        stops.copy_(torch.where(self.time_constant != NULL, self.time_constant, stops))
