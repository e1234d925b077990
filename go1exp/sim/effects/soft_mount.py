"""``effect=soft_mount``: a compliant mount of the trunk."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

import torch

from go1exp.config.schema.joint_values import JointValues
from go1exp.config.schema.registry import effect
from go1exp.robot import MOUNT, MOUNT_SLIDES
from go1exp.robot.actuators import ActuatorSetup, ModelFields
from go1exp.sim.effects.base import Effect, Param
from go1exp.sim.effects.identification import Identification

if TYPE_CHECKING:
    from torch import Tensor

RIGID = "record a chirp with the trunk fixed to something heavy"

RESOLVED = 0.1
"""Square of the largest frequency of the mount, in radians per physics step, that is left as it is."""

FIXED = 1.0e9
"""Inertia, kg or kg m2, of a direction in which a trunk is fixed while it yields in others: legs move it by 1e-8."""


@effect("soft_mount")
class SoftMount(Effect):
    """A held trunk hangs in straps or on a stand that yields: on springs and dampers about the pose it is held in.

    In each direction: deflection = compliance load at rest, and a damping ratio of ``damping`` with the legs straight.
    ``sway`` along the world's x and y, ``heave`` along z, ``roll`` and ``pitch`` about the trunk's axes. The
    weight is borne without deflection. Legs that swing push the trunk, and all legs feel it. Straps of half a metre
    let 12 kg sway by 0.004 m/N, at 0.7 Hz; stands turn by 0.001 to 0.01 rad/(N m) (estimate). The model has joints
    of the trunk for it (``sim/physics/scene.py``) where the effect is not null; a trunk that is free, and the simulated
    robot of ``go1exp deploy``, feel nothing. It looks like ``base_tilt``, ``link_com`` and ``armature``.

    A spring that the physics step cannot resolve is given inertia until it can; with compliance 0 that is ``FIXED``.
    """

    title = "a compliant mount of the trunk"
    params = (
        Param("sway", "m/N", 0.0, 0.01, 0.0, 2e-5, "robot", "deflection along x and y per force"),
        Param("heave", "m/N", 0.0, 0.005, 0.0, 2e-5, "robot", "along z"),
        Param("roll", "rad/(N m)", 0.0, 0.2, 0.0, 5e-4, "robot", "turn about the trunk's x per torque"),
        Param("pitch", "rad/(N m)", 0.0, 0.2, 0.0, 5e-4, "robot", "about y"),
        Param("damping", "-", 0.01, 1.0, 0.1, math.inf, "robot", "damping ratio"),
    )
    identification = Identification(
        needs_stand=True,
        levels=(
            {"sway": 4e-5, "heave": 4e-5, "roll": 0.001, "pitch": 0.001},
            {"roll": 0.02, "pitch": 0.02},
            {"sway": 1e-3, "heave": 5e-4, "roll": 0.02, "pitch": 0.02},
        ),
        free_shapes=("damping",),
        confounded=("base_tilt", "link_com", "armature"),
        separated_by=RIGID,
    )
    fields: ClassVar[tuple[str, ...]] = (
        *("jnt_stiffness", "dof_damping", "dof_armature", "qpos_spring", "opt.tolerance"),
        *("body_mass", "opt.gravity"),  # to read what other effects have made of them
    )
    mounts = True
    order = 1  # after those that change masses and gravity
    sway: Tensor
    heave: Tensor
    roll: Tensor
    pitch: Tensor
    damping: Tensor

    def __init__(self, setup: ActuatorSetup, **values: JointValues) -> None:
        """Leave the model as it is where there is no mount in it."""
        super().__init__(setup, **values)
        if not setup.mounted:
            self.fields = ()  # type: ignore[misc]  # this robot's own

    @property
    def compliance(self) -> Tensor:
        """(N, 5) in the order of ``robot.MOUNT``, m/N and rad/(N m)."""
        return torch.cat([self.sway, self.sway, self.heave, self.roll, self.pitch], dim=1)

    def edit_model(self, model: ModelFields) -> None:
        """Give the mount's joints their springs and dampers."""
        if not self.setup.mounted:
            return
        stiffness, damping, armature = (model.field(n) for n in ("jnt_stiffness", "dof_damping", "dof_armature"))
        dt, soft = self.setup.physics_dt, self.compliance > 0.0
        k = torch.where(soft, 1.0 / self.compliance, 0.0)
        whole = model.nominal("dof_M0").to(k)
        mount, slides = slice(len(MOUNT)), slice(len(MOUNT_SLIDES))
        inertia, legs = whole[:, mount], whole[:, len(MOUNT) :].sum()
        added = torch.where(soft, (k * dt**2 / RESOLVED - inertia).clamp(min=0.0), FIXED)
        stiffness[:, mount], armature[:, mount] = k, added
        damping[:, mount] = 2.0 * self.damping * torch.sqrt(k * (inertia + added))
        # The engine solves friction and stops to a tolerance in units of all inertia, and the legs' is what counts.
        model.field("opt.tolerance").mul_(legs / (legs + (inertia + added).sum(1)))
        weight = model.field("body_mass").sum(1, keepdim=True) * model.field("opt.gravity")
        model.field("qpos_spring")[:, slides] = -self.compliance[:, slides] * weight
