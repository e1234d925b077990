"""Numbers of the robot as tensors, made once for each device: to make one in every step is to wait for the device."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


@functools.cache
def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return ``values`` (K,) as a tensor, always the same one, which nobody may change."""
    return torch.tensor(values, dtype=torch.float64).to(device=device, dtype=dtype)


def constant_like(values: tuple[float, ...], like: Tensor) -> Tensor:
    """Return ``values`` (K,) in the dtype and on the device of ``like``; nobody may change them."""
    return constant(values, like.dtype, like.device)
