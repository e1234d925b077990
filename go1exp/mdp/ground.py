"""Height of the ground under batches of points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


class GroundHeight:
    """Looks up the height of the triangulated ground: `go1exp.terrain.Terrain.height_at` in torch.

    Shapes depend on the argument alone and nothing waits for the device, so a call may be captured in a CUDA graph. A
    point that is not finite gives NaN, or the height of an edge if infinite, and never an index error.

    Args:
        heights: Sample heights, (ny, nx), m, world frame, both sizes >= 2; kept on its device, in its dtype.
        x0: World x of the first column of samples, m.
        y0: World y of the first row of samples, m.
        resolution: Distance between samples, m.
    """

    def __init__(self, heights: Tensor, x0: float, y0: float, resolution: float) -> None:
        if heights.ndim != 2 or min(heights.shape) < 2:
            raise ValueError(f"heights: must be (ny, nx) with both >= 2, not {tuple(heights.shape)}")
        self.ny, self.nx = heights.shape
        self.x0, self.y0, self.resolution = float(x0), float(y0), float(resolution)
        self._flat = heights.contiguous().view(-1)

    def __call__(self, xy: Tensor) -> Tensor:
        """Return the height of the ground at world positions `xy`, (..., 2) -> (...), m; outside, of the nearest edge.

        In float32, positions tens of metres from the origin are known to some 1e-5 m, and the height to that times the
        slope.
        """
        u = ((xy[..., 0] - self.x0) / self.resolution).clamp(0, self.nx - 1)
        v = ((xy[..., 1] - self.y0) / self.resolution).clamp(0, self.ny - 1)
        i = u.long().clamp(0, self.nx - 2)  # clamped as an integer: NaN becomes any number
        j = v.long().clamp(0, self.ny - 2)
        u, v = u - i, v - j
        at = j * self.nx + i
        low, right = self._flat[at], self._flat[at + 1]
        far, high = self._flat[at + self.nx], self._flat[at + self.nx + 1]
        # Each cell is split from (low x, low y) to (high x, high y), as MuJoCo does.
        return low + torch.where(u >= v, u * (right - low) + v * (high - right), v * (far - low) + u * (high - far))
