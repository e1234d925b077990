from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import mujoco
import numpy as np
import pytest
import torch

from go1exp.mdp.curricula import TerrainLevel, TrackedPath
from go1exp.mdp.ground import GroundHeight
from go1exp.sim.physics.scene import add_to_spec
from go1exp.sim.task import parse_parts
from go1exp.sim.terrain import TILE_TYPES, Terrain, TerrainConfig, build_terrain, column_types

CONFIG = TerrainConfig(kind="tiles", rows=4, cols=10, border=2.0, seed=3)
EVEN: dict[str, Any] = {
    "boxes_proportion": 1.0,
    "bumps_proportion": 1.0,
    "ramps_proportion": 2.0,
    "flat_proportion": 1.0,
    "stairs_proportion": 2.0,
    "obstacles_proportion": 1.0,
    "gaps_proportion": 1.0,
}
ONE_OF_EACH = replace(CONFIG, cols=len(TILE_TYPES), **EVEN)


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return build_terrain(CONFIG)


def tile(terrain: Terrain, row: int, col: int) -> np.ndarray:
    """Samples of one tile, borders included."""
    config = terrain.config
    n, edge = round(config.tile_size / config.resolution), round(config.border / config.resolution)
    return terrain.heights[edge + col * n : edge + (col + 1) * n + 1, edge + row * n : edge + (row + 1) * n + 1]


def compiled(terrain: Terrain) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec()
    add_to_spec(spec, terrain)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def cast(model: mujoco.MjModel, data: mujoco.MjData, xy: np.ndarray) -> np.ndarray:
    """World height at which vertical rays meet the floor, (n,)."""
    geom, top, down = np.full(1, -1, np.int32), 4.0, np.array([0.0, 0.0, -1.0])
    out = np.full(len(xy), np.nan)
    for k, (x, y) in enumerate(xy):
        out[k] = top - mujoco.mj_ray(model, data, np.array([x, y, top]), down, None, 1, -1, geom)
        assert geom[0] == model.geom("floor").id
    return out


def random_points(terrain: Terrain, n: int, seed: int = 0) -> np.ndarray:
    x_min, x_max, y_min, y_max = terrain.extent
    return np.random.default_rng(seed).uniform([x_min, y_min], [x_max, y_max], (n, 2))


# Configuration


def problems_of(change: dict) -> list[str]:
    """What is wrong with tiles of which something is changed."""
    return parse_parts({"terrain": {"kind": "tiles", **change}}, ("terrain",))[1]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"kind": "stairs"}, "terrain.kind = 'stairs': input should be 'flat' or 'tiles'"),
        ({"stair_rise": [0.1, 20.0]}, "terrain.stair_rise.1 = 20.0: must be from 0 to 2 m"),
        ({"ramp_slope": [0.0, 25.0]}, "terrain.ramp_slope.1 = 25.0: must be from 0 to 2 (rise over run)"),
        ({"rows": 0}, "terrain.rows = 0: input should be greater than or equal to 1"),
        ({"cols": 2.5}, "terrain.cols = 2.5: input should be a valid integer"),
        ({"rows": True}, "terrain.rows = True: input should be a valid integer"),
        ({"seed": -1}, "terrain.seed = -1: input should be greater than or equal to 0"),
        ({"tile_size": 0.0}, "terrain.tile_size = 0.0: input should be greater than 0"),
        ({"tile_size": float("nan")}, "terrain.tile_size = nan: input should be a finite number"),
        ({"tile_size": 8.05}, "terrain.tile_size = 8.05: must be a whole number of samples of 0.1 m"),
        ({"border": 0.55}, "terrain.border = 0.55: must be a whole number of samples of 0.1 m"),
        ({"border": -1.0}, "terrain.border = -1.0: input should be greater than or equal to 0"),
        ({"platform": 7.8}, "terrain.platform = 7.8: must be at most 7.6 (two samples short of the tile border)"),
        ({"boxes_proportion": -0.1}, "terrain.boxes_proportion = -0.1: input should be greater than or equal to 0"),
        (dict.fromkeys(EVEN, 0.0), "terrain.boxes_proportion = 0: must be > 0 when the other proportions are 0"),
        ({"box_height": [0.1, 0.05]}, "terrain.box_height = [0.1, 0.05]: low must not exceed high"),
        ({"bump_amplitude": 0.05}, "terrain.bump_amplitude = 0.05: input should be a valid array"),
        ({"ramp_slope": [0.0, 0.1, 0.2]}, "terrain.ramp_slope = [0.0, 0.1, 0.2]: tuple should have at most 2 items"),
        ({"ramp_slope": [-0.1, 0.1]}, "terrain.ramp_slope.0 = -0.1: input should be greater than or equal to 0"),
        ({"stairs": 1}, "terrain.stairs: unknown key 'stairs'"),
    ],
)
def test_a_bad_field_is_refused_by_name(change: dict, says: str) -> None:
    problems = problems_of(change)
    assert len(problems) == 1
    assert problems[0].startswith(says)


def test_all_bad_fields_are_named_at_once() -> None:
    named = [line.split(" = ")[0] for line in problems_of({"kind": "hills", "rows": -1, "box_cell": 0})]
    assert named == ["terrain.kind", "terrain.rows", "terrain.box_cell"]
    named = [line.split(" = ")[0] for line in problems_of({"border": 0.55, "platform": 9.0})]
    assert named == ["terrain.border", "terrain.platform"]


def test_yaml_lists_become_tuples() -> None:
    parts, _ = parse_parts({"terrain": {"kind": "tiles", "box_height": [0, 0.2]}}, ("terrain",))
    assert parts["terrain"].box_height == (0.0, 0.2)
    hash(parts["terrain"])


# Heights


def test_the_same_seed_gives_the_same_ground_and_another_seed_another(terrain: Terrain) -> None:
    again, other = build_terrain(CONFIG), build_terrain(replace(CONFIG, seed=4))
    np.testing.assert_array_equal(terrain.heights, again.heights)
    for name in ("boxes", "bumps"):
        col = terrain.tile_types.index(name)
        assert not np.array_equal(tile(terrain, 3, col), tile(other, 3, col))
        assert not np.array_equal(tile(terrain, 3, col), tile(terrain, 3, col + 1))


def test_columns_follow_the_proportions() -> None:
    types = column_types(TerrainConfig(kind="tiles"))
    assert types == ("boxes",) * 6 + ("bumps",) * 6 + ("ramp_up",) * 3 + ("ramp_down",) * 3 + ("flat",) * 2
    assert column_types(ONE_OF_EACH) == TILE_TYPES
    rng = np.random.default_rng(0)
    for _ in range(20):
        share: dict[str, Any] = dict(zip(EVEN, rng.dirichlet(np.ones(len(EVEN))), strict=True))
        types = column_types(replace(CONFIG, cols=40, **share))
        boxes, bumps, ramps, flat, stairs, obstacles, gaps = share.values()
        all_shares = (boxes, bumps, ramps / 2, ramps / 2, flat, stairs / 2, stairs / 2, obstacles, gaps)
        for name, expected in zip(TILE_TYPES, all_shares, strict=True):
            assert abs(types.count(name) - 40 * expected) <= 1.05
    only_boxes: dict[str, Any] = dict.fromkeys(EVEN, 0.0) | {"boxes_proportion": 2.0}
    assert set(column_types(replace(CONFIG, cols=3000, **only_boxes))) == {"boxes"}


@pytest.mark.parametrize("name", TILE_TYPES)
def test_difficulty_grows_with_the_row_and_stays_within_bounds(name: str) -> None:
    terrain = build_terrain(ONE_OF_EACH)
    tiles = [tile(terrain, row, TILE_TYPES.index(name)) for row in range(4)]
    relief = [t.std() for t in tiles]
    assert relief[0] == 0.0  # every range begins at 0
    if name == "flat":
        assert max(relief) == 0.0
        return
    if name == "gaps":  # they grow wider, not deeper; of one sample there is none
        assert relief[1] == 0.0 < relief[2] < relief[3]
        assert [t.min() for t in tiles[2:]] == pytest.approx([-0.5, -0.5], abs=1e-6)
        return
    assert all(np.diff(relief) > 0)
    run = 0.5 * (CONFIG.tile_size - CONFIG.platform)
    ramp, stairs = 0.4 * run, 0.2 * round(run / CONFIG.stair_tread)
    top = {"boxes": 0.1, "bumps": 0.06, "obstacles": 0.2} | dict.fromkeys(("ramp_up", "ramp_down"), ramp)
    top |= dict.fromkeys(("stairs_up", "stairs_down"), stairs)
    for row, heights in enumerate(tiles):
        bound, rounding = top[name] * row / 3, 1e-6
        assert np.abs(heights).max() <= bound + rounding
        assert np.abs(heights).max() >= 0.9 * bound


def test_a_range_starts_at_its_low_end() -> None:
    terrain = build_terrain(replace(ONE_OF_EACH, ramp_slope=(0.1, 0.4)))
    assert terrain.tile_origins[0, 2, 2] == pytest.approx(0.1 * 3.0, abs=1e-6)
    assert terrain.tile_origins[1, 2, 2] == pytest.approx(0.2 * 3.0, abs=1e-6)
    assert terrain.tile_origins[3, 3, 2] == pytest.approx(-0.4 * 3.0, abs=1e-6)


def test_a_ramp_has_its_slope_on_all_four_sides(terrain: Terrain) -> None:
    heights = tile(terrain, 3, terrain.tile_types.index("ramp_up"))
    middle = len(heights) // 2
    for line in (heights[middle], heights[middle, ::-1], heights[:, middle], heights[::-1, middle]):
        np.testing.assert_allclose(np.diff(line[:31]) / CONFIG.resolution, 0.4, atol=1e-5)


def test_stairs_have_their_rise_and_tread_on_all_four_sides() -> None:
    terrain = build_terrain(replace(ONE_OF_EACH, stair_rise=(0.05, 0.15)))
    heights = tile(terrain, 3, TILE_TYPES.index("stairs_down"))
    middle = len(heights) // 2
    for line in (heights[middle], heights[middle, ::-1], heights[:, middle], heights[::-1, middle]):
        risers = np.flatnonzero(np.diff(line[:41]))
        np.testing.assert_allclose(np.diff(line)[risers], -0.15, atol=1e-6)
        assert set(np.diff(risers)) == {3}  # 0.3 m at 0.1 m a sample
        assert len(risers) == 10


def test_gaps_are_as_wide_as_they_should_be_and_a_metre_apart() -> None:
    terrain = build_terrain(replace(ONE_OF_EACH, gap_width=(0.2, 0.5)))
    for row, width in enumerate((2, 3, 4, 5)):  # samples from edge to edge
        heights = tile(terrain, row, TILE_TYPES.index("gaps"))
        line = heights[len(heights) // 2, len(heights) // 2 :]  # from the centre outward
        edges = np.flatnonzero(np.diff((line < 0).astype(int)))
        assert edges[1] + 1 - edges[0] == width
        assert edges[2] - edges[0] == 10


def test_obstacles_stand_alone_on_flat_ground() -> None:
    heights = tile(build_terrain(ONE_OF_EACH), 3, TILE_TYPES.index("obstacles"))
    assert 0.05 < (heights > 0).mean() < 0.4
    assert heights[heights > 0].min() >= 0.1 - 1e-6  # half of the highest


def test_boxes_are_flat_squares_of_the_cell_size(terrain: Terrain) -> None:
    heights = tile(terrain, 3, terrain.tile_types.index("boxes"))
    risers = np.flatnonzero((np.diff(heights, axis=1) != 0).any(axis=0))
    assert 0.4 <= np.diff(risers).mean() * CONFIG.resolution <= 0.5
    assert set(np.diff(risers)) == {4, 5}  # 0.45 m at 0.1 m a sample


@pytest.mark.parametrize("change", [{}, {"tile_size": 7.9, "platform": 1.75}, {"bump_blend": 0.0}])
def test_platforms_are_flat_and_tile_borders_at_zero(change: dict) -> None:
    config = replace(ONE_OF_EACH, **change)
    terrain = build_terrain(config)
    half = 0.5 * config.platform
    spot = np.random.default_rng(0).uniform(-half, half, (500, 2))
    along = np.linspace(-0.5, 0.5, 301) * config.tile_size
    for row in range(config.rows):
        for col in range(config.cols):
            centre = terrain.tile_origins[row, col]
            np.testing.assert_allclose(terrain.height_at(centre[:2] + spot), centre[2], rtol=0, atol=1e-12)
            heights = tile(terrain, row, col)
            for side in (heights[0], heights[-1], heights[:, 0], heights[:, -1]):
                np.testing.assert_array_equal(side, 0.0)
            for end in (-0.5, 0.5):
                side = np.stack([along, np.full_like(along, end * config.tile_size)], axis=-1)
                for edge in (side, side[:, ::-1]):
                    np.testing.assert_allclose(terrain.height_at(centre[:2] + edge), 0.0, rtol=0, atol=1e-9)


def test_the_border_is_flat_and_the_field_centred(terrain: Terrain) -> None:
    edge = round(CONFIG.border / CONFIG.resolution)
    inside = np.zeros_like(terrain.heights, dtype=bool)
    inside[edge:-edge, edge:-edge] = True
    np.testing.assert_array_equal(terrain.heights[~inside], 0.0)
    np.testing.assert_allclose(terrain.extent, [-18.0, 18.0, -42.0, 42.0])
    np.testing.assert_allclose(terrain.tile_origins[0, 0, :2], [-12.0, -36.0])
    np.testing.assert_allclose(terrain.tile_origins[3, 9, :2], [12.0, 36.0])


def test_flat_ground_is_a_small_zero_field() -> None:
    terrain = build_terrain(TerrainConfig())
    assert terrain.heights.shape == (2, 2)
    assert not terrain.heights.any()
    np.testing.assert_array_equal(terrain.tile_origins, np.zeros((1, 1, 3)))
    far_out = np.array([[0.0, 0.0], [1e3, -1e3]])
    np.testing.assert_array_equal(terrain.height_at(far_out), 0.0)
    np.testing.assert_array_equal(ground(terrain)(torch.as_tensor(far_out)), 0.0)


# MuJoCo


def test_height_at_is_the_surface_that_rays_meet(terrain: Terrain) -> None:
    xy = random_points(terrain, 3000)
    np.testing.assert_allclose(terrain.height_at(xy), cast(*compiled(terrain), xy), rtol=0, atol=1e-9)


def test_height_at_is_the_surface_that_contacts_meet() -> None:
    config = replace(CONFIG, rows=2, cols=1, border=0.0, resolution=0.5)
    heights = np.random.default_rng(0).uniform(0.0, 0.2, (17, 33))
    terrain = Terrain(heights, -8.0, -4.0, 0.5, np.zeros((2, 1, 3)), ("boxes",), config)
    spec = mujoco.MjSpec()
    add_to_spec(spec, terrain)
    radius, depth, step = 1e-3, 1e-4, 1e-6
    ball = spec.worldbody.add_body()
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], contype=0, conaffinity=1)
    model = spec.compile()
    data = mujoco.MjData(model)
    tested = 0
    for xy in random_points(terrain, 300):
        u, v = ((xy - [terrain.x0, terrain.y0]) / 0.5) % 1.0
        if min(u, v, 1 - u, 1 - v, abs(u - v), abs(u + v - 1)) < 0.05:
            continue  # within reach of another triangle, whichever way the cell is split
        height = terrain.height_at(xy)
        slope = [(terrain.height_at(xy + d) - height) / step for d in ([step, 0.0], [0.0, step])]
        data.qpos[:] = [*xy, height + (radius - depth) * np.sqrt(1.0 + np.dot(slope, slope)), 1.0, 0.0, 0.0, 0.0]
        mujoco.mj_forward(model, data)
        assert data.contact.dist == pytest.approx([-depth], abs=1e-6)
        tested += 1
    assert tested > 100


def test_flat_ground_is_a_plane_and_the_floor_takes_contacts_as_agreed(terrain: Terrain) -> None:
    plane, _ = compiled(build_terrain(TerrainConfig()))
    field, _ = compiled(terrain)
    assert plane.geom("floor").type == mujoco.mjtGeom.mjGEOM_PLANE
    assert field.geom("floor").type == mujoco.mjtGeom.mjGEOM_HFIELD
    for model in (plane, field):
        floor = model.geom("floor")
        assert (floor.contype, floor.conaffinity, floor.bodyid) == (1, 0, 0)
        np.testing.assert_allclose(floor.friction, [1.0, 0.005, 0.0001])


@pytest.mark.parametrize("kind", ["flat", "tiles"])
def test_level_ground_of_either_kind_lies_at_zero(kind: Literal["flat", "tiles"]) -> None:
    """With one row all difficulty is 0 and the field is level: it must compile, and lie at height 0."""
    config = TerrainConfig(kind=kind, rows=1, cols=2, border=1.0)
    model, data = compiled(build_terrain(config))
    xy = np.random.default_rng(0).uniform(-4, 4, (50, 2))
    np.testing.assert_allclose(cast(model, data, xy), 0.0, rtol=0, atol=1e-12)


# torch


def ground(terrain: Terrain) -> GroundHeight:
    return GroundHeight(torch.tensor(terrain.heights).float(), terrain.x0, terrain.y0, terrain.resolution)


def test_the_environments_height_lookup_is_the_same_but_for_rounding(terrain: Terrain) -> None:
    xy = 1.2 * random_points(terrain, 20_000)  # some outside
    expected = terrain.height_at(xy)
    # float32 knows 42 m to 4e-6 m, which on the steepest riser (0.2 m over 0.1 m) is 8e-6 m of height.
    rounded = ground(terrain)(torch.as_tensor(xy, dtype=torch.float32))
    assert rounded.dtype == torch.float32
    np.testing.assert_allclose(rounded.numpy(), expected, rtol=0, atol=5e-5)


def test_torch_heights_keep_the_shape_of_the_points(terrain: Terrain) -> None:
    look_up = ground(terrain)
    xy = torch.as_tensor(random_points(terrain, 24), dtype=torch.float32)
    grid = look_up(xy.reshape(2, 3, 4, 2))
    assert grid.shape == (2, 3, 4)
    assert torch.equal(grid.flatten(), look_up(xy))
    assert look_up(xy[0]).shape == ()


def test_outside_the_field_the_nearest_edge_counts_and_nan_stays_nan() -> None:
    heights = torch.tensor([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]])
    look_up = GroundHeight(heights, 0.0, 0.0, 1.0)
    nan, inf = float("nan"), float("inf")
    xy = torch.tensor([[-5.0, -5.0], [9.0, 9.0], [1.0, 7.0], [2.0, 0.5], [inf, -inf], [nan, 0.0], [0.0, nan]])
    np.testing.assert_array_equal(look_up(xy).numpy(), [0.0, 5.0, 4.0, 3.5, 2.0, nan, nan])
    with pytest.raises(ValueError, match="heights"):
        GroundHeight(torch.zeros(1, 4), 0.0, 0.0, 1.0)


# Curriculum


@pytest.mark.parametrize(
    ("level", "distance", "commanded", "expected"),
    [
        (3, 6.0, 10.0, 4),  # exactly enough: up
        (3, 0.6, 1.0, 4),  # a slow command as well
        (3, 5.9, 10.0, 3),  # between the two: stay
        (3, 4.0, 10.0, 3),
        (3, 3.9, 10.0, 2),  # too little: down
        (3, 0.0, 0.0, 3),  # a zero command moves no robot
        (0, 0.0, 20.0, 0),  # the lowest level is a floor
        (9, 15.0, 20.0, 7),  # past the top: the random level
        (9, 10.0, 20.0, 9),  # staying at the top is not passing it
        (9, 0.0, 20.0, 8),
        (8, 15.0, 20.0, 9),
    ],
)
def test_terrain_levels_move_by_the_rule(level: int, distance: float, commanded: float, expected: int) -> None:
    after = TerrainLevel()(
        torch.tensor([level, 5]),
        torch.tensor([distance, 2.5]),
        torch.tensor([commanded, 5.0]),
        8.0,
        9,
        torch.tensor([7, 1]),
    )
    assert after.dtype == torch.int64
    assert after.tolist() == [expected, 5]  # and the neighbour stays where it was


def test_only_robots_that_follow_are_promoted_whatever_the_direction_of_the_command() -> None:
    """Commanded ahead, back, sideways, on the spot and round a circle; a second set of robots stands."""
    command = torch.tensor([(0.5, 0, 0), (-0.5, 0, 0), (0, 0.4, 0), (0, 0, 1), (0, 0, -1), (0.5, 0, 1)]).repeat(2, 1)
    moves = torch.arange(12) < 6
    path, dt, level = TrackedPath(12, torch.device("cpu")), 0.02, torch.full((12,), 3)
    position, yaw = torch.zeros(12, 3), torch.zeros(12)

    def attitude() -> torch.Tensor:
        return torch.stack([(yaw / 2).cos(), 0 * yaw, 0 * yaw, (yaw / 2).sin()], dim=1)

    path.begin(moves | True, position, attitude())
    for _ in range(500):
        x, y, rate = (command * moves.unsqueeze(1)).unbind(1)
        yaw = yaw + rate * dt / 2
        position = position + dt * torch.stack([x * yaw.cos() - y * yaw.sin(), x * yaw.sin() + y * yaw.cos(), 0 * x], 1)
        yaw = yaw + rate * dt / 2
        path.advance(dt, command, position, attitude())
    tracked, commanded = path.lengths().unbind(1)
    torch.testing.assert_close(tracked[:5], torch.tensor([5.0, 5.0, 4.0, 2.5, 2.5]), rtol=1e-3, atol=0.0)
    assert TerrainLevel()(level, tracked, commanded, 8.0, 9, level).tolist() == 6 * [4] + 6 * [2]
