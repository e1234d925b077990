"""``effect=armature``: the rotors have more inertia."""

from __future__ import annotations

from typing import TYPE_CHECKING

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import TWO_GAIN_SETS, Identification

if TYPE_CHECKING:
    from torch import Tensor


@effect("armature")
class Armature(Effect):
    """Inertia that a joint has beyond that of the model: tau = -added qdd; the whole is nowhere negative.

    Reflected inertia of rotor and gears. Published Go1 models have 0.004 to 0.01 kg m2 for one and the same joint; the
    robot's configuration computes 0.0045 and 0.0101 from the vendor's rotor. It resembles ``payload`` or a smaller
    ``strength`` wherever inertia rules, and ``link_inertia`` but for the coupling between joints.
    """

    title = "rotor inertia"
    params = (Param("added", "kg m2", -0.01, 0.05, 0.0, 0.001, "joint", "inertia about the joint's axis"),)
    identification = Identification(
        nominal=True,
        rank=3,
        confounded=("kp_scale", "link_mass", "strength"),
        separated_by=TWO_GAIN_SETS,
    )
    fields = ("dof_armature",)
    added: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Add to the joints' own inertia."""
        inertia = model.field("dof_armature")[:, -self.added.shape[1] :]
        inertia.copy_((inertia + self.added).clamp(min=0.0))
