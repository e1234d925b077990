"""Height of the ground under batches of points, and around robots."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor

SCAN_ROWS, SCAN_COLUMNS = 17, 11
"""Points of a height scan along x, from behind to the front; in each of its rows along y, from right to left."""

SCAN_SPACING = 0.1
"""Distance between its points, m: 1.6 m x 1.0 m with the trunk's origin in the middle, as in Isaac Lab."""

AHEAD = (0.0, 0.05, 0.1, 0.15, 0.2)
"""Distances from a foot at which the ground ahead of it is looked at, m; a stride at 0.5 m/s and 2.8 Hz is 0.18 m."""


class GroundHeight:
    """Looks up the height of the triangulated ground (`go1exp.sim.terrain.Terrain`).

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


class HeightScan:
    """Heights of the ground on a grid about each robot, level, and turned with the robot's heading.

    Args:
        ground: lookup of heights; None for flat ground at height 0.
        device: of the grid.
    """

    def __init__(self, ground: GroundHeight | None, device: torch.device) -> None:
        self._ground = ground
        x, y = (SCAN_SPACING * (torch.arange(n, device=device) - (n - 1) / 2) for n in (SCAN_ROWS, SCAN_COLUMNS))
        self._grid = torch.cartesian_prod(x, y)

    def __call__(self, position: Tensor, quat: Tensor) -> Tensor:
        """Return heights over the trunks' origins (N, 187), m, for trunks at ``position`` (N, 3), ``quat`` (N, 4)."""
        below = -position[:, 2:].expand(-1, len(self._grid))
        if self._ground is None:
            return below
        points = position[:, None, :2] + _turned(self._grid, quat)
        return self._ground(points) + below


class RiseAhead:
    """How far the ground ahead of each foot rises over the ground below the foot.

    Args:
        ground: lookup of heights; None for flat ground.
        device: of the distances.
    """

    def __init__(self, ground: GroundHeight | None, device: torch.device) -> None:
        self._ground, self._distances = ground, torch.tensor(AHEAD, device=device).unsqueeze(1)

    def __call__(self, feet: Tensor, quat: Tensor, command: Tensor) -> Tensor:
        """Return (N, 4), m, not negative: of the highest point at the distances ``AHEAD`` where the command leads.

        Args:
            feet: (N, 4, 2) world positions of the feet, m.
            quat: (N, 4) attitude of the trunk, w-x-y-z.
            command: (N, 3) commanded velocity, body frame. Without a planar one nothing lies ahead.
        """
        if self._ground is None:
            return torch.zeros_like(feet[..., 0])
        towards = _turned(command[:, None, :2], quat)  # (N, 1, 2)
        towards = towards / towards.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        heights = self._ground(feet.unsqueeze(2) + (self._distances * towards).unsqueeze(1))  # (N, 4, len(AHEAD))
        return heights.amax(-1) - heights[..., 0]


class Surroundings:
    """The fields of a Snapshot that are computed only because a term reads them.

    Args:
        ground: lookup of heights; None for flat ground at height 0.
        device: of the robots.
        read: names of the fields; others than ``height_scan`` and ``foot_rise`` are not looked at.
    """

    def __init__(self, ground: GroundHeight | None, device: torch.device, read: Collection[str]) -> None:
        self._scan = HeightScan(ground, device) if "height_scan" in read else None
        self._rise = RiseAhead(ground, device) if "foot_rise" in read else None

    def __call__(self, position: Tensor, quat: Tensor, feet: Tensor, command: Tensor) -> dict[str, Tensor]:
        """Return the fields that are read; arguments as in ``HeightScan`` and ``RiseAhead``."""
        fields = {}
        if self._scan:
            fields["height_scan"] = self._scan(position, quat)
        if self._rise:
            fields["foot_rise"] = self._rise(feet, quat, command)
        return fields


def _turned(vectors: Tensor, quat: Tensor) -> Tensor:
    """Return level vectors (N or 1, K, 2) of the trunks' headings in the world frame, (N, K, 2); ``quat`` (N, 4)."""
    w, x, y, z = quat.unsqueeze(1).unbind(-1)
    ahead = torch.stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)], dim=-1)  # the x axis, seen from above
    ahead = ahead / ahead.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    left = torch.stack([-ahead[..., 1], ahead[..., 0]], dim=-1)
    return vectors[..., :1] * ahead + vectors[..., 1:] * left
