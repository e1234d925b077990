"""The model predictive controller: forces, gait, feet, ground; walks by noisy sensors; every setting acts."""

from __future__ import annotations

import builtins
import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import yaml
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.cli.helptext import leaves
from go1exp.config.schema.registry import ConfigError
from go1exp.evaluate.controller import forces, gait
from go1exp.evaluate.controller.batch import Driven
from go1exp.evaluate.controller.forces import ForcePlan, Problem
from go1exp.evaluate.controller.gait import Clock, Feet
from go1exp.evaluate.controller.mpc import Mpc
from go1exp.evaluate.controller.settings import MpcSettings, parse_controller
from go1exp.evaluate.controller.state import Ground, frame
from go1exp.evaluate.controller.types import AsTargets, Sensed
from go1exp.evaluate.rollout import EvalConfig, evaluate
from go1exp.robot import GRAVITY
from go1exp.robot.messages import LowCmd
from go1exp.sim.env.core import Go1Core
from go1exp.sim.physics.dynamics import Kinematics
from go1exp.sim.physics.scene import load_robot
from go1exp.sim.task import TaskConfig

FILE = data_root() / "conf/controller/mpc.yaml"


def given(**changes: Any) -> dict[str, Any]:
    """What the file says, with other values under ``a.b``; it walks at once."""
    content: dict[str, Any] = yaml.safe_load(FILE.read_text()) | {"stand": 0.0}
    for key, value in changes.items():
        *path, last = key.split(".")
        place = content
        for part in path:
            place = place[part]
        place[last] = value
    return content


def settings(**changes: Any) -> MpcSettings:
    parsed = parse_controller(given(**changes))
    assert isinstance(parsed, MpcSettings)
    return parsed


MASS, INERTIA = 12.743, np.diag([0.127, 0.394, 0.423])  # kg, kg m2
HIPS = np.column_stack([gait.HIPS, np.zeros(4)])


def problem(seed: int | None = None, steps: int = 10, slope: tuple[float, float] = (0.0, 0.0)) -> Problem:
    """A robot that trots; with a seed, one that is somewhere else than it should be."""
    rng = np.random.default_rng(seed)
    state, reference = np.zeros((4, 3)), np.zeros((steps, 4, 3))
    state[1, 2] = reference[:, 1, 2] = 0.3
    arms = np.broadcast_to(HIPS - [0.0, 0.0, 0.3], (steps, 4, 3)).copy()
    trot = np.array([[True, False, False, True], [False, True, True, False]])
    stands = trot[np.arange(steps) // 3 % 2] if seed is not None else np.ones((steps, 4), dtype=bool)
    if seed is not None:
        state += rng.normal(0.0, [[0.1], [0.02], [0.5], [0.3]], (4, 3))
        reference[:, 3, :2] = rng.uniform(-1.0, 1.0, 2)
        arms += rng.normal(0.0, 0.03, arms.shape)
    attitude = Rotation.from_euler("xyz", [*state[0, :2], 0.0]).as_matrix()
    return Problem(state, reference, arms, stands, frame(*slope), attitude)


@pytest.fixture(scope="module")
def plan() -> ForcePlan:
    return ForcePlan(settings().force, MASS, INERTIA)


# ---------------------------------------------------------------------- forces


def test_at_rest_the_forces_carry_the_weight_evenly(plan: ForcePlan) -> None:
    found = plan.solve(problem())
    assert found is not None
    np.testing.assert_allclose(found[0].sum(0), [0.0, 0.0, MASS * GRAVITY], atol=1e-6)
    np.testing.assert_allclose(found[0, :, 2], MASS * GRAVITY / 4, atol=1e-6)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.25, -0.1)])
def test_forces_stay_in_the_friction_pyramid_of_the_ground(
    plan: ForcePlan, seed: int, slope: tuple[float, float]
) -> None:
    asked = problem(seed, slope=slope)
    found = plan.solve(asked)
    assert found is not None
    assert not found[~asked.stands].any()
    along, across, normal = (found[asked.stands] @ asked.ground).T
    mu = plan.settings.friction
    assert (normal >= -1e-6).all()
    assert (normal <= plan.settings.max_force + 1e-6).all()
    assert (np.abs(along) <= mu * normal + 1e-6).all()
    assert (np.abs(across) <= mu * normal + 1e-6).all()


def rolled_out(asked: Problem, found: np.ndarray, dt: float) -> np.ndarray:
    """The states (K, 4, 3) under forces (K, 4, 3), step by step: what the programme predicts, the slow way."""
    state, after = asked.state.copy(), []
    inverse = asked.attitude @ np.linalg.inv(INERTIA) @ asked.attitude.T
    for arms, each in zip(asked.arms, found, strict=True):
        turn = inverse @ np.cross(arms, each).sum(0)
        push = each.sum(0) / MASS - [0.0, 0.0, GRAVITY]
        state = state + dt * np.array([state[2], state[3], turn, push])
        state[0] += 0.5 * dt**2 * turn
        state[1] += 0.5 * dt**2 * push
        after.append(state)
    return np.array(after)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_programme_is_the_cost_of_its_own_prediction(plan: ForcePlan, seed: int) -> None:
    asked = problem(seed, slope=(0.1, 0.2))
    H, g, *_ = plan.programme(asked)
    w = plan.settings.weights
    weights = np.array([w.attitude, w.position, w.angular_velocity, w.velocity])
    share = MASS * GRAVITY / asked.stands.sum(1)[:, None] * asked.stands

    def cost(x: np.ndarray) -> float:
        found = np.zeros((*asked.stands.shape, 3))
        found[asked.stands] = x.reshape(-1, 3) @ asked.ground.T
        off = rolled_out(asked, found, plan.settings.dt) - asked.reference
        extra = found - share[..., None] * [0.0, 0.0, 1.0]
        return float((weights * off**2).sum() + plan.settings.effort * (extra**2).sum())

    rng = np.random.default_rng(seed)
    a, b = rng.normal(0.0, 30.0, (2, len(g)))
    found = (0.5 * a @ H @ a + g @ a) - (0.5 * b @ H @ b + g @ b)
    assert found == pytest.approx(cost(a) - cost(b), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("seed", [3, 4])
def test_the_solution_is_scipys(seed: int) -> None:
    small = dataclasses.replace(settings().force, steps=4, effort=1e-4)
    plan, asked = ForcePlan(small, MASS, INERTIA), problem(seed, steps=4)
    H, g, A, upper, lower = plan.programme(asked)
    n = len(g)
    scale = 100.0  # of forces, N: for the search's sake
    slow = minimize(
        lambda x: scale**2 * 0.5 * x @ H @ x + scale * g @ x,
        np.tile([0.0, 0.0, 0.5], n // 3),
        jac=lambda x: scale**2 * H @ x + scale * g,
        bounds=list(zip(lower[:n] / scale, upper[:n] / scale, strict=True)),
        constraints={"type": "ineq", "fun": lambda x: -A @ x, "jac": lambda x: -A},
        method="SLSQP",
        options={"ftol": 1e-13, "maxiter": 500},
    )
    assert slow.success
    quick = plan.solve(asked)
    assert quick is not None
    np.testing.assert_allclose(quick[asked.stands] @ asked.ground, scale * slow.x.reshape(-1, 3), atol=0.05)
    x = (quick[asked.stands] @ asked.ground).ravel() / scale
    assert slow.fun == pytest.approx(scale**2 * 0.5 * x @ H @ x + scale * g @ x, rel=1e-3)


def test_a_missing_solver_is_one_line_that_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "daqp":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(forces.SolverError, match=r"^controller=mpc: needs daqp.*go1exp\[mpc\]'$"):
        ForcePlan(settings().force, MASS, INERTIA)


# ---------------------------------------------------------------------- gait, feet, ground, swing, kinematics


def test_a_trot_swings_diagonal_pairs_in_turn() -> None:
    clock = Clock((0.0, 0.5, 0.5, 0.0), 0.5, 0.4)
    assert clock.stands().tolist() == [True, False, False, True]
    ahead = clock.schedule(4, 0.1)
    assert ahead.tolist() == [[True, False, False, True]] * 2 + [[False, True, True, False]] * 2
    clock.advance(0.25)
    assert clock.stands().tolist() == [False, True, True, False]
    np.testing.assert_allclose(clock.swing_share(), [0.25, -0.75, -0.75, 0.25])


def test_a_foot_lands_when_it_feels_the_ground_early_or_late() -> None:
    clock, feet, places = Clock((0.0, 0.5, 0.5, 0.0), 0.5, 0.4), Feet(15.0, 0.002), np.zeros((4, 3))
    all_feel, none_feel = np.full(4, 30.0), np.zeros(4)
    feet.update(clock, all_feel, places)
    assert feet.down.tolist() == [True, False, False, True]
    clock.advance(0.05)  # a quarter of the swing: what is felt there is the ground that is left
    feet.update(clock, all_feel, places)
    assert feet.down.tolist() == [True, False, False, True]
    clock.advance(0.1)  # three quarters
    feet.update(clock, all_feel, places + 1.0)
    assert feet.down.all()
    assert (feet.anchor == 1.0).all()
    clock.advance(0.05)  # FR and RL leave; the others have landed already
    feet.update(clock, all_feel, places + 2.0)
    assert feet.down.tolist() == [False, True, True, False]
    assert (feet.lift[[0, 3]] == 2.0).all()
    clock.advance(0.2)  # FR and RL should stand and find nothing
    for k in range(3):
        assert feet.update(clock, none_feel, places) == (k == 0)
        assert feet.overdue[[0, 3]] == pytest.approx(0.002 * (k + 1))
    feet.update(clock, all_feel, places)
    assert feet.down[[0, 3]].all()
    assert not feet.overdue.any()


def test_the_ground_is_the_plane_below_the_feet() -> None:
    a, b, high = 0.2, -0.1, 0.3
    feet = HIPS + np.random.default_rng(0).normal(0.0, 0.05, (4, 3))
    feet[:, 2] = a * feet[:, 0] + b * feet[:, 1] - high + robot.FOOT_RADIUS
    below = Ground(settings().stance, 0.05, 0.002)
    for _ in range(2000):
        below.update(feet, np.ones(4, dtype=bool), np.zeros(3))
    np.testing.assert_allclose(below.gradient, [a, b], atol=1e-6)
    assert below.height == pytest.approx(high, abs=1e-6)
    axes = frame(a, b)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes[:, 2] @ [1.0, 0.0, a], 0.0, atol=1e-12)
    np.testing.assert_allclose(axes[:, 2] @ [0.0, 1.0, b], 0.0, atol=1e-12)
    feet[:, 2] *= 10.0
    for _ in range(2000):
        below.update(feet, np.ones(4, dtype=bool), np.zeros(3))
    assert math.hypot(*below.gradient) == pytest.approx(math.tan(settings().stance.max_slope))


def test_the_way_of_a_foot_begins_and_ends_at_rest_and_its_velocity_is_its_derivative() -> None:
    start, end = np.array([[0.1, 0.2, 0.0]]), np.array([[0.3, 0.1, 0.05]])
    for share, place in ((0.0, start), (1.0, end)):
        at, velocity = gait.way(start, end, 0.09, np.array([share]), 0.2)
        np.testing.assert_allclose(at, place, atol=1e-12)
        np.testing.assert_allclose(velocity, 0.0, atol=1e-12)
    assert gait.way(start, end, 0.09, np.array([0.5]), 0.2)[0][0, 2] == pytest.approx(0.025 + 0.09)
    for s in (0.2, 0.7):
        early, late = (gait.way(start, end, 0.09, np.array([s + d]), 0.2)[0] for d in (-1e-6, 1e-6))
        found = gait.way(start, end, 0.09, np.array([s]), 0.2)[1]
        np.testing.assert_allclose(found, (late - early) / (2e-6 * 0.2), rtol=1e-6)


def test_feet_stand_half_a_stance_behind_and_half_a_stance_ahead_of_the_hip() -> None:
    legs = np.arange(4)
    gain = settings().swing.velocity_gain
    placed = gait.footholds(gain, np.array([1.0, 0.0, 0.0]), (1.0, 0.0, 0.0), np.full(4, 0.1), 0.2, legs)
    np.testing.assert_allclose(placed, gait.HIPS + np.array([0.2, 0.0]))
    turning = gait.footholds(gain, np.zeros(3), (0.0, 0.0, 1.0), np.zeros(4), 0.2, legs)
    np.testing.assert_allclose(turning - gait.HIPS, 0.1 * np.cross([0.0, 0.0, 1.0], HIPS)[:, :2], atol=1e-12)


def test_kinematics_are_mujocos() -> None:
    kin, model = Kinematics(), load_robot().compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    quat = Rotation.from_rotvec([0.2, -0.3, 1.0]).as_quat(scalar_first=True)
    q = robot.NOMINAL_STANCE + rng.normal(0.0, 0.2, 12)
    place, velocity, gyro, qd = rng.normal(size=3), rng.normal(size=3), rng.normal(size=3), rng.normal(size=12)
    kin.update(place, quat, q, velocity, gyro, qd)
    data.qpos[:], data.qvel[:] = [*place, *quat, *q], [*velocity, *gyro, *qd]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(kin.bias, data.qfrc_bias[6:], atol=1e-9)
    np.testing.assert_allclose(kin.feet, [data.site(f"{leg}_foot").xpos for leg in robot.LEGS])
    np.testing.assert_allclose(kin.com, data.subtree_com[1])
    for leg in range(4):
        moved = q.copy()
        moved[3 * leg + 1] += 1e-6
        before = kin.feet[leg].copy()
        column = kin.jacobians[leg][:, 1].copy()
        kin.update(place, quat, moved, velocity, gyro, qd)
        np.testing.assert_allclose((kin.feet[leg] - before) / 1e-6, column, atol=1e-5)
        kin.update(place, quat, q, velocity, gyro, qd)


def test_the_robot_as_one_body_is_the_sum_of_its_links() -> None:
    kin, model = Kinematics(), load_robot().compile()
    data = mujoco.MjData(model)
    data.qpos[:] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *robot.NOMINAL_STANCE]
    mujoco.mj_forward(model, data)
    wanted = np.zeros((3, 3))
    for k in range(1, model.nbody):
        turn, off = data.ximat[k].reshape(3, 3), data.xipos[k] - data.subtree_com[1]
        wanted += turn @ np.diag(model.body_inertia[k]) @ turn.T
        wanted += model.body_mass[k] * (off @ off * np.eye(3) - np.outer(off, off))
    assert kin.mass == pytest.approx(12.743, abs=0.001)
    np.testing.assert_allclose(kin.composite_inertia(), wanted, atol=1e-9)


# ---------------------------------------------------------------------- the controller


def readings(steps: int, seed: int = 0) -> Iterator[Sensed]:
    """Readings of a robot that stands, shakes and feels the ground now and then."""
    rng = np.random.default_rng(seed)
    for k in range(steps):
        lean = 0.1 * math.sin(0.05 * k)
        quat = Rotation.from_euler("xyz", [lean, 0.5 * lean, 0.3]).as_quat(scalar_first=True)
        loads = np.array([60.0, 20.0 * (k > 50), 0.0, 20.0]) if k < 60 else np.zeros(4)  # then the feet find no ground
        q = robot.NOMINAL_STANCE + 0.02 * rng.normal(size=12)
        yield Sensed(q, rng.normal(size=12), quat, 0.3 * rng.normal(size=3), 0.5 + 0.3 * rng.normal(size=3), loads)


def told(one: Mpc, steps: int = 160) -> np.ndarray:
    """All that the drives are told (steps, 48)."""
    commands = [one.step((0.6, 0.2, 0.8), each) for each in readings(steps)]
    return np.array(
        [[*c.joint_target, *c.kp, *c.kd, *(c.feedforward if c.feedforward is not None else ())] for c in commands]
    )


OTHER: dict[str, Any] = {
    "stand": 0.1,
    "period": 0.004,
    "height": 0.29,
    "swing.reach": 0.01,
    "gait.offsets": [0.0, 0.25, 0.5, 0.75],
    "force.steps": 6,
    "force.max_force": 60.0,
    "force.effort": 1e-4,
    "stance.slope": False,
    "stance.max_slope": 0.01,
    "stance.kd": 0.5,
    "stance.contact_force": 30.0,
    "smoothing.velocity": 0.05,
    "force.max_lag": 0.001,
    "force.max_turn_lag": 0.001,
}
"""Other values of keys where half as much again is not one."""

EVERY = [(key, value) for key, value in leaves(given()).items() if key != "name"]


@pytest.fixture(scope="module")
def usual() -> np.ndarray:
    return told(Mpc(settings()))


def test_it_stands_before_it_walks(usual: np.ndarray) -> None:
    later = told(Mpc(settings(stand=0.1)), 60)
    assert (later[:50, :12] == robot.NOMINAL_STANCE).all()
    assert (later[:50, 12:24] > 0.0).all()
    assert not later[:50, 36:].any()
    assert (later[50] != later[49]).any()


@pytest.mark.parametrize("stand", [0.0, 0.1])
def test_a_new_start_is_a_new_start(stand: float, usual: np.ndarray) -> None:
    one = Mpc(settings(stand=stand))
    first = told(one, 60) if stand else usual
    told(one, 33)
    one.reset()
    np.testing.assert_array_equal(told(one, len(first)), first)


@pytest.mark.parametrize(("key", "value"), EVERY, ids=[key for key, _ in EVERY])
def test_every_setting_acts(key: str, value: Any, usual: np.ndarray) -> None:
    more = [1.5 * v + 0.1 for v in value] if isinstance(value, list) else None
    other = OTHER.get(key, more if more else 1.3 * value)
    assert (told(Mpc(settings(**{key: other}))) != usual).any()


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("height", 1.0, r"^controller\.height = 1\.0: .*less than or equal to 0\.4"),
        ("force.steps", 2.5, r"^controller\.force\.steps = 2\.5"),
        ("force.weights.velocity", [0.2, -1.0, 0.1], r"^controller\.force\.weights\.velocity\.1 = -1\.0"),
        ("gait.offsets", [0.0, 0.5], r"^controller\.gait\.offsets"),
        ("swing.hight", 0.1, r"^controller\.swing\.hight: unknown key"),
        ("name", "mcp", r"^controller\.name: unknown controller 'mcp'; did you mean 'mpc'"),
    ],
)
def test_a_wrong_setting_is_named(key: str, value: Any, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        settings(**{key: value})


class Asks:
    """A controller that always asks for the same."""

    period = 0.002

    def __init__(self, drive: LowCmd) -> None:
        self.drive = drive

    def reset(self) -> None:
        """Forget nothing."""

    def step(self, command: object, sensed: object) -> LowCmd:
        return self.drive


def test_targets_alone_make_the_same_torque() -> None:
    rng = np.random.default_rng(0)
    target, kp, kd, torque = (rng.uniform(0.0, 2.0, 12) for _ in range(4))
    drive = LowCmd(target, kp, kd, feedforward=torque)
    sensed = next(readings(1))
    kp, kd = np.full(12, 20.0), np.full(12, 0.5)
    found = AsTargets(Asks(drive), kp, kd).step((0.0, 0.0, 0.0), sensed)
    assert found.feedforward is None
    assert drive.feedforward is not None
    q, qd = sensed.joint_pos, sensed.joint_vel
    wanted = drive.kp * (drive.joint_target - q) - drive.kd * qd + drive.feedforward
    np.testing.assert_allclose(kp * (found.joint_target - q) - kd * qd, wanted, atol=1e-12)


WALK = EvalConfig(((0.5, 0.0, 0.0),), 1, 5.0, 2.0, noise=True, trunk_velocity="estimated")
LATE = ("backend.threads=1", "effect=command_delay", "effect.command_delay.delay=0.005")


def test_it_walks_by_noisy_sensors_the_estimator_and_late_commands(make_task: Callable[..., TaskConfig]) -> None:
    brief = dataclasses.replace(WALK, seconds=2.0, settle_s=1.0)
    report = evaluate(make_task(*LATE), None, brief, controller=lambda: Mpc(settings()))
    (row,) = report["commands"]
    assert row["falls"] == 0
    assert math.hypot(row["rmse"]["x"], row["rmse"]["y"]) <= 0.1
    assert row["mean"]["x"] == pytest.approx(0.5, abs=0.05)


@pytest.mark.slow("go1exp/evaluate/controller/", "go1exp/deploy/estimation/", "conf/controller/")
@pytest.mark.parametrize(
    "command", [(0.5, 0.0, 0.0), (1.5, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 1.0)]
)
def test_it_walks_all_ways(command: tuple[float, float, float], make_task: Callable[..., TaskConfig]) -> None:
    config = dataclasses.replace(WALK, commands=(command,), episodes=2)
    (row,) = evaluate(make_task(*LATE), None, config, controller=lambda: Mpc(settings()))["commands"]
    assert row["falls"] == 0
    assert math.hypot(row["rmse"]["x"], row["rmse"]["y"]) <= 0.1


def test_a_driven_robot_does_in_a_batch_what_it_does_alone(make_core: Callable[..., Go1Core]) -> None:
    options = ("rand=none", "event=none", "termination=none", "command=forward")

    def run(n: int) -> torch.Tensor:
        core = make_core(*options, num_envs=n, noise=False, imu=True)
        observation = core.reset()
        driven = Driven(core, lambda: Mpc(settings()), noise=False, seed=0)
        for _ in range(5):
            observation = core.step(driven(observation)).observation
        return core.backend.qpos[:1].clone()

    assert torch.equal(run(1), run(3))


def test_a_period_that_does_not_fit_the_physics_is_refused(make_core: Callable[..., Go1Core]) -> None:
    core = make_core("rand=none", "event=none", num_envs=1, imu=True)
    with pytest.raises(
        ConfigError, match=r"controller\.period = 0\.003: must be a multiple of the physics step, 0\.002"
    ):
        Driven(core, lambda: Mpc(settings(period=0.003)), noise=False, seed=0)
