"""Ground that grows harder from lane to lane: slopes, gravel, waves, stairs, boxes, blocks.

A lane lies along +x: a flat run-up of ``RUN_UP`` m, then ``COURSE`` m of difficulty, then flat ground at the height
where it ends. Lane k has the k-th difficulty; robot i starts on lane i modulo their number. A height field has no
vertical walls: a riser leans over one sample.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from go1exp.sim.terrain import OBSTACLES, Terrain, TerrainConfig, as_stored, blocks

GroundName = Literal[
    "slope_up", "slope_down", "gravel", "waves", "crossed_waves", "stairs_up", "stairs_down", "boxes", "obstacles"
]

UNITS: dict[str, str] = {name: "deg" if name.startswith("slope") else "m" for name in get_args(GroundName)}
"""Of each ground's difficulty: angle; largest height of a grain, crest over trough, rise of a step, height of a box."""

LARGEST = {"deg": 60.0, "m": 2.0}
"""Difficulties beyond any legged robot's: a number in another unit is not taken for one."""

RUN_UP, COURSE, RUN_OUT, WIDTH = 1.5, 5.0, 2.5, 5.0
"""m. The run-out is longer than the metre before the edge of the map at which an episode ends."""

BEYOND = 0.5  # way behind the difficulty that a robot must come, m
GOAL = RUN_UP + COURSE + BEYOND  # way along its lane that a robot must come, m
BEFORE = 2.0  # flat ground behind the start, m
RESOLUTION = 0.05  # pitch of the samples, m: that of the gravel
TREAD = 0.31  # depth of a stair, m (legged_gym)
WAVE_LENGTH = 1.0  # m
CROSSED_LENGTH = 2.0  # length of each of two crossing waves, m: five on ten metres, as legged_gym counts them
BOX = 0.45  # edge of a box, m (Isaac Lab)
CENTRE_BLOCK = 1.0  # edge of the highest block, which lies across the middle of a lane, m
Field = NDArray[np.floating]
Shape = Callable[[Field, Field, float, float, np.random.Generator], Field]


def _slope(x: Field, y: Field, difficulty: float, course: float, rng: np.random.Generator) -> Field:
    return np.tan(np.radians(difficulty)) * np.clip(x, 0.0, course)


def _stairs(x: Field, y: Field, difficulty: float, course: float, rng: np.random.Generator) -> Field:
    return difficulty * np.ceil(np.clip(x, 0.0, course) / TREAD - 1e-9)


def _gravel(x: Field, y: Field, difficulty: float, course: float, rng: np.random.Generator) -> Field:
    return difficulty * rng.uniform(0.0, 1.0, np.broadcast_shapes(x.shape, y.shape)) * _inside(x, course)


def _waves(x: Field, y: Field, difficulty: float, course: float, rng: np.random.Generator) -> Field:
    return 0.5 * difficulty * (1.0 - np.cos(2.0 * np.pi * x / WAVE_LENGTH)) * _inside(x, course)


def _crossed_waves(x: Field, y: Field, difficulty: float, course: float, rng: np.random.Generator) -> Field:
    height = sum(0.5 * (1.0 - np.cos(2.0 * np.pi * v / CROSSED_LENGTH)) for v in (x, y - y.min()))
    # The way in is as long as half a wave, so that no wave begins with a wall.
    return 0.5 * difficulty * height * np.clip(np.minimum(x, course - x) / (0.5 * CROSSED_LENGTH), 0.0, 1.0)


def _boxes(x: Field, y: Field, difficulty: float, course: float, rng: np.random.Generator) -> Field:
    heights = rng.uniform(0.0, 1.0, (64, 64))
    heights[0, 0] = 1.0  # the difficulty is the largest box's
    column, row = (np.floor((v - v.min()) / BOX + 1e-9).astype(int) % 64 for v in (x, y))
    return difficulty * heights[row, column] * _inside(x, course)


def _obstacles(x: Field, y: Field, difficulty: float, course: float, rng: np.random.Generator) -> Field:
    across, along, middle = y[:, 0], x[0], 0.5 * float(y.max() + y.min())
    bounds, beside = (0.0, course), (float(y.min()), float(y.max()))
    heights = blocks((across, along), beside, bounds, round(OBSTACLES * course * float(np.ptp(y))), rng)
    centre = [np.abs(v - c) <= 0.5 * CENTRE_BLOCK for v, c in ((across, middle), (along, 0.5 * course))]
    heights[np.ix_(*centre)] = 1.0
    return difficulty * heights


def wrong_difficulties(key: str, ground: GroundName, levels: Sequence[float]) -> list[str]:
    """Return what is wrong with the difficulties of a ground, named by their key: nothing, or one line."""
    unit = UNITS[ground]
    if sorted(set(levels)) == list(levels) and levels[-1] <= LARGEST[unit]:
        return []
    return [f"{key} = {list(levels)}: must rise, to at most {LARGEST[unit]:g} {unit}"]


def _inside(x: Field, course: float) -> Field:
    return ((x > 0.0) & (x < course)).astype(float)


SHAPES: dict[str, Shape] = {
    "slope_up": _slope,
    "slope_down": _slope,
    "gravel": _gravel,
    "waves": _waves,
    "crossed_waves": _crossed_waves,
    "stairs_up": _stairs,
    "stairs_down": _stairs,
    "boxes": _boxes,
    "obstacles": _obstacles,
}
"""Height of a lane at x (1, n) after the run-up and y (m, 1): (m, n), or (1, n) whatever y is; or depth."""


@dataclass(frozen=True)
class Lanes(TerrainConfig):
    """Lanes of rising difficulty; what it has of ``TerrainConfig`` beside ``seed`` is not used."""

    kind: Literal["flat", "tiles"] = "tiles"
    ground: GroundName = "slope_up"  # which
    levels: tuple[float, ...] = (0.0,)  # difficulty of each lane, in its unit
    course: float = COURSE  # length of the difficulty, m
    start: float = -RUN_UP  # where robots start, from the beginning of the difficulty, m
    width: float = WIDTH  # of a lane, m
    backward: bool = False  # the lanes lie along -x, for robots that walk backward

    @property
    def goal(self) -> float:
        """Way along its lane that a robot must come, m: to half a metre beyond the difficulty."""
        return self.course + BEYOND - self.start

    def build(self) -> Terrain:
        """Build the lanes; the start of each is its tile's origin, row 0."""
        shape, sign = SHAPES[self.ground], -1.0 if self.ground.endswith("_down") else 1.0
        first, last = min(self.start, 0.0) - BEFORE, self.course + RUN_OUT
        per_lane, length = round(self.width / RESOLUTION), round((last - first) / RESOLUTION)
        margin = round(1.0 / RESOLUTION)  # an episode ends within it
        heights = np.zeros((len(self.levels) * per_lane + 2 * margin + 1, length + 1))
        x = (np.arange(length + 1) * RESOLUTION + first)[None, :]
        y = (np.arange(per_lane) * RESOLUTION)[:, None]
        for k, level in enumerate(self.levels):
            rows = slice(margin + k * per_lane, margin + (k + 1) * per_lane)
            heights[rows] = sign * shape(x, y, level, self.course, np.random.default_rng([self.seed, k]))
        heights[:margin], heights[margin + len(self.levels) * per_lane :] = heights[margin], heights[-margin - 2]
        x0, y0 = first - self.start, -0.5 * (len(heights) - 1) * RESOLUTION
        if self.backward:
            heights, x0 = heights[:, ::-1], -(x0 + length * RESOLUTION)
        origins = np.zeros((1, len(self.levels), 3))
        origins[0, :, 1] = y0 + (margin + (np.arange(len(self.levels)) + 0.5) * per_lane) * RESOLUTION
        kinds = (self.ground,) * len(self.levels)
        terrain = Terrain(as_stored(heights), x0, y0, RESOLUTION, origins, kinds, self)
        origins[..., 2] = terrain.height_at(origins[..., :2])
        return terrain
