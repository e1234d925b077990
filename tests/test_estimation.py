"""The Kalman filter: C++ against its NumPy twin, against closed forms, and on a real robot under motion capture.

Run as a script with a folder, it takes the extension from there: ``make sanitise``.
"""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from benchmarks.replay import estimate
from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError, bind
from go1exp.deploy.estimation import (
    WIDTH,
    EstimatorError,
    FilterConfig,
    Status,
    compiled_legs,
    from_json,
    go1,
    make_filter,
    readings,
    sample,
    scaler,
    to_json,
)
from go1exp.logs.record.plan import Episode, make_motion
from go1exp.logs.record.sensors import Channel, SensorConfig
from go1exp.logs.record.simulate import Rig, play
from go1exp.logs.recording import VECTORS
from go1exp.mdp.kinematics import foot_positions
from go1exp.sim.task import parse_task
from tests.kalman import NumpyFilter, foot
from tests.made import real

GRAVITY = np.array([0.0, 0.0, 9.81])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
STANCE = robot.NOMINAL_STANCE
CONFIGS = {
    "force": lambda: go1(),
    "torque": lambda: go1(contact_source="torque"),
    "height": lambda: go1(contact_source="height", contact_low=-0.05, contact_high=-0.01, foot_radius=0.0),
    "scaler": scaler,
}


def random_motion(config: FilterConfig, rows: int, seed: int) -> np.ndarray:
    """Samples (rows, 51) that mean nothing, but visit every branch: swing, slip, gaps, late and broken samples."""
    rng = np.random.default_rng(seed)
    rest = np.concatenate(
        [STANCE[3 * k : 3 * k + 3] if leg.kind == "chain" else leg.centre for k, leg in enumerate(config.legs)]
    )
    t = np.cumsum(rng.choice([0.002, 0.01, 0.2, 0.0, -0.003], p=[0.6, 0.36, 0.01, 0.02, 0.01], size=rows))
    phase = 12.0 * t[:, None]
    states = np.empty((rows, WIDTH))
    states[:, readings.T] = t
    states[:, readings.QUAT] = Rotation.from_rotvec(rng.normal(0, 0.1, (rows, 3))).as_quat(scalar_first=True)
    states[:, readings.GYRO] = rng.normal(0, 0.5, (rows, 3))
    states[:, readings.ACC] = GRAVITY + rng.normal(0, 2.0, (rows, 3)) * rng.choice(
        [1, 20], p=[0.99, 0.01], size=(rows, 1)
    )
    states[:, readings.Q] = rest + 0.1 * np.sin(phase + np.arange(12)) + rng.normal(0, 0.01, (rows, 12))
    states[:, readings.QD] = 1.2 * np.cos(phase + np.arange(12)) + rng.normal(0, 0.1, (rows, 12))
    states[:, readings.TAU] = rng.normal(0, 6.0, (rows, 12)) + [0.0, 0.0, 6.0] * 4
    states[:, readings.FOOT_FORCE] = 60 * np.sin(phase + np.array([0, np.pi, np.pi, 0])) + rng.normal(0, 3.0, (rows, 4))
    broken = rng.random(rows) < 0.02
    states[broken, rng.integers(0, WIDTH, broken.sum())] = rng.choice([np.nan, np.inf, -np.inf], broken.sum())
    return states


def check_twins(config: FilterConfig, rows: int, seed: int) -> set[Status]:
    """Run both filters side by side; return what became of the samples."""
    fast, slow, statuses = make_filter(config), NumpyFilter(config), set()
    for row in random_motion(config, rows, seed):
        status = Status(fast.update(row))
        assert status == slow.update(row)
        statuses.add(status)
        if slow.running:
            np.testing.assert_allclose(fast.state, slow.x, rtol=0, atol=1e-9)
            np.testing.assert_allclose(fast.covariance, slow.P, rtol=0, atol=1e-9)
            np.testing.assert_allclose(fast.velocity_b, slow.velocity_b, rtol=0, atol=1e-9)
            np.testing.assert_allclose(fast.position_w, slow.position_w, rtol=0, atol=1e-9)
            np.testing.assert_allclose(fast.contact, slow.contact, rtol=0, atol=1e-12)
    assert np.isfinite(fast.state).all()
    return statuses


# ---------------------------------------------------------------------- a motion that is known exactly


def joints_for(config: FilterConfig, feet_b: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """Joint angles (12,) that put the feet (4, 3) there, by Newton's method."""
    q = guess.reshape(4, 3).copy()
    for k, leg in enumerate(config.legs):
        for _ in range(4):
            position, jacobian, _ = foot(leg, q[k])
            q[k] += np.linalg.solve(jacobian, feet_b[k] - position)
    return q.ravel()


@cache
def stroll(config: FilterConfig, seconds: float, dt: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """A trunk that sways, yaws and rolls over feet that never lift: samples without noise, and the true velocity."""
    t = np.arange(0, seconds, dt)
    feet_w = np.array([foot(leg, q)[0] for leg, q in zip(config.legs, STANCE.reshape(4, 3), strict=True)])
    imu, w = np.array(config.imu_position), 2.0

    def pose(t: float) -> tuple[np.ndarray, Rotation]:
        s = 1 - np.cos(w * t)
        return s * np.array([0.04, 0.02, 0.01]), Rotation.from_rotvec(s * np.array([0.05, 0.03, 0.1]))

    def legs(t: float, guess: np.ndarray) -> np.ndarray:
        r, turn = pose(t)
        return joints_for(config, turn.inv().apply(feet_w - r), guess)

    def imu_place(t: float) -> np.ndarray:
        r, turn = pose(t)
        return r + turn.apply(imu)

    rows, truth, q, h = [], [], STANCE.copy(), 1e-4
    for now in t:
        _, turn = pose(now)
        q = legs(now, q)
        qd = (legs(now + h, q) - legs(now - h, q)) / (2 * h)
        acc = (imu_place(now + h) - 2 * imu_place(now) + imu_place(now - h)) / h**2
        gyro = (turn.inv() * pose(now + h)[1]).as_rotvec() / h
        speed = (pose(now + h)[0] - pose(now - h)[0]) / (2 * h)
        rows.append(
            sample(
                now,
                turn.as_quat(scalar_first=True),
                gyro,
                turn.inv().apply(acc + GRAVITY),
                q,
                qd,
                None,
                np.full(4, 30.0),
            )
        )
        truth.append(turn.inv().apply(speed))
    return np.array(rows), np.array(truth)


def exact(**changes: object) -> FilterConfig:
    """A Go1 with points for feet on hard, uneven ground: so the stroll's truth is exact."""
    usual = {"foot_radius": 0.0, "initial_bias": 0.01, "sinking": 1.0, "level_noise": 0.0}
    return go1(**{**usual, **changes})


def standing(t: float, **changes: np.ndarray) -> np.ndarray:
    given = {"quat": LEVEL, "gyro": np.zeros(3), "acc": GRAVITY, "q": STANCE, "qd": np.zeros(12)}
    return sample(t, **{**given, "foot_force": np.full(4, 30.0), **changes})


# ---------------------------------------------------------------------- kinematics


def test_the_go1s_feet_are_where_its_model_has_them() -> None:
    """In closed form, which is the model's and the vendor's: test_feet.py, test_robot_model.py."""
    low, high = robot.JOINT_POS_LIMITS.T
    q = np.random.default_rng(0).uniform(low, high, (20, 12))
    feet = np.array([[foot(leg, one[3 * k : 3 * k + 3])[0] for k, leg in enumerate(go1().legs)] for one in q])
    np.testing.assert_allclose(feet, foot_positions(torch.as_tensor(q)), atol=1e-5)


@pytest.mark.parametrize("config", [go1(), scaler()], ids=["chain", "polynomial"])
def test_both_kinematics_agree_and_their_jacobian_is_the_slope(config: FilterConfig) -> None:
    rng = np.random.default_rng(0)
    for k, (leg, fast) in enumerate(zip(config.legs, compiled_legs(config), strict=True)):
        centre = STANCE[3 * k : 3 * k + 3] if leg.kind == "chain" else np.array(leg.centre)
        for q in centre + rng.uniform(-0.2, 0.2, (20, 3)):
            for numpy_result, cpp_result in zip(foot(leg, q), fast.foot(q), strict=True):
                np.testing.assert_allclose(numpy_result, cpp_result, rtol=0, atol=1e-13)
            steps = 1e-6 * np.eye(3)
            slope = np.stack([(foot(leg, q + s)[0] - foot(leg, q - s)[0]) / 2e-6 for s in steps], axis=1)
            np.testing.assert_allclose(foot(leg, q)[1], slope, atol=1e-8)


def test_a_chains_link_turns_as_its_joints_say() -> None:
    leg, q = go1().legs[1], np.array([0.3, 0.7, -1.4])

    def attitude(q: np.ndarray) -> Rotation:
        return Rotation.from_rotvec([q[0], 0, 0]) * Rotation.from_rotvec([0, q[1] + q[2], 0])

    turning = foot(leg, q)[2]
    for axis, step in enumerate(1e-6 * np.eye(3)):
        rate = (attitude(q + step) * attitude(q - step).inv()).as_rotvec() / 2e-6
        np.testing.assert_allclose(turning[:, axis], rate, atol=1e-8)


# ---------------------------------------------------------------------- the oracle


@pytest.mark.parametrize("name", CONFIGS)
def test_cpp_and_numpy_agree_over_random_motions(name: str) -> None:
    statuses = check_twins(CONFIGS[name](), rows=600, seed=1)
    assert statuses == set(Status), "the motion must try everything that a sample can be"


def test_many_samples_at_once_are_the_same_as_one_by_one() -> None:
    rows = random_motion(go1(), 300, seed=2)
    whole, single = make_filter(go1()), make_filter(go1())
    states = whole.run(rows)
    for k, row in enumerate(rows):
        status = single.update(row)
        expected = np.concatenate([single.position_w, single.velocity_b, single.contact, [status]])
        np.testing.assert_array_equal(states[k], expected)


# ---------------------------------------------------------------------- what it must find


@pytest.mark.slow("go1exp/deploy/estimation/", "go1exp/evaluate/agents.py", "assets/estimation/", "hatch_build.py")
def test_a_swaying_robot_is_followed_exactly() -> None:
    rows, truth = stroll(exact(), seconds=4.0)
    states = make_filter(exact()).run(rows)
    assert np.abs(truth).max() > 0.08
    np.testing.assert_allclose(states[100:, 3:6], truth[100:], atol=2e-3)


def test_the_height_over_ground_is_that_of_the_trunk() -> None:
    states = make_filter(exact(foot_radius=robot.FOOT_RADIUS)).run(np.array([standing(k * 0.01) for k in range(100)]))
    feet = [foot(leg, q)[0][2] for leg, q in zip(go1().legs, STANCE.reshape(4, 3), strict=True)]
    assert states[-1, 2] == pytest.approx(robot.FOOT_RADIUS - min(feet), abs=2e-3)
    np.testing.assert_allclose(states[-1, 3:6], 0.0, atol=1e-3)


def test_without_any_foot_on_the_ground_it_falls_freely() -> None:
    config = exact(initial_bias=0.0)
    rows = np.array([standing(k * 0.01, acc=np.zeros(3), foot_force=np.zeros(4)) for k in range(31)])
    states = make_filter(config).run(rows)
    np.testing.assert_allclose(states[-1, 3:6], [0, 0, -9.81 * 0.3], atol=1e-9)
    np.testing.assert_allclose(states[-1, 2] - states[0, 2], -9.81 * 0.3**2 / 2, atol=1e-9)
    flying = make_filter(config)
    flying.run(np.array([standing(k * 0.01, acc=np.zeros(3), foot_force=np.zeros(4)) for k in range(201)]))
    least = 2.0 * config.initial_speed**2  # 2 s of a speed that is as unsure as at first: nothing contradicts it
    assert (np.diag(flying.covariance[:3, 3:6]) >= 0.999 * least).all()


def test_an_offset_of_the_accelerometer_is_learnt_while_standing() -> None:
    offset = np.array([0.15, -0.1, 0.0])
    rows = np.array([standing(k * 0.01, acc=GRAVITY + offset) for k in range(2000)])
    fast = make_filter(exact(initial_bias=0.2))
    states = fast.run(rows)
    np.testing.assert_allclose(fast.state[6:8], offset[:2], atol=0.01)
    np.testing.assert_allclose(states[-1, 3:6], 0.0, atol=2e-3)


@pytest.mark.slow("go1exp/deploy/estimation/", "go1exp/evaluate/agents.py", "assets/estimation/", "hatch_build.py")
def test_one_slipping_foot_moves_the_estimate_little() -> None:
    config = exact()
    rows, truth = (values.copy() for values in stroll(config, 4.0))
    for row in rows[200:]:  # its leg says that the trunk goes backward at 1.5 m/s, and nothing else does
        row[readings.QD][6:9] += np.linalg.solve(foot(config.legs[2], row[readings.Q][6:9])[1], [1.5, 0.0, 0.0])
    states = make_filter(config).run(rows)
    assert np.abs(states[200:, 3:6] - truth[200:]).max() < 0.05
    trusting = make_filter(exact(gate=1e12)).run(rows)
    assert np.abs(trusting[200:, 3:6] - truth[200:]).max() > 0.2


def test_all_feet_contradicting_makes_it_give_way() -> None:
    config = exact(lost_after=0.05)
    rows = [standing(k * 0.01) for k in range(200)]
    # carried off at 1.2 m/s between two samples: no accelerometer saw it, every leg says so
    feet = np.array([foot(leg, q)[0] for leg, q in zip(config.legs, STANCE.reshape(4, 3), strict=True)])
    q = STANCE
    for k in range(1, 16):
        q = joints_for(config, feet - [0.012 * k, 0, 0], q)
        slopes = [foot(leg, one)[1] for leg, one in zip(config.legs, q.reshape(4, 3), strict=True)]
        rows.append(
            standing(1.99 + k * 0.01, q=q, qd=np.concatenate([np.linalg.solve(J, [-1.2, 0, 0]) for J in slopes]))
        )
    states = make_filter(config).run(np.array(rows))
    assert abs(states[202, 3]) < 0.3
    assert states[-1, 3] == pytest.approx(1.2, abs=0.1)


def sinking_steps(config: FilterConfig, slope: float) -> np.ndarray:
    """A trunk that climbs at 0.5 m/s on a slope while each foot on the ground gives way, upward, at 0.05 m/s."""
    start = np.array([foot(leg, q)[0] for leg, q in zip(config.legs, STANCE.reshape(4, 3), strict=True)])
    start[:, 2] = start[:, 2].mean() + slope * start[:, 0]
    rows, q = [], STANCE.copy()
    velocity = np.array([-0.5, 0.0, -0.5 * slope + 0.05])  # of a standing foot against the trunk
    for k in range(1000):
        now, half = 0.01 * k, k // 20 % 2
        pair = np.array([half, 1 - half, 1 - half, half], dtype=bool)
        since = 0.01 * (k % 20) - 0.1
        feet = start + np.where(pair[:, None], since, -since) * np.array([-0.5, 0.0, -0.5 * slope])
        feet[pair, 2] += 0.05 * (since + 0.1)
        q = joints_for(config, feet, q)
        slopes = [foot(leg, one)[1] for leg, one in zip(config.legs, q.reshape(4, 3), strict=True)]
        qd = np.concatenate([np.linalg.solve(J, velocity) for J in slopes])
        rows.append(standing(now, q=q, qd=qd, foot_force=np.where(pair, 60.0, 0.0)))
    return np.array(rows)


@pytest.mark.slow("go1exp/deploy/estimation/", "go1exp/evaluate/agents.py", "assets/estimation/", "hatch_build.py")
@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_ground_that_gives_way_does_not_make_the_trunk_sink(slope: float) -> None:
    config = go1(foot_radius=0.0)
    rows = sinking_steps(config, slope)
    states = make_filter(config).run(rows)[500:, 3:6].mean(axis=0)
    np.testing.assert_allclose(states, [0.5, 0.0, 0.5 * slope], atol=0.02)
    without = make_filter(go1(foot_radius=0.0, level_noise=0.0)).run(rows)[500:, 3:6].mean(axis=0)
    assert without[2] < 0.5 * slope - 0.04


# ---------------------------------------------------------------------- what sensors do to it


@pytest.mark.parametrize(
    ("column", "bad"),
    [(c, b) for c in (0, 1, 6, 9, 14, 30, 48) for b in (np.nan, np.inf, -np.inf)]
    + [(c, 1e300) for c in (1, 6, 9, 14, 30)],
)
def test_what_no_sensor_reads_is_refused_and_changes_nothing(column: int, bad: float) -> None:
    fast = make_filter(go1())
    fast.run(np.array([standing(k * 0.01) for k in range(50)]))
    before = (fast.state, fast.covariance, fast.time)
    row = standing(0.5)
    row[column] = bad
    assert fast.update(row) == Status.INVALID
    np.testing.assert_array_equal(fast.state, before[0])
    np.testing.assert_array_equal(fast.covariance, before[1])
    assert fast.time == before[2]
    assert fast.update(standing(0.5)) == Status.OK


def test_what_the_settings_do_not_use_may_be_missing() -> None:
    row = sample(0.0, LEVEL, np.zeros(3), GRAVITY, np.concatenate([leg.centre for leg in scaler().legs]))  # type: ignore[union-attr]
    assert make_filter(scaler()).update(row) == Status.STARTED
    assert make_filter(go1()).update(row) == Status.INVALID


def test_late_samples_are_left_out() -> None:
    rows, _ = stroll(exact(), 1.0)
    shuffled = np.insert(rows, 50, rows[20:23], axis=0)
    states = make_filter(exact()).run(shuffled)
    assert (states[50:53, -1] == Status.LATE).all()
    np.testing.assert_array_equal(np.delete(states, [50, 51, 52], axis=0), make_filter(exact()).run(rows))


def test_one_wrong_stamp_far_ahead_does_not_stop_it() -> None:
    rows, truth = stroll(exact(), 4.0)
    wrong = rows.copy()
    wrong[100, readings.T] = 1e300
    fast = make_filter(exact())
    states = fast.run(wrong)
    assert (states[101:110, -1] == Status.LATE).all()
    assert states[110, -1] == Status.RESTARTED
    np.testing.assert_allclose(states[130:, 3:6], truth[130:], atol=0.02)


def test_dropped_samples_cost_little() -> None:
    rows, truth = stroll(exact(), 4.0)
    kept = np.random.default_rng(0).random(len(rows)) < 0.7
    kept[0] = True
    states = make_filter(exact()).run(rows[kept])
    assert (states[1:, -1] == Status.OK).all()
    np.testing.assert_allclose(states[100:, 3:6], truth[kept][100:], atol=5e-3)


def test_after_a_gap_the_place_is_kept_and_the_speed_learnt_anew() -> None:
    rows, truth = stroll(exact(), 4.0)
    cut = np.delete(rows, slice(150, 200), axis=0)
    states = make_filter(exact()).run(cut)
    assert states[150, -1] == Status.RESTARTED
    np.testing.assert_allclose(states[160:, 3:6], np.delete(truth, slice(150, 200), axis=0)[160:], atol=0.02)


def test_the_covariance_stays_sound_for_long() -> None:
    rows = random_motion(go1(), 2000, seed=3)
    fast = make_filter(go1())
    for _ in range(20):
        fast.run(rows)
        rows[:, readings.T] += rows[-1, readings.T] - rows[0, readings.T] + 0.01
        P = fast.covariance
        np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-12 * np.abs(P).max())
        scale = np.sqrt(np.diag(P))
        assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > -1e-9


# ---------------------------------------------------------------------- settings, and the missing extension


@pytest.mark.parametrize("config", [go1(), scaler()], ids=["go1", "scaler"])
def test_settings_survive_json(config: FilterConfig) -> None:
    assert from_json(to_json(config), "here") == config


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"gate": -1.0}, "here.gate = -1.0"),
        ({"gaet": 1.0}, "did you mean 'gate'"),
        ({"contact_low": 99.0}, "contact_high: must exceed contact_low"),
        ({"contact_source": "smell"}, "here.contact_source"),
        ({"imu_position": [0.0, 0.0]}, "here.imu_position"),
    ],
)
def test_wrong_settings_are_named(change: dict, complaint: str) -> None:
    text = json.dumps({**json.loads(to_json(go1())), **change})
    with pytest.raises(ConfigError, match="here") as caught:
        from_json(text, "here")
    assert complaint in str(caught.value)


def test_rolling_feet_need_chains() -> None:
    with pytest.raises(ConfigError, match="foot_radius"):
        scaler(foot_radius=0.02)


def test_a_missing_extension_says_how_to_build_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "go1exp.deploy.estimation._kalman", None)
    with pytest.raises(EstimatorError, match=r"C\+\+17 compiler.*make setup"):
        make_filter(go1())


def test_building_without_a_compiler_says_so_and_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    source = data_root() / "hatch_build.py"
    if not source.is_file():
        pytest.skip("not a checkout")
    hook = runpy.run_path(str(source))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(RuntimeError, match=r"no C\+\+ compiler: g\+\+, clang\+\+"):
        hook["compile_filter"](tmp_path / "out")
    monkeypatch.setenv("CXX", "no-such-compiler -O0")
    with pytest.raises(RuntimeError, match="no-such-compiler"):
        hook["compile_filter"](tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_filter_needs_nothing_heavy() -> None:
    heavy = "('torch', 'mujoco', 'stable_baselines3', 'hydra', 'omegaconf', 'scipy', 'pyarrow')"
    code = (
        "import sys; from go1exp.deploy.estimation import *; make_filter(go1()); "
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=data_root(), capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]", done.stderr


# ---------------------------------------------------------------------- robots, simulated and real


@pytest.mark.parametrize("source", ["force", "torque"])
def test_a_simulated_go1_that_squats_is_followed(source: Literal["force", "torque"]) -> None:
    """Holds the conventions of model, sensors and filter together: axes, signs, the IMU's place, feet and forces."""
    task = parse_task(compose("train", ["terrain=flat", "backend.threads=1"]))
    rig = Rig(task.robot, task.actuator, (), task.terrain, task.backend, 0.002)
    still = Channel(0.0, 0.0)
    sensors = SensorConfig(500.0, 0.0, 0.0, still, still, still, still, still, still, still, truth=True)
    squat, _ = bind("excitation", "squat", {"move": [0.35, 0.5]}, "squat")
    assert squat is not None
    episode = Episode("squat", "squat", make_motion(squat, 3.0, 500.0, 0), 60.0, 1.5, None, None, 0)
    (recording,) = play(rig, [episode], sensors, 0, lambda *_: None)
    states = estimate(recording, go1(contact_source=source))
    attitude = Rotation.from_quat(recording.block(*VECTORS["base_quat"]), scalar_first=True)
    velocity = attitude.inv().apply(recording.block(*VECTORS["base_lin_vel"]))
    error = (states.velocity_b - velocity)[250:]
    assert np.sqrt((velocity[250:] ** 2).sum(axis=1).mean()) > 0.1
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.02
    height = recording.block("base_pos_z_w")[:, 0]
    assert np.abs(states.position_w[250:, 2] - height[250:]).max() < 0.02


def test_on_the_real_scaler_it_beats_leg_odometry_by_far() -> None:
    from benchmarks.mocap import evaluate

    for run in (15, 23):
        states = evaluate(real(f"scaler_walk_mocap/run_{run}.npz"), scaler())
        assert states.filter_rmse < 0.09, states
        assert states.filter_rmse < 0.7 * states.odometry_rmse, states
        assert abs(states.filter_distance) < 0.6 * abs(states.odometry_distance), states


def _main(folder: Path, motions: Callable[[], None]) -> None:
    import importlib.util

    (file,) = folder.glob("_kalman.*.so")
    spec = importlib.util.spec_from_file_location("go1exp.deploy.estimation._kalman", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules["go1exp.deploy.estimation._kalman"] = module
    motions()


def _motions() -> None:
    for name, config in CONFIGS.items():
        statuses = check_twins(config(), rows=2000, seed=4)
        print(f"{name}: 2000 samples, {', '.join(sorted(s.name.lower() for s in statuses))}; C++ equals NumPy")
    make_filter(go1()).run(random_motion(go1(), 20000, seed=5))
    print("20000 samples in one call: no finding")


if __name__ == "__main__":
    _main(Path(sys.argv[1]), _motions)
