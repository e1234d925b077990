"""Ground to walk on: a flat plane, or a height field of graded tiles (boxes, ramps, stairs and so on) for a curriculum.

World frame, z up, the field centred on the world origin. Rows are difficulty levels and follow +x; columns are kinds of
ground and follow +y, as in legged_gym. A tile is at height 0 along its whole border, so tiles meet without a step.

The kinds follow the paper ("boxes with slight variations in height close to 0 on the z-axis", "bumpy patches by adding
noise to terrain heights", ramps in its figure), and what other laboratories climb: stairs, obstacles, gaps. Tile grid,
column rule and interpolation follow legged_gym, sizes the Go1 rough task of Isaac Lab. Nothing here knows the
simulator: `sim/physics/scene.py` hands the field to MuJoCo, `mdp/ground.py` has the law of heights between samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field

from go1exp.config.schema.registry import Count, CountOrZero, NonNegative, Positive, Strict, ordered, within
from go1exp.mdp.ground import GroundHeight

TILE_TYPES = ("boxes", "bumps", "ramp_up", "ramp_down", "flat", "stairs_up", "stairs_down", "obstacles", "gaps")
"""Kinds of tile, in the order in which columns take them."""

OBSTACLES, OBSTACLE_EDGE = 0.4, (0.4, 1.0)
"""Density of obstacles before the platform is cleared, 1/m2, and their shortest and longest edge, m."""

GAP_DEPTH, GAP_SPACING = 0.5, 1.0
"""Depth of a gap and distance between two of them, m."""

FloatArray = NDArray[np.float64]

NonNegativeRange = Annotated[tuple[NonNegative, NonNegative], AfterValidator(ordered)]
# Centimetres and degrees are refused: no legged robot climbs 2 m or 63 degrees.
Height = Annotated[NonNegative, within(0.0, 2.0, "m")]
Slope = Annotated[NonNegative, within(0.0, 2.0, "(rise over run)")]
HeightRange = Annotated[tuple[Height, Height], AfterValidator(ordered)]
SlopeRange = Annotated[tuple[Slope, Slope], AfterValidator(ordered)]


@dataclass(frozen=True)
class TerrainConfig(Strict):
    """Everything that shapes the ground. With `kind` "flat" the other numbers are checked and not used.

    Ranges ``(low, high)`` belong to difficulty 0 and 1; difficulty d = row / (rows - 1) interpolates linearly. Numbers
    without a source are chosen.

    Attributes:
        kind: "flat" (an infinite plane at height 0) or "tiles".
        rows: Difficulty levels (legged_gym: 10).
        cols: Columns, each of one tile type (legged_gym: 20).
        tile_size: Edge of a square tile, m, a whole number of samples (legged_gym: 8).
        border: Width of the flat strip round the tiles, m, a whole number of samples (Isaac Lab: 20). Beyond it there
            is no ground.
        resolution: Distance between samples, m (legged_gym, Isaac Lab: 0.1). Chosen for cost: 0.05 takes 1.2 to 1.5
            times as long a physics step, four times the memory and four times as long to draw (MuJoCo 4.0.0, one core,
            Go1 trotting on the top rows: 22 to 27 us a step at 0.1, 28 to 32 us at 0.05; 12 us on a plane).
        platform: Edge of the flat square in the middle of a tile where robots spawn, m.
        seed: Seed of the random heights, >= 0.
        boxes_proportion: Share of columns with boxes. The shares are relative: they need not add up to 1.
        bumps_proportion: Share of columns with bumps.
        ramps_proportion: Share of columns with ramps, half of them up to the platform, half down to it.
        flat_proportion: Share of columns without relief.
        stairs_proportion: Share of columns with stairs, half of them up to the platform, half down to it.
        obstacles_proportion: Share of columns with single blocks on flat ground.
        gaps_proportion: Share of columns with square rings of gaps round the platform.
        box_height: Largest height of a box above or below 0, m; heights are uniform in between (Isaac Lab, Go1: 0.1).
        box_cell: Edge of a square box, m (Isaac Lab: 0.45). Edges fall on the nearest sample and a riser is inclined
            over one sample, since a height field has no vertical walls.
        bump_amplitude: Largest height of a bump above or below 0, m; heights are uniform in between (Isaac Lab, Go1:
            0.06).
        bump_length: Distance over which the autocorrelation of the bumps, exp(-(r / length)^2), falls to 1/e, m.
        bump_blend: Width over which bumps fade in from the tile border and from the platform, m.
        ramp_slope: Rise over run of the four sides of the ramp pyramid (legged_gym, Isaac Lab: 0.4).
        stair_rise: Height of a step, m (legged_gym: 0.05 to 0.23).
        stair_tread: Depth of a step, m, best a whole number of samples (legged_gym: 0.31). A riser is inclined over one
            sample.
        obstacle_height: Largest height of a block, m; heights are uniform from half of it (legged_gym: 0.05 to 0.25).
        gap_width: Width of a gap at its top, m, rounded to samples; below two samples there is none.

    Raises:
        ValueError: If fields do not fit together; the message names every such field and what it may be.
    """

    kind: Literal["flat", "tiles"] = "flat"
    rows: Count = 10
    cols: Count = 20
    tile_size: Annotated[float, Field(gt=0, le=1e4)] = 8.0
    border: Annotated[float, Field(ge=0, le=1e4)] = 20.0
    resolution: Annotated[float, Field(ge=1e-3, le=1e4)] = 0.1
    platform: Positive = 2.0
    seed: CountOrZero = 0
    boxes_proportion: NonNegative = 0.3
    bumps_proportion: NonNegative = 0.3
    ramps_proportion: NonNegative = 0.3
    flat_proportion: NonNegative = 0.1
    stairs_proportion: NonNegative = 0.0
    obstacles_proportion: NonNegative = 0.0
    gaps_proportion: NonNegative = 0.0
    box_height: HeightRange = (0.0, 0.1)
    box_cell: Positive = 0.45
    bump_amplitude: HeightRange = (0.0, 0.06)
    bump_length: Positive = 0.25
    bump_blend: NonNegative = 0.5
    ramp_slope: SlopeRange = (0.0, 0.4)
    stair_rise: HeightRange = (0.0, 0.2)
    stair_tread: Positive = 0.3
    obstacle_height: HeightRange = (0.0, 0.2)
    gap_width: NonNegativeRange = (0.0, 0.4)

    def __post_init__(self) -> None:
        """Check what concerns several fields."""
        problems = []
        for name, length in (("tile_size", self.tile_size), ("border", self.border)):
            samples = length / self.resolution
            if abs(samples - round(samples)) > 1e-6:
                problems.append(f"{name} = {length}: must be a whole number of samples of {self.resolution} m")
        widest = self.tile_size - 4 * self.resolution
        if self.platform > widest:
            rule = f"must be at most {widest:g} (two samples short of the tile border)"
            problems.append(f"platform = {self.platform}: {rule}")
        if not any(self.shares):
            problems.append("boxes_proportion = 0: must be > 0 when the other proportions are 0 too")
        if problems:
            raise ValueError("\n".join(problems))

    @property
    def shares(self) -> tuple[float, ...]:
        """Relative share of columns of each of `TILE_TYPES`."""
        ramps, stairs = 0.5 * self.ramps_proportion, 0.5 * self.stairs_proportion
        first = (self.boxes_proportion, self.bumps_proportion, ramps, ramps, self.flat_proportion)
        return (*first, stairs, stairs, self.obstacles_proportion, self.gaps_proportion)

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of samples of a field of tiles, along y and x."""
        tile, edge = _samples(self.tile_size, self), _samples(self.border, self)
        return self.cols * tile + 2 * edge + 1, self.rows * tile + 2 * edge + 1

    def build(self) -> Terrain:
        """Build the ground; a subclass may build another kind."""
        return _build(self)

    def difficulty(self, row: int) -> float:
        """Return the difficulty of a row, 0 (easiest) to 1."""
        return row / (self.rows - 1) if self.rows > 1 else 0.0


@dataclass(frozen=True, eq=False)
class Terrain:
    """The ground as built.

    Attributes:
        heights: Height of each sample, (ny, nx), m, world frame. Sample [j, i] is at (x0 + i*resolution, y0 +
            j*resolution). A flat plane has four samples, all 0.
        x0: World x of the first column of samples, m.
        y0: World y of the first row of samples, m.
        resolution: Distance between samples, m.
        tile_origins: Centre of each tile on the ground, (rows, cols, 3), m, world frame; (1, 1, 3) zeros if flat.
        tile_types: Type of each column, from `TILE_TYPES`.
        config: What it was built from.
    """

    heights: FloatArray
    x0: float
    y0: float
    resolution: float
    tile_origins: FloatArray
    tile_types: tuple[str, ...]
    config: TerrainConfig

    @property
    def difficulty_per_level(self) -> FloatArray:
        """Difficulty that one level adds to a tile, (cols,): 0 for flat columns."""
        levels = max(self.config.rows - 1, 1) if self.config.kind != "flat" else 1
        return np.array([kind != "flat" for kind in self.tile_types]) / levels

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """World (x_min, x_max, y_min, y_max) of the samples, m."""
        ny, nx = self.heights.shape
        return self.x0, self.x0 + (nx - 1) * self.resolution, self.y0, self.y0 + (ny - 1) * self.resolution

    def height_at(self, xy: ArrayLike) -> FloatArray:
        """Return the height of the surface that MuJoCo collides with, m; outside the field, that of its nearest edge.

        MuJoCo splits each cell of a height field along the diagonal from its (low x, low y) to its (high x, high y)
        corner, in ray casts and contacts alike (found by experiment with 4.0.0, held by a test; MuJoCo Warp 4.0.0 has
        the same order in its source).

        Args:
            xy: World positions, (..., 2), m.
        """
        import torch

        ground = GroundHeight(torch.as_tensor(self.heights), self.x0, self.y0, self.resolution)
        return ground(torch.as_tensor(np.asarray(xy, dtype=np.float64))).numpy()


def build_terrain(config: TerrainConfig) -> Terrain:
    """Build the ground that `config` describes; the same config gives the same heights."""
    return config.build()


def _build(config: TerrainConfig) -> Terrain:
    if config.kind == "flat":
        return Terrain(np.zeros((2, 2)), -0.5, -0.5, 1.0, np.zeros((1, 1, 3)), ("flat",), config)

    types = column_types(config)
    tile, edge = _samples(config.tile_size, config), _samples(config.border, config)
    heights = np.zeros(config.shape)
    for row in range(config.rows):
        for col, tile_type in enumerate(types):
            j, i = edge + col * tile, edge + row * tile
            heights[j : j + tile + 1, i : i + tile + 1] = _tile(config, tile_type, row, col)
    heights = as_stored(heights)

    x0, y0 = (-0.5 * (n - 1) * config.resolution for n in heights.shape[::-1])
    origins = np.zeros((config.rows, config.cols, 3))
    origins[..., 0] = ((np.arange(config.rows) + 0.5 - 0.5 * config.rows) * config.tile_size)[:, None]
    origins[..., 1] = (np.arange(config.cols) + 0.5 - 0.5 * config.cols) * config.tile_size
    terrain = Terrain(heights, x0, y0, config.resolution, origins, types, config)
    origins[..., 2] = terrain.height_at(origins[..., :2])
    return terrain


def column_types(config: TerrainConfig) -> tuple[str, ...]:
    """Deal tile types to columns, (cols,): the first whose cumulative share exceeds j / cols + 0.001 (legged_gym)."""
    shares = np.array(config.shares)
    cumulative = np.cumsum(shares) / shares.sum()
    kinds = np.searchsorted(cumulative, np.arange(config.cols) / config.cols + 0.001, side="right")
    last = int(np.flatnonzero(shares)[-1])  # more than 1000 columns reach past 1
    return tuple(TILE_TYPES[min(int(kind), last)] for kind in kinds)


def lost_kinds(config: TerrainConfig) -> tuple[list[str], list[str]]:
    """Return the kinds with a share that get no column, and those whose hardest tile is flat although they have one."""
    types = column_types(config)
    shared = [kind for kind, share in zip(TILE_TYPES, config.shares, strict=True) if share]
    flat = [k for k in shared if k in types and not _tile(config, k, config.rows - 1, types.index(k)).any()]
    return [kind for kind in shared if kind not in types], [kind for kind in flat if kind != "flat"]


def _tile(config: TerrainConfig, tile_type: str, row: int, col: int) -> FloatArray:
    """Return the samples of one tile, both borders included, (n + 1, n + 1), m: 0 on the border, flat platform."""
    n = _samples(config.tile_size, config)
    along: FloatArray = (np.arange(n + 1, dtype=np.float64) - 0.5 * n) * config.resolution
    from_centre = np.maximum(np.abs(along)[:, None], np.abs(along))  # Chebyshev: level lines are squares
    from_border = 0.5 * n * config.resolution - from_centre
    flat_to = _platform_half(config)
    rng = np.random.default_rng([config.seed, row, col])
    d = config.difficulty(row)

    if tile_type == "boxes":
        return _between(config.box_height, d) * _unit_boxes(config, along, flat_to, rng)
    if tile_type == "bumps":
        window = np.ones_like(from_centre)
        if config.bump_blend > 0:
            window = _smoothstep(from_border / config.bump_blend)
            window = window * _smoothstep((from_centre - flat_to) / config.bump_blend)
        window = np.where((from_centre <= flat_to) | (from_border <= 0), 0.0, window)
        return _between(config.bump_amplitude, d) * window * _unit_bumps(config, n + 1, rng)
    if tile_type in ("ramp_up", "ramp_down"):
        run = np.clip(from_border, 0.0, 0.5 * n * config.resolution - flat_to)
        return (1.0 if tile_type == "ramp_up" else -1.0) * _between(config.ramp_slope, d) * run
    if tile_type in ("stairs_up", "stairs_down"):
        most = math.floor((0.5 * n * config.resolution - flat_to) / config.stair_tread + 1e-9)
        steps = np.minimum(np.floor(from_border / config.stair_tread + 1e-9), most)
        return (1.0 if tile_type == "stairs_up" else -1.0) * _between(config.stair_rise, d) * steps
    if tile_type == "obstacles":
        return _between(config.obstacle_height, d) * _unit_obstacles(config, along, flat_to, rng)
    if tile_type == "gaps":
        floor = round(_between(config.gap_width, d) / config.resolution + 1e-9) - 1  # samples; the walls are one each
        ring = np.rint((from_centre - flat_to) / config.resolution).astype(int)
        every = round(GAP_SPACING / config.resolution)
        low = (ring > 0) & (ring % every > every - 1 - floor) & (np.rint(from_border / config.resolution) > 1)
        return np.where(low, -GAP_DEPTH, 0.0)
    return np.zeros_like(from_centre)


def _unit_obstacles(config: TerrainConfig, along: FloatArray, flat_to: float, rng: np.random.Generator) -> FloatArray:
    """Return blocks on ground at 0, their heights in 0.5..1, the highest 1; none is on the platform or the border."""
    inner = 0.5 * config.tile_size - 1.5 * config.resolution
    heights = blocks((along, along), (-inner, inner), (-inner, inner), round(OBSTACLES * config.tile_size**2), rng)
    middle = np.abs(along) < flat_to + 1.5 * config.resolution
    heights[np.ix_(middle, middle)] = 0.0
    return heights / (heights.max() or 1.0)


def blocks(
    at: tuple[NDArray[np.floating], NDArray[np.floating]],
    first: tuple[float, float],
    second: tuple[float, float],
    count: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Return ``count`` blocks on ground at 0 at samples (n,) and (m,), (n, m), with heights in 0.5..1.

    Their centres, and what is left of them, lie within the bounds of the ``first`` and the ``second`` axis.
    """
    heights, bounds = np.zeros((len(at[0]), len(at[1]))), (first, second)
    for _ in range(count):
        centre, half = rng.uniform(*np.transpose(bounds)), 0.5 * rng.uniform(*OBSTACLE_EDGE, 2)
        inside = [
            (np.abs(v - c) <= h) & (v > low) & (v < high)
            for v, c, h, (low, high) in zip(at, centre, half, bounds, strict=True)
        ]
        heights[np.ix_(*inside)] = rng.uniform(0.5, 1.0)
    return heights


def _unit_boxes(config: TerrainConfig, along: FloatArray, flat_to: float, rng: np.random.Generator) -> FloatArray:
    """Return square cells of uniform random height in -1..1; what is left at the border and under the platform is 0."""
    count = max(0, math.floor((config.tile_size - 2 * config.resolution) / config.box_cell + 1e-9))
    cells = rng.uniform(-1.0, 1.0, (count, count))
    inner = np.abs((np.arange(count) + 0.5 - 0.5 * count) * config.box_cell) - 0.5 * config.box_cell
    near = inner < flat_to + 1e-9
    cells[near[:, None] & near] = 0.0
    cells = np.pad(cells, 1)  # cell -1 and cell `count`: the strip along the border
    index = np.clip(np.floor(along / config.box_cell + 0.5 * count + 1e-9).astype(int), -1, count) + 1
    return cells[index[:, None], index]


def _unit_bumps(config: TerrainConfig, size: int, rng: np.random.Generator) -> FloatArray:
    """Return smooth noise in -1..1 with uniform distribution, (size, size)."""
    from scipy.ndimage import gaussian_filter  # here, since checking a configuration should not wait for SciPy
    from scipy.special import erf

    # White noise under a Gaussian of width s has autocorrelation exp(-r^2 / (4 s^2)).
    noise = gaussian_filter(rng.standard_normal((size, size)), 0.5 * config.bump_length / config.resolution)
    return erf(noise / math.sqrt(2.0 * np.mean(noise**2)))


def as_stored(heights: FloatArray) -> FloatArray:
    """Round heights to what MuJoCo keeps, which is float32 in 0..1 times the span; exact zeros stay exact zeros.

    The change is at most half a float32 step of the span (6e-8 m for 2 m); without it contacts and `height_at` would
    differ by that much.
    """
    low, high = min(heights.min(), 0.0), max(heights.max(), 0.0)
    span = high - low
    if span == 0.0:
        return np.zeros_like(heights)
    share = ((heights - low) / span).astype(np.float32).astype(np.float64)
    return span * (share - np.float64(np.float32((0.0 - low) / span)))


def _platform_half(config: TerrainConfig) -> float:
    """Return half the platform edge rounded up to a sample, m, so that the whole platform is flat."""
    parity = 0.5 * (_samples(config.tile_size, config) % 2)  # an odd tile has its samples at odd half steps
    steps = math.ceil(0.5 * config.platform / config.resolution - parity - 1e-9)
    return (steps + parity) * config.resolution


def _samples(length: float, config: TerrainConfig) -> int:
    return round(length / config.resolution)


def _between(bounds: tuple[float, float], d: float) -> float:
    return bounds[0] + d * (bounds[1] - bounds[0])


def _smoothstep(t: FloatArray) -> FloatArray:
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
