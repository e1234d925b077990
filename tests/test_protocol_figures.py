"""Figures of protocols on motions made by hand: effort, symmetry, touchdowns, thresholds of terrain, the map's area."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import go1exp.evaluate.protocol.kinds  # noqa: F401  (registers them)
from go1exp import robot
from go1exp.config.compose import compose
from go1exp.evaluate.protocol.base import chosen
from go1exp.evaluate.protocol.kinds import gait, hardware, push_map, rate, terrain
from go1exp.evaluate.protocol.kinds.energy import effort
from go1exp.evaluate.protocol.plan import Motion
from go1exp.evaluate.protocol.stage import delay_of_effects
from go1exp.mdp.measures.trace import Trace
from go1exp.sim.task import parse_train

STEPS, DT = 100, 0.02


def trace(torque: float, speed: float, velocity: float, until: int = STEPS) -> Trace:
    """One robot of 10 kg whose joints all have this torque and speed; it counts for ``until`` steps."""
    joints = np.ones((STEPS, 1, robot.NUM_JOINTS), np.float32)
    return Trace(
        contact=np.ones((STEPS, 1, robot.NUM_LEGS), bool),
        contact_dt=DT,
        counts=(np.arange(STEPS) < until)[:, None],
        mass=np.array([10.0]),
        base_lin_vel_b=np.tile(np.array([velocity, 0.0, 0.0], np.float32), (STEPS, 1, 1)),
        joint_torque=torque * joints,
        joint_vel=speed * joints,
    )


def motion(**changes: Any) -> Motion:
    plain: dict[str, Any] = {
        "dt": DT,
        "t": (1 + np.arange(STEPS)) * DT,
        "command": np.zeros((STEPS, 1, 3)),
        "velocity": np.zeros((STEPS, 1, 3)),
        "height": np.full((STEPS, 1), 0.3),
        "way": np.zeros((STEPS, 1)),
        "alive": np.ones((STEPS, 1), bool),
        "fell": np.zeros(1, bool),
        "left_map": np.zeros(1, bool),
        "front_right": np.zeros((STEPS, 1)),
    }
    return Motion(**{**plain, **changes})


def test_effort_is_what_the_formulas_say() -> None:
    """12 joints of 5 N m at -2 rad/s brake 120 W; 10 kg at 0.5 m/s."""
    braking = {k: float(v[0]) for k, v in effort(trace(5.0, -2.0, 0.5)).items()}
    weight = 10.0 * 9.81 * 0.5
    assert braking["power_p99"] == pytest.approx(120.0)
    assert braking["power_max"] == pytest.approx(120.0)
    assert braking["cost_of_transport_abs"] == pytest.approx(120.0 / weight)
    assert braking["heat_per_way"] == pytest.approx(12 * 25.0 / weight)
    assert braking["protect_level"] == 2.0
    assert braking["saturated"] == 0.0
    full = effort(trace(23.7, 0.0, 0.5))
    assert full["saturated"][0] == pytest.approx(2 / 3)  # calves have more
    assert np.isnan(effort(trace(5.0, 1.0, 0.05))["cost_of_transport_abs"][0])
    assert np.isnan(effort(trace(5.0, 1.0, 0.5, until=0))["power_max"][0])


def test_symmetry_is_the_worst_pairs() -> None:
    assert gait._asymmetry([0.5, 0.5, 0.5, 0.5]) == 0.0
    assert gait._asymmetry([0.5, 0.6, 0.4, 0.4]) == pytest.approx(0.1 / 0.55)
    assert gait._asymmetry([0.5, None, 0.4, 0.4]) is None


def test_touchdowns_are_found_to_the_physics_step() -> None:
    """A foot that lands at 0.213 s and again 0.36 s later, and bounces once in between."""
    t = (1 + np.arange(STEPS)) * DT
    on = np.zeros(STEPS)
    for start, stop in ((0.213, 0.40), (0.415, 0.43), (0.573, 0.75), (0.933, 1.1)):
        inside = (t >= start) & (t < stop)
        on[inside] = t[inside] - start
    first, second = push_map.touchdowns(motion(front_right=on[:, None]), 0)
    assert first == pytest.approx(0.213)
    assert second == pytest.approx(0.573)
    still = push_map.touchdowns(motion(), 0)
    assert still[1] - still[0] == push_map.GUESS


def test_the_area_of_a_circle_of_medians() -> None:
    rows = [{"direction_deg": 22.5 * k, "impulse": 20.0, "robot": 0} for k in range(16)]
    assert push_map._area(rows) == pytest.approx(0.5 * 16 * np.sin(np.pi / 8) * 400.0)
    assert push_map._weakest([*rows[:-1], {**rows[-1], "impulse": 7.0}]) == 7.0


def test_where_half_pass_stays_within_the_ladder() -> None:
    def rows(passing: int) -> list[dict[str, Any]]:
        return [{"difficulty": float(d), "passed": d <= passing, "robot": n} for d in (5, 10, 15) for n in range(20)]

    assert terrain._where(rows(99), 0.5, 15.0) == 15.0
    assert terrain._where(rows(0), 0.5, 15.0) == 0.0
    assert 10.0 < terrain._where(rows(10), 0.5, 15.0) < 15.0
    assert terrain._where(rows(10), 0.95, 15.0) < terrain._where(rows(10), 0.5, 15.0)


def test_the_lag_counts_from_the_instant_of_the_command() -> None:
    """A velocity that follows 0.15 s late, at the ends of the steps at whose starts the commands are given."""
    protocol: Any = chosen(compose("eval", ["protocol=sinusoid", "protocol.sinusoid.robots=1"])["protocol"])[0][
        0
    ].protocol
    sine, steps = protocol.ladder[3], 1750
    end = (1 + np.arange(steps)) * DT
    command, velocity = sine.at(end - DT)[:, None], sine.at(end - 0.15)[:, None]
    row: dict[str, Any] = {"fell": False, "left_map": False}
    protocol._answers(motion(t=end, command=command, velocity=velocity), slice(0, 1), sine, [row], {})
    for axis in ("x", "y", "yaw"):
        assert row[f"lag_{axis}"] == pytest.approx(0.15, abs=2e-3)
        assert row[f"gain_{axis}"] == pytest.approx(1.0, abs=2e-3)


def test_a_delay_of_the_robots_own_stays() -> None:
    task = parse_train(compose("train", ["effect=command_delay", "effect.command_delay.delay=0.015"])).task
    assert delay_of_effects(task) == pytest.approx(0.015)
    assert delay_of_effects(parse_train(compose("train", [])).task) == 0.0


def test_the_delay_margin_ends_where_the_first_robot_falls() -> None:
    rows = [{"delay_ms": d, "fell": d >= 30.0 and n == 1, "robot": n} for d in (0.0, 10.0, 20.0, 30.0) for n in (0, 1)]
    assert hardware._margin(rows) == 20.0
    assert hardware._margin([r for r in rows if r["delay_ms"] < 30.0]) == 20.0
    assert hardware._margin([{**r, "fell": True} for r in rows]) == 0.0  # beyond the limit, and not unknown


def test_the_gain_of_a_faster_rate_is_paired() -> None:
    of: Any = type("Two", (), {"slower_faster": (50.0, 100.0)})()
    slow = [{"rate_hz": 50.0, "rmse_xy": v} for v in (0.3, 0.5, None)]
    fast = [{"rate_hz": 100.0, "rmse_xy": v} for v in (0.2, 0.3, 0.1)]
    assert rate.Rate._gain(of, [*slow, *fast]) == pytest.approx(0.15)


def test_time_under_a_command_ends_with_the_fall() -> None:
    command = np.zeros((STEPS, 1, 3))
    command[10:] = 1.0
    alive = (np.arange(STEPS) < 60)[:, None]
    assert motion(command=command, alive=alive).moving_s[0] == pytest.approx(50 * DT)
