"""Curricula: what a robot meets next, given how it did."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import torch
from pydantic import Field

from go1exp.config.schema.registry import curriculum

if TYPE_CHECKING:
    from torch import Tensor


def terrain_levels_after(
    level: Tensor,
    distance: Tensor,
    commanded_distance: Tensor,
    tile_size: float,
    max_level: int,
    random_level: Tensor,
) -> Tensor:
    """Return the terrain level of each env after an episode, (N,) int64.

    One level up if the robot walked more than half a tile; else one down if it walked less than half the commanded
    distance. The lowest level is 0. Passing the top level leads to a random one, so that no level is forgotten. A zero
    command never moves a robot down; a fall does, through the short distance. All envs get an answer: the caller
    keeps it for those that ended an episode, and not at the very first reset.

    Source: legged_gym `_update_terrain_curriculum` (Rudin et al. 2022); Isaac Lab `terrain_levels_vel` is alike.

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


@curriculum("terrain_level")
class TerrainLevel:
    """Harder ground for robots that walk far, easier ground for those that do not (``terrain_levels_after``)."""

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
        """Return the next levels (N,)."""
        return terrain_levels_after(level, distance, commanded_distance, tile_size, max_level, random_level)
