"""States that come late, overtaken or not at all: how late is told, and what the estimator makes of them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from go1exp.deploy.estimation import Status, go1, make_filter, sample
from go1exp.deploy.runtime.estimate import LONGEST_AHEAD, KalmanEstimator, acceleration
from go1exp.deploy.runtime.report import summary_lines
from go1exp.deploy.runtime.udp import MOST_SLIP, WINDOW_S, PacketDelay, delays, slip, spread
from go1exp.robot.go1_fields import PERIOD
from go1exp.robot.messages import OVERTAKEN_S, LowState
from tests.made import shaking_state


def test_delays_are_those_beyond_the_fastest_of_the_last_second() -> None:
    """Against every packet compared with every other; the robot's clock is 300 ppm slow and begins elsewhere."""
    rng = np.random.default_rng(0)
    sent = PERIOD * np.arange(1500)
    way = 0.0007 + rng.exponential(0.002, len(sent))
    order = np.argsort(sent + way, kind="stable")
    arrived, clock = (sent + way)[order], (37.5 + (1.0 - 3e-4) * sent)[order]
    offset = arrived - clock
    slow = [o - offset[: k + 1][arrived[: k + 1] >= arrived[k] - WINDOW_S].min() for k, o in enumerate(offset)]
    np.testing.assert_allclose(delays(arrived, clock), slow, atol=1e-12)
    # What is told after a second is the true way less the fastest one, but for the clocks' drift within the window.
    off = delays(arrived, clock) - (way[order] - way.min())
    assert np.abs(off[500:]).max() < 3e-4 * WINDOW_S + 1e-4


@pytest.mark.parametrize("share", [0.14, -0.02, 0.0])
def test_the_slip_of_the_robots_clock_is_told_apart_from_delays(share: float) -> None:
    """A robot that is 14 % slow makes all packets of a second up to 140 ms late, by its clock."""
    rng = np.random.default_rng(4)
    sent = np.arange(0.0, 6.0, PERIOD)
    arrived = np.sort(sent + 0.0007 + rng.exponential(0.02, len(sent)))
    ticks = np.floor(1e3 * (1.0 - share) * sent) / 1e3
    assert slip(arrived, ticks) == pytest.approx(share, abs=MOST_SLIP)
    assert slip(arrived, np.full(len(sent), math.nan)) is None
    assert slip(arrived[: round(1.0 / PERIOD)], ticks[: round(1.0 / PERIOD)]) is None  # too short to tell
    if share > 0.0:
        late = spread(delays(arrived, ticks))
        assert late is not None
        assert late["p50"] > 0.1


@pytest.mark.parametrize(
    ("share", "words"),
    [(0.14, "at 0.8600x real time"), (-0.0021, "at 1.0021x real time"), (5e-4, None), (None, None)],
)
def test_delays_of_a_clock_that_slips_are_reported_with_a_note(share: float | None, words: str | None) -> None:
    times = {"p50": 0.1379, "p99": 0.282, "worst": 0.3}
    first, *notes = summary_lines({"packets": {"delay": times, "age": times, "clock_slip": share}})
    assert first.startswith("packets, relative to the fastest: delay p50 137.9")
    assert len(notes) == (words is not None)
    assert words is None or words in notes[0]


def test_a_walk_without_an_estimate_is_reported_and_so_are_commands_that_were_cut() -> None:
    velocity = {"mean": [0.5, 0.0, 0.0], "estimate_rmse": None, "tracking_rmse": [0.03, 0.02, 0.05], "distance": 2.0}
    lines = summary_lines({"velocity": velocity, "commands_cut": {"x": 150, "y": 0, "yaw": 0}})
    assert lines[0] == "true velocity +0.500 +0.000 +0.000 m/s over 2.0 m"
    assert lines[2:] == ["note: commands beyond the ranges of training were limited: x in 150 cycles"]
    assert summary_lines({"commands_cut": {"x": 0}}) == []


def test_the_age_counts_from_the_measurement_less_the_fastest_way() -> None:
    way = PacketDelay()
    assert math.isnan(way.age(5.0, 1.0))
    assert math.isnan(way.note(5.0, math.nan))
    assert math.isnan(way.age(5.0, 1.0))
    assert way.note(5.001, 1.0) == 0.0  # offset 4.001
    assert way.note(5.006, 1.002) == pytest.approx(0.003)
    assert way.age(5.007, 1.002) == pytest.approx(0.004)
    assert way.age(5.5, 1.002) == pytest.approx(0.497)
    assert spread(np.array([math.nan])) is None
    assert spread(np.array([0.0, 2.0, 1.0])) == {"p50": 1.0, "p99": pytest.approx(1.98), "worst": 2.0}


def test_the_change_of_the_velocity_is_that_of_a_body_that_turns_and_is_pushed() -> None:
    """Against differences over 0.1 ms of a motion with constant turning rate and force in the world."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        attitude = Rotation.random(random_state=int(rng.integers(1000)))
        rate, velocity, push = rng.normal(size=(3, 3)) * np.array([[3.0], [1.0], [8.0]])
        dt = 1e-4
        before, after = (attitude * Rotation.from_rotvec(rate * t) for t in (-dt / 2, dt / 2))
        change = after.inv().apply(velocity + push * dt / 2) - before.inv().apply(velocity - push * dt / 2)
        force = attitude.inv().apply(push + np.array([0.0, 0.0, 9.81]))
        row = sample(0.0, attitude.as_quat(scalar_first=True), rate, force, np.zeros(12))
        np.testing.assert_allclose(acceleration(row, attitude.inv().apply(velocity)), change / dt, atol=1e-5)


def state_at(k: int) -> LowState:
    """A state that arrives by another clock than the robot's own."""
    acc = np.array([0.5, -0.3, 9.81]) + np.random.default_rng(1000 + k).normal(size=3)
    return shaking_state(k, 7.0 + 1.05 * PERIOD * k, clock=PERIOD * k, imu_acc=acc)


def row(k: int) -> np.ndarray:
    """The sample of the filter in that state, by the robot's own clock."""
    s = state_at(k)
    return sample(s.clock, s.imu_quat, s.imu_gyro, s.imu_acc, s.joint_pos, s.joint_vel, None, s.foot_force)


def made() -> KalmanEstimator:
    def fail(name: str, message: str, t: float) -> None:
        raise AssertionError(message)

    return KalmanEstimator(go1(), fail)


def test_overtaken_states_take_their_turn() -> None:
    """Once all have come, the filter has taken the same numbers in the same order."""
    rng = np.random.default_rng(3)
    states = [state_at(k) for k in range(300)]
    late = [k for _, k in sorted((PERIOD * k + 0.005 * rng.random(), k) for k in range(290))]
    assert late != sorted(late)
    one, two = made(), made()
    for k in late:
        one.update(states[k])
    for state in states[:290]:
        two.update(state)
    for state in states[290:]:
        assert one.update(state).tobytes() == two.update(state).tobytes()
    assert one.refused == {"LATE": 0, "INVALID": 0}


def test_while_a_state_is_missing_the_imu_carries_the_velocity_on_and_then_the_filter_goes_on_without_it() -> None:
    estimator, oracle = made(), make_filter(go1())
    for k in range(100):
        estimator.update(state_at(k))
        oracle.update(row(k))
    velocity = np.array(oracle.velocity_b)
    # 100 is lost: 101 to 105 wait, and the velocity is integrated by trapezia over their accelerations.
    last = 99
    for k in range(101, 106):
        half = 0.5 * PERIOD * (k - last)
        velocity = velocity + half * (acceleration(row(last), velocity) + acceleration(row(k), velocity))
        np.testing.assert_allclose(estimator.update(state_at(k)), velocity, atol=1e-12)
        last = k
    ahead = velocity + 0.003 * acceleration(row(105), velocity)
    np.testing.assert_allclose(estimator.ahead(0.003), ahead, atol=1e-12)
    assert np.array_equal(estimator.ahead(math.nan), estimator.ahead(0.0))
    assert np.array_equal(estimator.ahead(1.0), estimator.ahead(LONGEST_AHEAD))
    # 106 is OVERTAKEN_S newer than 101: nobody waits any longer.
    assert round(OVERTAKEN_S / PERIOD) == 5
    found = estimator.update(state_at(106))
    for k in range(101, 107):
        assert Status(oracle.update(row(k))) is Status.OK
    np.testing.assert_allclose(found, oracle.velocity_b, atol=1e-12)
    # When it comes after all, its turn is over.
    assert np.array_equal(estimator.update(state_at(100)), found)
    assert estimator.refused == {"LATE": 1, "INVALID": 0}


def test_after_a_long_gap_nobody_waits() -> None:
    estimator, oracle = made(), make_filter(go1())
    for k in (*range(50), 60, 61):
        found = estimator.update(state_at(k))
        oracle.update(row(k))
        np.testing.assert_allclose(found, oracle.velocity_b, atol=1e-12)


def test_a_reading_that_is_none_carries_nothing_on() -> None:
    estimator = made()
    for k in range(100):
        before = estimator.update(state_at(k))
    blind = dataclasses.replace(state_at(101), imu_acc=np.full(3, math.nan))
    assert np.array_equal(estimator.update(blind), before)
