"""Lanes of rising difficulty: their shapes, where robots start, and what counts as passed."""

from __future__ import annotations

import numpy as np
import pytest

from go1exp.evaluate.protocol.ground import COURSE, RESOLUTION, RUN_UP, SHAPES, TREAD, UNITS, Lanes, goal
from go1exp.sim.terrain import build_terrain


def profile(lanes: Lanes, lane: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance from the start, and height, along the middle of a lane."""
    terrain = build_terrain(lanes)
    x = np.arange(0.0, goal(), RESOLUTION / 2)
    y = terrain.tile_origins[0, lane, 1]
    return x, terrain.height_at(np.stack([x, np.full_like(x, y)], 1))


@pytest.mark.parametrize("sign", [1, -1])
def test_slopes_have_their_angle(sign: int) -> None:
    lanes = Lanes(ground="slope_up" if sign > 0 else "slope_down", levels=(10.0, 30.0))
    for lane, angle in enumerate((10.0, 30.0)):
        x, height = profile(lanes, lane)
        on = (x > RUN_UP + 0.1) & (x < RUN_UP + COURSE - 0.1)
        np.testing.assert_allclose(np.polyfit(x[on], height[on], 1)[0], sign * np.tan(np.radians(angle)), rtol=1e-4)
        assert (height[x <= RUN_UP] == 0.0).all()


def test_stairs_have_their_rise_and_tread() -> None:
    _, height = profile(Lanes(ground="stairs_up", levels=(0.1, 0.2)), 1)
    levels = np.unique(height.round(6))
    steps = levels[np.isclose(levels / 0.2, np.round(levels / 0.2), atol=1e-4)]
    np.testing.assert_allclose(np.diff(steps), 0.2, atol=1e-5)
    assert len(steps) == 1 + np.ceil(COURSE / TREAD)


@pytest.mark.parametrize("ground", ["gravel", "waves", "boxes"])
def test_the_difficulty_is_the_largest_height(ground: str) -> None:
    terrain = build_terrain(Lanes(ground=ground, levels=(0.02, 0.1)))  # type: ignore[arg-type]
    assert terrain.heights.max() == pytest.approx(0.1, rel=0.02)
    assert terrain.heights.min() == 0.0
    again = build_terrain(Lanes(ground=ground, levels=(0.02, 0.1)))  # type: ignore[arg-type]
    assert np.array_equal(terrain.heights, again.heights)


def test_every_lane_starts_on_flat_ground_and_its_end_is_on_the_map() -> None:
    assert set(SHAPES) == set(UNITS)
    for ground in UNITS:
        terrain = build_terrain(Lanes(ground=ground, levels=(0.05, 0.1, 0.2)))  # type: ignore[arg-type]
        assert terrain.tile_origins.shape == (1, 3, 3)
        assert (terrain.tile_origins[..., 2] == 0.0).all()
        assert terrain.extent[1] - 1.0 > goal() + 0.5  # starts differ by half a metre
        assert terrain.extent[0] + 1.0 <= -0.5
