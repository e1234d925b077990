"""The robot comes first: pictures become fewer while it loses time."""

from __future__ import annotations

import pytest

from go1exp.evaluate.viewer.web import FRAME_S, SLOWEST_FRAME_S, PictureRate


def passed(rate: PictureRate, begin: float, seconds: int, lost: float) -> None:
    """Let seconds pass, in each of which the robot loses ``lost`` s, in fifty parts."""
    for k in range(1, 50 * seconds + 1):
        rate.note(begin + k / 50, lost / 50)


def test_pictures_become_fewer_while_the_robot_loses_time_and_more_again() -> None:
    rate = PictureRate(0.0)
    passed(rate, 0.0, 5, 0.01)
    assert rate.every == FRAME_S
    passed(rate, 5.0, 2, 0.5)
    assert FRAME_S < rate.every < SLOWEST_FRAME_S
    passed(rate, 7.0, 20, 0.5)
    assert rate.every == SLOWEST_FRAME_S
    passed(rate, 27.0, 60, 0.0)
    assert rate.every == FRAME_S


def test_it_tells_when_the_rate_has_changed() -> None:
    rate = PictureRate(0.0)
    assert [rate.note(now, 0.1) for now in (0.5, 0.9, 1.0, 1.1)] == [False, False, True, False]
    assert rate.every == pytest.approx(1.3 * FRAME_S)
