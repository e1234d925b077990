"""Restitution of a spring-damper that can push but not pull, as MuJoCo's contacts and joint limits are."""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor


def restitution(damping_ratio: np.ndarray) -> np.ndarray:
    """Return the share of its speed that a mass keeps when it meets a spring-damper which can push but not pull.

    With z the damping ratio and w = sqrt(|1 - z^2|): e = exp(-z/w atan2(2 z w, 2 z^2 - 1)) below z = 1, exp(-2) at 1,
    and exp(-z/w ln((z + w) / (z - w))) above.
    Schwager and Poeschel, "Coefficient of restitution and linear-dashpot model revisited", Granular Matter 9 (2007).
    """
    z = np.asarray(damping_ratio, dtype=float)
    w = np.sqrt(np.maximum(np.abs(1.0 - z**2), 1e-18))
    under = np.where(z < 1.0, np.arctan2(2.0 * z * w, 2.0 * z**2 - 1.0), 0.0)
    over = np.log((z + w) / np.maximum(z - w, 1e-18))
    return np.exp(-z / w * np.where(z < 1.0, under, over))


@functools.cache
def _restitution_table(device: torch.device) -> tuple[Tensor, Tensor]:
    """Damping ratios and their restitution on a grid, restitution rising."""
    ratio = np.geomspace(4.0, 0.1, 400)
    return torch.tensor(restitution(ratio), device=device), torch.tensor(ratio, device=device)


def damping_ratio(e: Tensor) -> Tensor:
    """Invert ``restitution`` by linear interpolation; any shape, values from 0.015 to 0.74."""
    known, ratio = _restitution_table(e.device)
    right = torch.searchsorted(known, e.to(known.dtype).contiguous()).clamp(1, len(known) - 1)
    share = (e - known[right - 1]) / (known[right] - known[right - 1])
    return ratio[right - 1] + share * (ratio[right] - ratio[right - 1])
