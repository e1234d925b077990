"""``effect=link_com``: the centre of mass of the moved links is elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.drive import ModelFields
from go1exp.effects.base import Effect, Param
from go1exp.effects.identification import TWO_ATTITUDES, Identification
from go1exp.schema.registry import effect

if TYPE_CHECKING:
    from torch import Tensor


@effect("link_com")
class LinkCom(Effect):
    """Centre of mass of the link that a joint moves, shifted down the leg: by ``along`` against the link's z axis.

    With all joints at zero the legs hang straight and every link's z axis points up. 1 to 20 mm are likely, at the calf
    from the mass of the foot (a judgement). In one pose the torque of gravity is also that of ``link_mass``, of an
    ``encoder_offset`` or of ``base_tilt``.
    """

    title = "a shift of link mass"
    params = (Param("along", "m", -0.05, 0.05, 0.0, 0.002, "joint", "shift away from the trunk"),)
    identification = Identification(
        nominal=True,
        rank=7,
        confounded=("base_tilt", "encoder_offset"),
        told_apart_by=TWO_ATTITUDES,
    )
    fields = ("body_ipos",)
    along: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Shift it."""
        model.field("body_ipos")[:, model.ids("body", self.setup.joints), 2] -= self.along
