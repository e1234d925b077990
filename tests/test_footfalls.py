"""The gait diagram under a film."""

from __future__ import annotations

import numpy as np
import pytest

from go1exp.evaluate.footfalls import FIRST_RGB, GROUND_RGB, SECOND_RGB, SPAN, Footfalls

DT = 0.02
FRAME = np.full((480, 640, 3), 200, np.uint8)


def diagram(footfalls: Footfalls, frame: np.ndarray = FRAME) -> np.ndarray:
    drawn = footfalls.under(frame)
    assert drawn.shape[0] % 2 == 0  # films need even sides
    assert drawn.shape[1:] == frame.shape[1:]
    np.testing.assert_array_equal(drawn[: len(frame)], frame)
    return drawn[len(frame) :]


def filled(strip: np.ndarray, rgb: tuple[int, int, int]) -> np.ndarray:
    """Where the strip has a colour, without the letters at the left."""
    part = slice(76, 580) if strip.shape[1] == 640 else slice(None)
    return (strip == rgb).all(-1)[:, part]


def test_a_trot_shows_one_pair_at_a_time() -> None:
    footfalls = Footfalls(DT)
    for step in range(200):
        first = step // 10 % 2 == 0
        footfalls.add([first, not first, not first, first])
    strip = diagram(footfalls)
    one, other = (filled(strip, rgb).any(0) for rgb in (FIRST_RGB, SECOND_RGB))
    assert not (one & other).any()
    assert 0.4 < one.mean() < 0.55
    assert 0.4 < other.mean() < 0.55


def test_the_newest_contact_is_at_the_right_edge_and_the_oldest_leaves_at_the_left() -> None:
    footfalls = Footfalls(DT)
    for _ in range(round(SPAN / DT)):
        footfalls.add([False] * 4)
    footfalls.add([True, False, False, False])
    columns = np.flatnonzero(filled(diagram(footfalls), FIRST_RGB).any(0))
    assert 2 <= len(columns) <= 8
    right = columns.max()
    for _ in range(50):
        footfalls.add([False] * 4)
    moved = np.flatnonzero(filled(diagram(footfalls), FIRST_RGB).any(0))
    assert right - moved.max() == pytest.approx(0.5 * 502, abs=4)  # 1 s of 2 s
    for _ in range(60):
        footfalls.add([False] * 4)
    assert not filled(diagram(footfalls), FIRST_RGB).any()


def test_each_foot_has_a_row_of_its_own_and_another_episode_begins_with_an_empty_one() -> None:
    tops = []
    for foot in range(4):
        footfalls = Footfalls(DT)
        for _ in range(100):
            footfalls.add([k == foot for k in range(4)])
        strip = diagram(footfalls)
        rows = np.flatnonzero((filled(strip, FIRST_RGB) | filled(strip, SECOND_RGB)).mean(1) > 0.5)
        tops.append(rows.min())
        assert len(rows) >= 8
    assert tops == sorted(set(tops))
    footfalls.clear()
    assert not (filled(diagram(footfalls), FIRST_RGB) | filled(diagram(footfalls), SECOND_RGB)).any()


@pytest.mark.parametrize("size", [(64, 64), (120, 160), (720, 1280)])
def test_a_picture_of_any_size_gets_a_diagram(size: tuple[int, int]) -> None:
    footfalls = Footfalls(DT)
    footfalls.add([True] * 4)
    strip = diagram(footfalls, np.zeros((*size, 3), np.uint8))
    assert 10 < len(strip) < 0.5 * size[0]
    assert (strip == GROUND_RGB).all(-1).any()
