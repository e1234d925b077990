"""Ground that grows harder from lane to lane: slopes, gravel, waves, stairs, boxes.

A lane lies along +x: a flat run-up of ``RUN_UP`` m, then ``COURSE`` m of difficulty, then flat ground at the height
where it ends. Lane k has the k-th difficulty; robot i starts on lane i modulo their number. A height field has no
vertical walls: a riser leans over one sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from go1exp.sim.terrain import Terrain, TerrainConfig, as_stored

GroundName = Literal["slope_up", "slope_down", "gravel", "waves", "stairs_up", "stairs_down", "boxes"]

UNITS: dict[str, str] = {
    **dict.fromkeys(("slope_up", "slope_down"), "deg"),
    **dict.fromkeys(("gravel", "waves", "stairs_up", "stairs_down", "boxes"), "m"),
}
"""Of each ground's difficulty: angle; largest height of a grain, crest over trough, rise of a step, height of a box."""

RUN_UP, COURSE, RUN_OUT, WIDTH = 1.5, 5.0, 2.5, 5.0
"""m. The run-out is longer than the metre before the edge of the map at which an episode ends."""

GOAL = RUN_UP + COURSE + 0.5  # way along its lane that a robot must come, m: to half a metre beyond the difficulty
BEFORE = 2.0  # flat ground behind the start, m
RESOLUTION = 0.05  # pitch of the samples, m: that of the gravel
TREAD = 0.31  # depth of a stair, m (legged_gym)
WAVE_LENGTH = 1.0  # m
BOX = 0.45  # edge of a box, m (Isaac Lab)
Field = NDArray[np.floating]


def _slope(x: Field, y: Field, difficulty: float, rng: np.random.Generator) -> Field:
    rise = np.tan(np.radians(difficulty)) * np.clip(x, 0.0, COURSE)
    return np.broadcast_to(rise, np.broadcast_shapes(x.shape, y.shape))


def _stairs(x: Field, y: Field, difficulty: float, rng: np.random.Generator) -> Field:
    steps = np.ceil(np.clip(x, 0.0, COURSE) / TREAD - 1e-9)
    return np.broadcast_to(difficulty * steps, np.broadcast_shapes(x.shape, y.shape))


def _gravel(x: Field, y: Field, difficulty: float, rng: np.random.Generator) -> Field:
    return difficulty * rng.uniform(0.0, 1.0, np.broadcast_shapes(x.shape, y.shape)) * _inside(x)


def _waves(x: Field, y: Field, difficulty: float, rng: np.random.Generator) -> Field:
    wave = 0.5 * difficulty * (1.0 - np.cos(2.0 * np.pi * x / WAVE_LENGTH)) * _inside(x)
    return np.broadcast_to(wave, np.broadcast_shapes(x.shape, y.shape))


def _boxes(x: Field, y: Field, difficulty: float, rng: np.random.Generator) -> Field:
    heights = rng.uniform(0.0, 1.0, (64, 64))
    heights[0, 0] = 1.0  # the difficulty is the largest box's
    column, row = (np.floor((v - v.min()) / BOX + 1e-9).astype(int) % 64 for v in (x, y))
    return difficulty * heights[row, column] * _inside(x)


def _inside(x: Field) -> Field:
    return ((x > 0.0) & (x < COURSE)).astype(float)


SHAPES: dict[str, tuple[Callable[[Field, Field, float, np.random.Generator], Field], float]] = {
    "slope_up": (_slope, 1.0),
    "slope_down": (_slope, -1.0),
    "gravel": (_gravel, 1.0),
    "waves": (_waves, 1.0),
    "stairs_up": (_stairs, 1.0),
    "stairs_down": (_stairs, -1.0),
    "boxes": (_boxes, 1.0),
}
"""Height of a lane at x (1, n) after the run-up and y (m, 1), and its sign."""


@dataclass(frozen=True)
class Lanes(TerrainConfig):
    """Lanes of rising difficulty; what it has of ``TerrainConfig`` beside ``seed`` is not used."""

    kind: Literal["flat", "tiles"] = "tiles"
    ground: GroundName = "slope_up"  # which
    levels: tuple[float, ...] = (0.0,)  # difficulty of each lane, in its unit

    def build(self) -> Terrain:
        """Build the lanes; the start of each is its tile's origin, row 0."""
        shape, sign = SHAPES[self.ground]
        per_lane, length = round(WIDTH / RESOLUTION), round((BEFORE + RUN_UP + COURSE + RUN_OUT) / RESOLUTION)
        margin = round(1.0 / RESOLUTION)  # an episode ends within it
        heights = np.zeros((len(self.levels) * per_lane + 2 * margin + 1, length + 1))
        x = (np.arange(length + 1) * RESOLUTION - BEFORE - RUN_UP)[None, :]
        y = (np.arange(per_lane) * RESOLUTION)[:, None]
        for k, level in enumerate(self.levels):
            rows = slice(margin + k * per_lane, margin + (k + 1) * per_lane)
            heights[rows] = sign * shape(x, y, level, np.random.default_rng([self.seed, k]))
        heights[:margin], heights[margin + len(self.levels) * per_lane :] = heights[margin], heights[-margin - 2]
        y0 = -0.5 * (len(heights) - 1) * RESOLUTION
        origins = np.zeros((1, len(self.levels), 3))
        origins[0, :, 1] = y0 + (margin + (np.arange(len(self.levels)) + 0.5) * per_lane) * RESOLUTION
        kinds = (self.ground,) * len(self.levels)
        return Terrain(as_stored(heights), -BEFORE, y0, RESOLUTION, origins, kinds, self)
