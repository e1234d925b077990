"""The net as a torch module, shaped for speed: a few thousand rows at a time stay in the core's cache."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

CHUNK = 2048
"""Rows per pass: 2048 x 64 float32 are 0.5 MiB, so three layers' activations fit a 2 MiB L2 cache (measured best)."""


class TorchNet(torch.nn.Module):
    """K networks in float32, evaluated without gradients; parameters are buffers, so ``.to(device)`` moves them."""

    def __init__(self, weights: Sequence[np.ndarray], biases: Sequence[np.ndarray], skip: np.ndarray) -> None:
        """Take the folded layers of an ``ActuatorNet``: weights (K, in, out), biases (K, out), skip (K, F, 1)."""
        super().__init__()
        self.skip: Tensor | None
        self.depth = len(weights)
        self.nets = len(skip)
        for i, (w, b) in enumerate(zip(weights, biases, strict=True)):
            self.register_buffer(f"weight_{i}", torch.tensor(w, dtype=torch.float32))
            self.register_buffer(f"bias_{i}", torch.tensor(b[:, None, :], dtype=torch.float32))
        self.register_buffer("skip", torch.tensor(skip, dtype=torch.float32) if skip.any() else None)

    @torch.no_grad()
    def forward(self, rows: Tensor) -> Tensor:
        """Map features (R, F) to torques (R,), N m, where there is one net; (K, R, F) to (K, R) always."""
        if rows.dim() == 2:
            if self.nets != 1:
                raise ValueError(f"{self.nets} nets want rows of shape ({self.nets}, R, F), not {tuple(rows.shape)}")
            return self.forward(rows[None])[0]
        out = rows.new_empty(rows.shape[:2])
        for k in range(self.nets):
            for start in range(0, rows.shape[1], CHUNK):
                out[k, start : start + CHUNK] = self._one(k, rows[k, start : start + CHUNK])
        return out

    def _one(self, k: int, x: Tensor) -> Tensor:
        h = x
        for i in range(self.depth - 1):
            h = self._layer(i, k, h)
            h.div_(h.abs().add_(1))
        tau = self._layer(self.depth - 1, k, h)
        if self.skip is not None:
            tau.addmm_(x, self.skip[k])
        return tau[:, 0]

    def _layer(self, i: int, k: int, h: Tensor) -> Tensor:
        return torch.addmm(self.get_buffer(f"bias_{i}")[k], h, self.get_buffer(f"weight_{i}")[k])
