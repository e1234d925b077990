"""What holds or pulls the trunk: ``effect=base_tilt``, ``external_wrench``, ``soft_mount``."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, ClassVar

import torch

from go1exp.base.tensors.rotation import quat_multiply, rotate, rotate_inverse
from go1exp.config.schema.joint_values import JointValues
from go1exp.config.schema.registry import effect
from go1exp.robot import MOUNT, MOUNT_SLIDES
from go1exp.robot.actuators import ActuatorSetup, ModelFields
from go1exp.sim.effects.base import TWO_ATTITUDES, Effect, Identification, Measured, Param

if TYPE_CHECKING:
    from torch import Tensor


def _tilted(roll: Tensor, pitch: Tensor, v: Tensor) -> Tensor:
    """Express vectors (N, 3) in a frame turned by ``pitch`` about y and then, in itself, by ``roll`` about x."""
    roll, pitch = roll.squeeze(1).to(v.dtype), pitch.squeeze(1).to(v.dtype)
    x, y, z = v.unbind(-1)
    x, z = torch.cos(pitch) * x - torch.sin(pitch) * z, torch.sin(pitch) * x + torch.cos(pitch) * z
    y, z = torch.cos(roll) * y + torch.sin(roll) * z, torch.cos(roll) * z - torch.sin(roll) * y
    return torch.stack([x, y, z], dim=-1)


@effect("base_tilt")
class BaseTilt(Effect):
    """A held trunk hangs tilted, against what is believed; in one that is free the IMU sits tilted.

    Held: gravity turns in the trunk's frame, for the joints and for the IMU. Free: what the IMU says turns. Tilt: by
    ``pitch`` (nose down) and then by ``roll`` (left side up). 1 to 8 degrees are likely (estimate). A held robot's
    looks like an ``encoder_offset`` in one pose, and every leg feels the same; two orientations of the trunk tell.
    """

    title = "a tilt of the trunk"
    params = (
        Param("roll", "rad", -0.2, 0.2, 0.0, 0.0087, "robot", "left side up"),
        Param("pitch", "rad", -0.2, 0.2, 0.0, 0.0087, "robot", "nose down"),
    )
    identification = Identification(
        nominal=True,
        rank=9,
        excitation="slow_ramps",
        confounded=("encoder_offset", "link_com"),
        separated_by=TWO_ATTITUDES,
    )
    fields = ("opt.gravity",)

    def edit_model(self, model: ModelFields) -> None:
        """Turn gravity about a held trunk."""
        if self.setup.floating:
            return
        (trunk,) = model.ids("body", ("trunk",))
        gravity = model.field("opt.gravity")
        held = model.nominal("body_quat")[:, trunk].to(gravity)
        turned = rotate(held, _tilted(self.roll, self.pitch, rotate_inverse(held, gravity)))
        gravity.copy_(torch.where((self.roll == 0.0) & (self.pitch == 0.0), gravity, turned))

    def on_sensor(self, measured: Measured) -> Measured:
        """Turn what the IMU says; a held one feels gravity as it is, and tells an attitude to match."""
        names = ("gravity", "gyro", "acc") if self.setup.floating else ("gravity",)
        vectors = {name: getattr(measured, name) for name in names}
        readings = {name: _tilted(self.roll, self.pitch, v) for name, v in vectors.items() if v is not None}
        if measured.quat is not None:
            readings["quat"] = self._attitude(measured.quat)
        return dataclasses.replace(measured, **readings)

    def _attitude(self, quat: Tensor) -> Tensor:
        """Return the orientation (N, 4) of a frame that is tilted in the one of orientation ``quat``."""
        roll, pitch = 0.5 * self.roll.to(quat.dtype), 0.5 * self.pitch.to(quat.dtype)
        (sr, cr), (sp, cp) = (torch.sin(roll), torch.cos(roll)), (torch.sin(pitch), torch.cos(pitch))
        turned = quat_multiply(quat, torch.cat([cp * cr, cp * sr, sp * cr, -sp * sr], dim=1))  # pitch, then roll
        return torch.where((self.roll == 0.0) & (self.pitch == 0.0), quat, turned)


@effect("external_wrench")
class ExternalWrench(Effect):
    """A constant force (world frame) and torque (trunk frame) on the trunk: wind, a tether, a cable.

    0 to 20 N are likely (estimate). It adds to the acceleration of the trunk and turns with neither robot nor gait.
    A held trunk shows none of it. On a level robot a vertical one looks like a ``payload``, a horizontal one like a
    ``base_tilt``.
    """

    title = "an external force or torque"
    params = (
        Param("x", "N", -50.0, 50.0, 0.0, 1.0, "robot", "force along the world's x"),
        Param("y", "N", -50.0, 50.0, 0.0, 1.0, "robot", "along y"),
        Param("z", "N", -50.0, 50.0, 0.0, 1.0, "robot", "along z, up"),
        Param("roll", "N m", -10.0, 10.0, 0.0, 0.2, "robot", "torque about the trunk's x"),
        Param("pitch", "N m", -10.0, 10.0, 0.0, 0.2, "robot", "about y"),
        Param("yaw", "N m", -10.0, 10.0, 0.0, 0.2, "robot", "about z"),
    )
    identification = Identification(needs_ground=True, excitation="squat")

    def on_base(self, wrench: Tensor) -> Tensor:
        """Add force and torque."""
        return wrench + torch.cat([self.x, self.y, self.z, self.roll, self.pitch, self.yaw], dim=1)


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
