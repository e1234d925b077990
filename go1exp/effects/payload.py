"""``effect=payload``: the trunk carries something."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp.drive import ModelFields
from go1exp.effects.base import Effect, Param
from go1exp.effects.identification import Identification
from go1exp.schema.registry import effect

if TYPE_CHECKING:
    from torch import Tensor


LEAST = 0.1
"""What is taken away leaves at least this share of the trunk's smallest moment of inertia."""


def _axes(quat: Tensor) -> Tensor:
    """Return the rotation matrices (N, 3, 3) of quaternions (N, 4), w-x-y-z."""
    from scipy.spatial.transform import Rotation  # slow to import, and settings are checked first

    return torch.as_tensor(Rotation.from_quat(quat.cpu().numpy(), scalar_first=True).as_matrix()).to(quat)


def _quat(axes: Tensor) -> Tensor:
    """Return the quaternions (N, 4), w-x-y-z, of rotation matrices (N, 3, 3)."""
    from scipy.spatial.transform import Rotation  # slow to import, and settings are checked first

    return torch.as_tensor(Rotation.from_matrix(axes.cpu().numpy()).as_quat(scalar_first=True)).to(axes)


@effect("payload")
class Payload(Effect):
    """A point mass on the trunk at (x, y, z) in its frame: mass, centre and inertia change together (Steiner).

    Walk-these-ways randomises -1 to 3 kg; published Go1 models disagree by 0.4 kg about the trunk itself. A negative
    mass is taken away. A held trunk shows none of it. Fast motion resembles ``strength`` the other way round; standing,
    its place looks like ``com_offset``.
    """

    title = "a payload on the trunk"
    params = (
        Param("mass", "kg", -1.0, 5.0, 0.0, 0.2, "robot", "mass carried"),
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
    fields = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
    order = 10  # after a shift of the trunk's own centre
    mass: Tensor
    x: Tensor
    y: Tensor
    z: Tensor

    def edit_model(self, model: ModelFields) -> None:
        """Join the point mass to the trunk."""
        trunk = model.ids("body", ("trunk",))
        mass, com, moments, quat = (model.field(name)[:, trunk] for name in self.fields)
        com, moments, quat = com[:, 0], moments[:, 0], quat[:, 0]
        total = mass + self.mass
        lever = torch.cat([self.x, self.y, self.z], dim=1) - com
        reduced = (mass * self.mass / total).unsqueeze(-1)
        square = lever.square().sum(-1)[:, None, None] * torch.eye(3, dtype=mass.dtype, device=mass.device)
        turned = _axes(quat)
        inertia = turned @ torch.diag_embed(moments) @ turned.mT
        inertia = inertia + reduced * (square - lever.unsqueeze(-1) * lever.unsqueeze(-2))
        principal, axes = torch.linalg.eigh(inertia)
        principal = torch.maximum(principal, LEAST * moments.amin(-1, keepdim=True))
        axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # right-handed
        new = (total, com + self.mass / total * lever, principal, _quat(axes))
        for name, before, after in zip(self.fields, (mass, com, moments, quat), new, strict=True):
            kept = torch.where(self.mass == 0.0, before, after)  # an inertia composed anew has other last bits
            model.field(name)[:, trunk] = kept if name == "body_mass" else kept.unsqueeze(1)
