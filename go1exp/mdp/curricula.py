"""Curricula: which ground a robot meets next."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import torch
from pydantic import Field

from go1exp.config.schema.registry import curriculum

if TYPE_CHECKING:
    from torch import Tensor


@curriculum("terrain_level")
class TerrainLevel:
    """Harder ground for robots that walk far, easier ground for those that do not.

    One level up after more than half a tile; else one down after less than half the commanded distance. The lowest
    level is 0; beyond the top one follows a random level, so that none is forgotten. A zero command never moves a robot
    down; a fall does, through the short distance.

    Source: legged_gym `_update_terrain_curriculum` (Rudin et al. 2022), like Isaac Lab's `terrain_levels_vel`.
    """

    def __init__(self, *, start_level_max: Annotated[int, Field(ge=0)] = 5) -> None:
        """Start robots on uniformly random levels up to ``start_level_max`` (legged_gym: 5)."""
        self.start_level_max = start_level_max

    def __call__(
        self,
        level: Tensor,
        distance: Tensor,
        commanded_distance: Tensor,
        tile_size: float,
        max_level: int,
        random_level: Tensor,
    ) -> Tensor:
        """Return the level of each env after an episode, (N,) int64; the caller keeps it where an episode ended.

        Args:
            level: Level of the episode that ended, (N,) int64.
            distance: Horizontal distance from the tile's origin at its end, (N,), m.
            commanded_distance: |v*_xy| of the command at its end times the time the episode could have lasted, (N,), m.
            tile_size: Edge of a tile, m.
            max_level: The top level, rows - 1.
            random_level: Uniform draws from 0..max_level, (N,) int64.
        """
        up = distance > 0.5 * tile_size
        down = distance < 0.5 * commanded_distance
        moved = torch.where(up, level + 1, torch.where(down, level - 1, level))
        return torch.where(moved > max_level, random_level, moved.clamp(min=0))
