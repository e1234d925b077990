"""Curricula: which ground a robot meets next, by how well it tracked the path that was commanded."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import torch
from pydantic import Field

from go1exp.base.tensors.memory import Memory, constant_like
from go1exp.base.tensors.rotation import quat_multiply, rotate_inverse
from go1exp.config.schema.registry import curriculum

if TYPE_CHECKING:
    from torch import Tensor

YAW_ARM = 0.25
"""Length that turns a yaw angle into a path, m: about the distance of a foot from the middle of the trunk."""

WINDOW = 1.0
"""Deviations are summed over so many seconds before they count, so that the oscillation of a gait does not."""

PROMOTED, DEMOTED = 0.6, 0.4
"""Shares of the commanded path: at least the first one tracked is success, less than the second one failure.

The shipped policy ``robust`` tracks 0.7 of the paper's commands on the lowest levels (median)."""


class TrackedPath(Memory):
    """Arc length of the commanded twist in each robot's episode, and how much of it was tracked.

    A displacement is the integral of (x, y, ``YAW_ARM`` times yaw) of a twist, body frame. In each window its deviation
    from the commanded displacement is taken off the length of the latter; less than none is not counted.
    """

    memory = ("total", "_window", "_position", "_attitude")

    def __init__(self, num_envs: int, device: torch.device) -> None:
        """Allocate for N robots."""
        self.total = torch.zeros(num_envs, 2, device=device)
        """Tracked and commanded length in the windows that are complete, (N, 2), m."""
        self._window = torch.zeros(num_envs, 7, device=device)  # deviation (3) and commanded (3), m; time, s
        self._position, self._attitude = (torch.zeros(num_envs, k, device=device) for k in (3, 4))

    def begin(self, mask: Tensor, position: Tensor, attitude: Tensor) -> None:
        """Begin anew in the rows of ``mask`` (N,), at poses of the trunk (N, 3), m, and (N, 4), w-x-y-z."""
        rows = mask.unsqueeze(1)
        for tensor in (self.total, self._window):
            tensor.masked_fill_(rows, 0.0)
        self._position.copy_(torch.where(rows, position, self._position))
        self._attitude.copy_(torch.where(rows, attitude, self._attitude))

    def advance(self, dt: float, command: Tensor, position: Tensor, attitude: Tensor) -> None:
        """Let ``dt`` s pass under ``command`` (N, 3), m/s and rad/s, at whose end the trunks have these poses."""
        moved = rotate_inverse(self._attitude, position - self._position)
        turned = quat_multiply(self._attitude * constant_like((1.0, -1.0, -1.0, -1.0), attitude), attitude)
        moved[:, 2] = 2.0 * YAW_ARM * turned[:, 3] * turned[:, 0].sign()
        step = command * constant_like((dt, dt, dt * YAW_ARM), command)
        self._window[:, :3] += moved - step
        self._window[:, 3:6] += step
        self._window[:, 6] += dt
        full = (self._window[:, 6:] >= WINDOW - 0.5 * dt) & torch.ones_like(self.total, dtype=torch.bool)
        self.total.copy_(torch.where(full, self.lengths(), self.total))
        self._window.masked_fill_(full[:, :1], 0.0)
        self._position.copy_(position)
        self._attitude.copy_(attitude)

    def lengths(self) -> Tensor:
        """Return tracked and commanded length so far, (N, 2), m."""
        commanded = self._window[:, 3:6].norm(dim=1)
        tracked = (commanded - self._window[:, :3].norm(dim=1)).clamp(min=0.0)
        return self.total + torch.stack((tracked, commanded), dim=1)


@curriculum("terrain_level")
class TerrainLevel:
    """Harder ground for robots that track the commanded path, easier ground for those that do not.

    One level up if 60 % of the commanded path was tracked or more; one down if less than 40 %. The lowest level is 0;
    beyond the top one follows a random level, so that none is forgotten. Without a command a robot keeps its level. A
    fall counts as the rest of the episode untracked.

    Source: legged_gym `_update_terrain_curriculum` (Rudin et al. 2022), where success is the distance from the start,
    which slow commands and circles never reach.
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
            distance: Tracked length of the commanded path (`TrackedPath`), (N,), m.
            commanded_distance: Length of the commanded path, (N,), m; after a fall that of the whole episode at the
                mean speed commanded until then.
            tile_size: Edge of a tile, m.
            max_level: The top level, rows - 1.
            random_level: Uniform draws from 0..max_level, (N,) int64.
        """
        up = (distance >= PROMOTED * commanded_distance) & (commanded_distance > 0.0)
        down = distance < DEMOTED * commanded_distance
        moved = torch.where(up, level + 1, torch.where(down, level - 1, level))
        return torch.where(moved > max_level, random_level, moved.clamp(min=0))
