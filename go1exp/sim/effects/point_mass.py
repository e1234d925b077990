"""A point mass joined to bodies of a model: mass, centre and inertia change together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.robot.actuators import ModelFields

if TYPE_CHECKING:
    from torch import Tensor

FIELDS = ("body_mass", "body_ipos", "body_inertia", "body_iquat")
"""Model fields that :func:`join` writes."""

LEAST = 0.1
"""What is taken away leaves at least this share of a body's smallest moment of inertia."""


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
