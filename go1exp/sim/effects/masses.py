"""Masses and inertias of trunk and links: ``effect=payload``, ``link_mass``, ``armature`` and others."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import effect
from go1exp.robot.actuators import ModelFields
from go1exp.sim.effects.base import TWO_ATTITUDES, TWO_GAIN_SETS, Effect, Identification, Param

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
        nominal=True, rank=3, confounded=("kp_scale", "link_mass", "strength"), separated_by=TWO_GAIN_SETS
    )
    fields = ("dof_armature",)

    def edit_model(self, model: ModelFields) -> None:
        """Add to the joints' own inertia."""
        inertia = model.field("dof_armature")[:, -self.added.shape[1] :]
        inertia.copy_((inertia + self.added).clamp(min=0.0))


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

    def edit_model(self, model: ModelFields) -> None:
        """Shift it."""
        shift = torch.cat([self.x, self.y, self.z], dim=1)
        model.field("body_ipos")[:, model.ids("body", ("trunk",))] += shift.unsqueeze(1)


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
        nominal=True, rank=7, confounded=("base_tilt", "encoder_offset"), separated_by=TWO_ATTITUDES
    )
    fields = ("body_ipos",)

    def edit_model(self, model: ModelFields) -> None:
        """Shift it."""
        shift = torch.stack([self.forward, self.left, -self.along], dim=-1)
        model.field("body_ipos")[:, model.ids("body", self.setup.joints)] += shift


@effect("link_inertia")
class LinkInertia(Effect):
    """Rotational inertia of the link that a joint moves, about its centre of mass, scaled by one factor.

    Mass that sits further from, or nearer to, the centre than the model says: +-20 % are likely (estimate). It shows
    at fast motion only, like ``armature``, from which the coupling between joints tells it.
    """

    title = "a change of link inertia"
    params = (Param("scale", "-", 0.5, 2.0, 1.0, 0.1, "joint", "inertia over the model's"),)
    fields = ("body_inertia",)

    def edit_model(self, model: ModelFields) -> None:
        """Scale it."""
        model.field("body_inertia")[:, model.ids("body", self.setup.joints)] *= self.scale.unsqueeze(-1)


@effect("link_mass")
class LinkMass(Effect):
    """Mass and inertia of the link that a joint moves, scaled by one factor; its centre of mass stays.

    A link of another density. Published Go1 models differ by 12 % (thigh 0.90 to 1.01 kg, calf 0.196 to 0.218). In one
    pose the torque of gravity is also that of ``link_com``; ``strength`` scales it the other way round.
    """

    title = "a change of link mass"
    params = (Param("scale", "-", 0.5, 2.0, 1.0, 0.05, "joint", "mass over the model's"),)
    identification = Identification(
        nominal=True,
        rank=6,
        weighs_on_legs=True,
        uniform=True,
        confounded=("armature", "kp_scale", "strength"),
        separated_by=TWO_GAIN_SETS,
    )
    fields = ("body_mass", "body_inertia")

    def edit_model(self, model: ModelFields) -> None:
        """Scale both."""
        links = model.ids("body", self.setup.joints)
        model.field("body_mass")[:, links] *= self.scale
        model.field("body_inertia")[:, links] *= self.scale.unsqueeze(-1)


FIELDS = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
"""Model fields that :func:`join` writes."""

LEAST = 0.1
"""What is taken away leaves at least this share of a body's smallest moment of inertia."""


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
        nominal=True, rank=20, needs_ground=True, free_shapes=("x", "y", "z"), excitation="squat"
    )
    fields = FIELDS
    order = 10  # after a shift of the trunk's own centre

    def edit_model(self, model: ModelFields) -> None:
        """Join the point mass to the trunk."""
        place = torch.cat([self.x, self.y, self.z], dim=1).unsqueeze(1)
        join(model, model.ids("body", ("trunk",)), self.mass, place)


@effect("point_load")
class PointLoad(Effect):
    """A point mass on the link that a joint moves, at (x, y, z) in its frame: mass, centre, inertia change (Steiner).

    A boot, a sensor at the foot, a cable clamp on the shank: 0.01 to 0.3 kg are likely (estimate); the tolerance is
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
        separated_by="record a chirp and slow_ramps at two attitudes of the trunk (hang=[[0,0],[0,0.5]])",
    )
    fields = FIELDS
    order = 10  # after what changes the link's own mass and centre

    def edit_model(self, model: ModelFields) -> None:
        """Join it to the link."""
        place = torch.stack([self.x, self.y, self.z], dim=-1)
        join(model, model.ids("body", self.setup.joints), self.mass, place)


def join(model: ModelFields, bodies: Tensor, added: Tensor, place: Tensor) -> None:
    """Join a point mass to each of some bodies, by the parallel-axis theorem (Steiner) about the common centre.

    A body that gets nothing keeps its bits; an inertia composed anew has other last ones.

    Args:
        model: whose ``FIELDS`` are changed.
        bodies: (K,) which.
        added: (N, K) kg; what is negative is taken away.
        place: (N, K, 3) in the frames of the bodies, m.
    """
    mass, com, moments, quat = (model.field(name)[:, bodies] for name in FIELDS)
    total = mass + added
    lever = place - com
    reduced = (mass * added / total)[..., None, None]
    square = lever.square().sum(-1)[..., None, None] * torch.eye(3, dtype=mass.dtype, device=mass.device)
    turned = _axes(quat)
    inertia = turned @ torch.diag_embed(moments) @ turned.mT
    inertia = inertia + reduced * (square - lever.unsqueeze(-1) * lever.unsqueeze(-2))
    principal, axes = torch.linalg.eigh(inertia)
    principal = torch.maximum(principal, LEAST * moments.amin(-1, keepdim=True))
    axes = axes * torch.linalg.det(axes).sign()[..., None, None]  # right-handed
    new = (total, com + (added / total).unsqueeze(-1) * lever, principal, _quat(axes))
    for name, before, after in zip(FIELDS, (mass, com, moments, quat), new, strict=True):
        nothing = added == 0.0
        model.field(name)[:, bodies] = torch.where(
            nothing.unsqueeze(-1) if before.dim() > 2 else nothing, before, after
        )


def _axes(quat: Tensor) -> Tensor:
    """Return the rotation matrices (N, K, 3, 3) of quaternions (N, K, 4), w-x-y-z."""
    from scipy.spatial.transform import Rotation  # slow to import, and settings are checked first

    flat = Rotation.from_quat(quat.reshape(-1, 4).cpu().numpy(), scalar_first=True)
    return torch.as_tensor(flat.as_matrix()).to(quat).reshape(*quat.shape[:-1], 3, 3)


def _quat(axes: Tensor) -> Tensor:
    """Return the quaternions (N, K, 4), w-x-y-z, of rotation matrices (N, K, 3, 3)."""
    from scipy.spatial.transform import Rotation  # slow to import, and settings are checked first

    flat = Rotation.from_matrix(axes.reshape(-1, 3, 3).cpu().numpy())
    return torch.as_tensor(flat.as_quat(scalar_first=True)).to(axes).reshape(*axes.shape[:-2], 4)
