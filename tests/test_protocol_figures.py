"""Parts of protocols: figures by hand, lanes of rising difficulty, commands over time, kicks, verdicts on claims."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy import stats

from go1exp import robot
from go1exp.config.compose import compose
from go1exp.evaluate.protocol.claims import Claim, evaluated, verdict
from go1exp.evaluate.protocol.ground import COURSE, GOAL, RESOLUTION, RUN_UP, SHAPES, TREAD, UNITS, Lanes
from go1exp.evaluate.protocol.kinds import energy, gait, hardware, push_map, rate, terrain
from go1exp.evaluate.protocol.plan import Constant, Impulses, Kicker, Motion, Sine, Steps, heading, phasors, response
from go1exp.evaluate.protocol.stage import delay_of_effects
from go1exp.evaluate.quantities import FELL, FINGERPRINT, MOVING, Column, distinct, summary
from go1exp.evaluate.statistics.intervals import Interval
from go1exp.mdp.measures.trace import Trace
from go1exp.sim.task import parse_train
from go1exp.sim.terrain import build_terrain
from tests.test_protocols import selected

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
    braking = {k: float(v[0]) for k, v in energy.effort(trace(5.0, -2.0, 0.5)).items()}
    weight = 10.0 * 9.81 * 0.5
    assert braking["power_p99"] == pytest.approx(120.0)
    assert braking["power_max"] == pytest.approx(120.0)
    assert braking["cost_of_transport_abs"] == pytest.approx(120.0 / weight)
    assert braking["heat_per_way"] == pytest.approx(12 * 25.0 / weight)
    assert braking["protect_level"] == 2.0
    assert braking["saturated"] == 0.0
    full = energy.effort(trace(23.7, 0.0, 0.5))
    assert full["saturated"][0] == pytest.approx(2 / 3)  # calves have more
    assert np.isnan(energy.effort(trace(5.0, 1.0, 0.05))["cost_of_transport_abs"][0])
    assert np.isnan(energy.effort(trace(5.0, 1.0, 0.5, until=0))["power_max"][0])


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
    protocol: Any = selected("sinusoid", "robots=1").protocol
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


def profile(lanes: Lanes, lane: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance from the start, and height, along the middle of a lane."""
    terrain = build_terrain(lanes)
    x = np.arange(0.0, GOAL, RESOLUTION / 2)
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
        assert terrain.extent[1] - 1.0 > GOAL + 0.5  # starts differ by half a metre
        assert terrain.extent[0] + 1.0 <= -0.5


PERIOD = 3.5


def test_steps_and_rests_begin_when_they_say() -> None:
    t = np.arange(6) * 0.5
    steps = Steps(velocities=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), hold=1.0)
    assert steps.at(t)[:, 0].tolist() == [1, 1, 0, 0, 0, 0]
    assert Constant(velocity=(2.0, 0.0, 1.0), rest=1.0).at(t)[:, 2].tolist() == [0, 0, 1, 1, 1, 1]


@pytest.mark.parametrize("dt", [0.02, 0.013])
@pytest.mark.parametrize(("gain", "lag"), [(1.0, 0.0), (0.8, 0.12), (1.1, -0.05)])
def test_known_gain_and_lag_are_found(dt: float, gain: float, lag: float) -> None:
    """Also under the gait's own motion, an offset, and with a period that is no whole number of samples."""
    t = np.arange(round(35.0 / dt)) * dt
    command = Sine(amplitude=(1.0, 0.5, 1.0), period=PERIOD).at(t)
    gait = 0.2 * np.sin(2 * np.pi * 2.8 * t)[:, None]
    answer = gain * Sine(amplitude=(1.0, 0.5, 1.0), period=PERIOD).at(t - lag) + gait + 0.1
    answer[t < PERIOD] = 7.0  # the first period does not count
    found_gain, found_lag, coherence = response(answer, command, t, PERIOD)
    np.testing.assert_allclose(found_gain, gain, atol=6e-3)
    np.testing.assert_allclose(found_lag, lag, atol=6e-3)
    assert (coherence > 0.999).all()


def test_periods_that_are_answered_differently_have_little_coherence() -> None:
    t = np.arange(8750) * 0.02
    command = Sine(amplitude=(1.0, 1.0, 1.0), period=PERIOD).at(t)
    rng = np.random.default_rng(0)
    _, _, coherence = response(rng.normal(size=command.shape), command, t, PERIOD)
    assert (coherence < 0.2).all()


def test_without_a_second_period_there_is_no_answer() -> None:
    t = np.arange(100) * 0.02
    command = Sine(amplitude=(1.0, 1.0, 1.0), period=PERIOD).at(t)
    assert np.isnan(response(command, command, t, PERIOD)[0]).all()
    assert len(phasors(command, t, PERIOD)) == 0


# ---------------------------------------------------------------------- kicks


class Free:
    """A free-floating trunk as an engine of two robots, without gravity."""

    MODEL = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body><freejoint/>
    <geom type="box" size=".2 .1 .05" mass="12.5"/></body></worldbody></mujoco>"""

    def __init__(self) -> None:
        model = mujoco.MjModel.from_xml_string(self.MODEL)
        self.model, self.data = model, [mujoco.MjData(model) for _ in range(2)]
        self.qpos = torch.zeros(2, 7, dtype=torch.float64)
        self.qvel = torch.zeros(2, 6, dtype=torch.float64)
        self._applied = torch.zeros(2, 6, dtype=torch.float64)
        self.qpos[:, 3] = 1.0

    def applied(self) -> torch.Tensor:
        return self._applied

    def step(self, torque: torch.Tensor) -> None:
        for k, data in enumerate(self.data):
            data.qpos[:], data.qvel[:] = self.qpos[k].numpy(), self.qvel[k].numpy()
            data.qfrc_applied[:] = self._applied[k].numpy()
            mujoco.mj_step(self.model, data)
            self.qpos[k], self.qvel[k] = torch.from_numpy(data.qpos.copy()), torch.from_numpy(data.qvel.copy())


def kicked(backend: Free, impulses: Impulses, seconds: float) -> None:
    kicker = Kicker(backend, 0.002, impulses)
    for _ in range(round(seconds / 0.002)):
        backend.step(torch.zeros(2, 12))
    assert kicker.time == pytest.approx(seconds)


def test_an_impulse_is_the_momentum_that_it_gives() -> None:
    """Of a trunk that floats: m dv is the impulse, in the direction from its heading; others' forces stay."""
    backend = Free()
    backend.qpos[1, 3:7] = torch.tensor([np.cos(0.25), 0.0, 0.0, np.sin(0.25)])  # heading 0.5 rad
    assert heading(backend.qpos[:, 3:7]).tolist() == pytest.approx([0.0, 0.5])
    impulses = Impulses(
        start=np.array([[0.1, 0.4], [0.1, np.nan]]),
        size=np.array([[12.7, 6.4], [19.1, 5.0]]),
        direction=np.array([[np.pi / 2, np.pi / 2], [0.0, 0.0]]),
        duration=0.1,
    )
    backend.applied()[:, 2] = 1.0
    kicked(backend, impulses, 1.0)
    gained = 12.5 * backend.qvel[:, :3].numpy()
    np.testing.assert_allclose(gained[0], [0.0, 12.7 + 6.4, 1.0], atol=1e-9)
    np.testing.assert_allclose(gained[1], [19.1 * np.cos(0.5), 19.1 * np.sin(0.5), 1.0], atol=1e-9)
    assert backend.applied().tolist() == [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]] * 2


def test_a_kick_beside_the_centre_turns_the_trunk() -> None:
    """I dw is arm x impulse."""
    backend = Free()
    impulses = Impulses(np.full((2, 1), 0.0), np.full((2, 1), 3.0), np.full((2, 1), np.pi / 2), 0.002, (0.1, 0.0, 0.0))
    kicked(backend, impulses, 0.01)
    spin = backend.qvel[:, 5].numpy() * backend.model.body_inertia[1].max()
    np.testing.assert_allclose(spin, 0.1 * 3.0, rtol=1e-3)


# ---------------------------------------------------------------------- claims

MOST = Claim(quantity="error", at_most=1.0, tolerance=0.2, source="here")
LEAST = Claim(quantity="error", at_least=1.0, tolerance=0.2, source="here")
BETWEEN = Claim(quantity="error", at_least=0.9, at_most=1.1, tolerance=0.05, source="here")


@pytest.mark.parametrize(
    ("claim", "estimate", "low", "high", "said"),
    [
        (MOST, 0.9, 0.8, 1.0, "met"),
        (MOST, 0.9, 0.8, 1.01, "close"),
        (MOST, 1.0, 0.8, 1.2, "close"),
        (MOST, 1.0, 0.8, 1.21, "inconclusive"),
        (MOST, 1.2, 1.01, 1.5, "close"),
        (MOST, 1.21, 1.01, 1.5, "not met"),
        (MOST, 0.9, math.nan, math.nan, "inconclusive"),
        (MOST, math.nan, math.nan, math.nan, "inconclusive"),
        (LEAST, 1.1, 1.0, 1.2, "met"),
        (LEAST, 1.0, 0.8, 1.2, "close"),
        (LEAST, 1.0, 0.79, 1.2, "inconclusive"),
        (LEAST, 0.79, 0.6, 0.99, "not met"),
        (BETWEEN, 1.0, 0.9, 1.1, "met"),
        (BETWEEN, 1.0, 0.86, 1.14, "close"),
        (BETWEEN, 1.0, 0.8, 1.2, "inconclusive"),
        (BETWEEN, 1.3, 1.2, 1.4, "not met"),
        (BETWEEN, 0.7, 0.6, 0.8, "not met"),
    ],
)
def test_verdicts_at_their_borders(claim: Claim, estimate: float, low: float, high: float, said: str) -> None:
    assert verdict(Interval(estimate, low, high, 10), claim) == said


def test_a_claim_is_judged_by_its_worst_condition() -> None:
    rows = [{"speed": s, "error": e, "robot": n} for s, e in ((1.0, 0.5), (2.0, 3.0)) for n in range(5)]
    for n, row in enumerate(rows):
        row["error"] += 0.01 * (n % 5)
    entries = summary(rows, ("speed",), (Column("error", "m", "an error"),))
    everywhere = evaluated({"small": MOST}, entries)[0]
    assert (everywhere.word, everywhere.condition, everywhere.conditions) == ("not met", {"speed": 2.0}, 2)
    where = Claim(quantity="error", at_most=1.0, tolerance=0.2, source="here", where={"speed": 1.0})
    assert evaluated({"small": where}, entries)[0].word == "met"
    nowhere = Claim(quantity="error", at_most=1.0, tolerance=0.2, source="here", where={"speed": 7.0})
    assert evaluated({"small": nowhere}, entries)[0].word == "inconclusive"


@pytest.mark.parametrize("counted", [20, 10])
def test_falls_are_counted_per_moving_minute_of_robots_that_were_up_before(counted: int) -> None:
    """A robot that was down before has no fall of its own, and is not in the share."""
    rows = [
        {"a": 1, "robot": n, "fell": n < 3 if n < counted else None, "moving_s": 30.0 * (n < counted)}
        for n in range(20)
    ]
    figures = summary(rows, ("a",), (FELL, MOVING))[0]["figures"]
    assert (figures["fell"]["n"], figures["fell"]["estimate"]) == (counted, pytest.approx(3 / counted))
    assert figures["falls_per_minute"]["estimate"] == pytest.approx(3 / (0.5 * counted))
    known = stats.binomtest(3, counted).proportion_ci(method="wilson")
    assert figures["fell"]["low"] == pytest.approx(known.low, rel=1e-5)


def test_only_robots_that_did_the_same_are_repeats() -> None:
    rows = [{"a": a, "robot": n, FINGERPRINT: mark} for a in (1, 2) for n, mark in enumerate((0.5, 0.7, 0.5))]
    assert [(r["a"], r["robot"]) for r in distinct(rows, ("a",), True)] == [(1, 0), (1, 1), (2, 0), (2, 1)]
    assert [(r["a"], r["robot"]) for r in distinct(rows, ("a",), False)] == [(1, 0), (2, 0)]
