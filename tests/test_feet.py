"""Feet: swing and stance times, peak forces and touchdown speeds over every substep; no foot starts in the ground."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from itertools import groupby, pairwise

import mujoco
import numpy as np
import pytest
import torch

from go1exp import robot
from go1exp.config.compose import compose
from go1exp.extend.testing.snapshots import random_snapshot
from go1exp.mdp.derived import slip_speed
from go1exp.mdp.feet import Feet
from go1exp.mdp.kinematics import foot_positions
from go1exp.mdp.rewards import foot_force, foot_peak_force
from go1exp.sim.env.core import Go1Core
from go1exp.sim.physics.scene import build_model, load_robot
from go1exp.sim.task import TaskConfig, parse_task
from go1exp.sim.terrain import build_terrain

QUIET = ("rand=none", "event=none", "termination=none", "command=forward")


def feed(feet: Feet, force: float, descent: float) -> None:
    """One physics step in which every foot of every robot has this vertical force and downward speed."""
    like = torch.zeros(len(feet.air), robot.NUM_LEGS, 3)
    feet.update(like + torch.tensor([0.0, 0.0, force]), like + torch.tensor([3.0, 0.0, -descent]))


def test_the_touchdown_speed_is_that_before_the_first_force_and_stays_until_the_next() -> None:
    feet = Feet(1, 0.002, torch.device("cpu"))
    seen = []
    # force in the step, downward speed at its start: a fall, a blow that stops it, a bounce, and a slower landing
    for force, descent in [(0, 0.7), (0, 0.8), (300, 0.9), (80, -0.1), (0, -0.2), (0, 0.1), (50, 0.3), (40, 0.0)]:
        feet.begin_step()
        feed(feet, force, descent)
        seen.append((feet.touchdown_speed[0, 0].item(), feet.peak_force[0, 0].item()))
    speeds, forces = zip(*seen, strict=True)
    assert speeds == pytest.approx([0, 0, 0.9, 0.9, 0.9, 0.9, 0.3, 0.3])
    assert forces == pytest.approx([0, 0, 300, 80, 0, 0, 50, 40])


def test_a_foot_that_moves_up_when_it_touches_has_no_touchdown_speed() -> None:
    feet = Feet(1, 0.002, torch.device("cpu"))
    feed(feet, 0, 0.5)
    feed(feet, 20, -0.5)
    assert feet.touchdown.all()
    assert not feet.touchdown_speed.any()


def test_the_peak_force_covers_the_substeps_of_one_policy_step_and_has_all_three_components() -> None:
    feet = Feet(2, 0.002, torch.device("cpu"))
    force, still = torch.zeros(2, 4, 3), torch.zeros(2, 4, 3)
    feet.begin_step()
    for vector in ([3.0, 0.0, 4.0], [0.0, 12.0, 5.0], [0.0, 0.0, 1.0]):
        force[0, 1] = torch.tensor(vector)
        feet.update(force, still)
    assert feet.peak_force.tolist() == [[0, 13, 0, 0], [0, 0, 0, 0]]
    feet.begin_step()
    feet.update(force, still)
    assert feet.peak_force[0].tolist() == [0, 1, 0, 0]


def test_a_reset_zeroes_its_rows_even_where_they_are_not_finite() -> None:
    feet = Feet(3, 0.002, torch.device("cpu"))
    feed(feet, 0, 0.5)
    feed(feet, 10, 0.5)
    feet.peak_force[1] = torch.nan
    feet.reset(torch.tensor([False, True, False]))
    for values in (feet.peak_force, feet.touchdown_speed):
        assert values.abs().sum(1).gt(0).tolist() == [True, False, True]


def test_impacts_of_the_environment_are_those_of_mujocos_own_step(start_core: Callable[..., Go1Core]) -> None:
    """A robot dropped with bent legs: largest force and speed at first touch from a loop over ``mj_step``."""
    core = start_core(*QUIET, num_envs=2, noise=False)
    core.backend.qpos[:, 2] += 0.05
    model, data = core.backend.model, mujoco.MjData(core.backend.model)
    data.qpos[:], data.qvel[:] = core.backend.qpos[0], core.backend.qvel[0]
    contact = core.backend.sensors.foot_contact
    velocity = core.backend.sensors.foot_vel_w
    speed, touching, landings = np.zeros(4), np.zeros(4, bool), 0
    stance, limit = robot.NOMINAL_STANCE, np.tile([23.7, 23.7, 35.55], 4)
    before = data.qvel[6:].copy()
    for _ in range(15):
        core.step(torch.zeros(2, 12))
        peak = np.zeros(4)
        for _ in range(10):
            now = 1.5 * data.qvel[6:] - 0.5 * before
            before = data.qvel[6:].copy()
            data.ctrl[:] = np.clip(20.0 * (stance - data.qpos[7:]) - 0.5 * now, -limit, limit)
            descent = []
            for leg in robot.LEGS:  # of the state before the step, by MuJoCo's own function and not by our sensor
                jacobian = np.zeros((3, model.nv))
                mujoco.mj_forward(model, data)
                mujoco.mj_jacSite(model, data, jacobian, None, model.site(f"{leg}_foot").id)
                descent.append(-(jacobian @ data.qvel)[2])
            mujoco.mj_step(model, data)
            force = np.linalg.norm(data.sensordata[contact].reshape(4, 4)[:, 1:], axis=1)
            np.testing.assert_allclose(-data.sensordata[velocity].reshape(4, 3)[:, 2], descent, atol=1e-9)
            peak = np.maximum(peak, force)
            landed = (force > 0) & ~touching
            landings += landed.sum()
            speed = np.where(landed, np.maximum(descent, 0.0), speed)
            touching = force > 0
        s = core.snapshot()
        np.testing.assert_allclose(s.foot_peak_force[0], peak, rtol=1e-2, atol=0.1)
        np.testing.assert_allclose(s.foot_touchdown_speed[0], speed, rtol=1e-3, atol=1e-3)
        assert (s.foot_peak_force >= s.foot_force - 1e-3).all()
    assert landings >= 4
    assert speed.max() > 0.5


def test_the_speed_of_a_sole_is_that_of_the_lowest_point_of_its_sphere(make_task: Callable[..., TaskConfig]) -> None:
    task = make_task()
    model = build_model(task.robot, build_terrain(task.terrain), 0.002)[0]
    data, rng = mujoco.MjData(model), np.random.default_rng(3)
    data.qpos[:] = rng.normal(size=19)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    data.qvel[:] = rng.normal(size=18)
    mujoco.mj_forward(model, data)
    centre, sole = np.zeros((4, 3)), np.zeros((4, 3))
    for k, leg in enumerate(robot.LEGS):
        velocity = np.zeros(6)  # angular, linear; of the geom's centre, in the world
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_GEOM, model.geom(f"{leg}_foot").id, velocity, 0)
        centre[k] = velocity[3:]
        sole[k] = velocity[3:] + np.cross(velocity[:3], [0.0, 0.0, -robot.FOOT_RADIUS])
    s = dataclasses.replace(
        random_snapshot(1),
        base_quat_w=torch.tensor(data.qpos[None, 3:7]),
        base_ang_vel_b=torch.tensor(data.qvel[None, 3:6]),
        joint_pos=torch.tensor(data.qpos[None, 7:]),
        joint_vel=torch.tensor(data.qvel[None, 6:]),
        foot_vel_w=torch.tensor(centre[None]),
    )
    np.testing.assert_allclose(slip_speed(s)[0], np.hypot(sole[:, 0], sole[:, 1]), atol=1e-9)


def test_a_force_that_physics_cannot_make_ends_the_episode_without_a_fall(
    start_core: Callable[..., Go1Core], monkeypatch: pytest.MonkeyPatch
) -> None:
    core = start_core(*QUIET, num_envs=3)
    assert not core.terms.distrusts  # a judge believes its engine
    core.terms.distrusts = True
    usual = core.feet.update

    def blow(force: torch.Tensor, velocity: torch.Tensor) -> None:
        """Make the second robot's readings those of a physics step that went wrong, and the third's those of a fall."""
        usual(force + torch.tensor([0.0, 3e5, 2e3]).reshape(3, 1, 1), velocity)

    monkeypatch.setattr(core.feet, "update", blow)
    result = core.step(torch.zeros(3, robot.NUM_JOINTS))
    assert result.truncated.tolist() == [False, True, False]
    assert not result.terminated.any()
    assert core.episode_end(result, 1) == "a force that physics cannot make"
    assert core.drain_metrics(1)["contact/impossible"] == 1.0


@pytest.mark.parametrize(("price", "force"), [(foot_force, "foot_force"), (foot_peak_force, "foot_peak_force")])
def test_a_wrong_step_costs_no_more_than_a_hard_fall(price: Callable[..., torch.Tensor], force: str) -> None:
    s = random_snapshot(2)
    forces = torch.tensor([[0.0, 100.0, 0.0, 2000.0], [0.0, 100.0, 0.0, 3e5]])
    assert price(dataclasses.replace(s, **{force: forces})).tolist() == [100.0**2 + 2000.0**2] * 2


DT = 0.002
SUBSTEPS = 10


def random_contacts(seed: int, steps: int, n: int) -> np.ndarray:
    """Contact flags (steps, n, 4): phases of random length, some of a single step."""
    rng = np.random.default_rng(seed)
    flags = np.zeros((steps, n, 4), dtype=bool)
    for env in range(n):
        for foot in range(4):
            state, k = rng.random() < 0.5, 0
            while k < steps:
                length = int(rng.choice([1, 2, int(rng.integers(1, 15)), int(rng.integers(10, 120))]))
                flags[k : k + length, env, foot] = state
                state, k = not state, k + length
    return flags


def runs(flags: Iterable[bool]) -> list[tuple[bool, int]]:
    """Lengths of the phases so far: (touching, steps)."""
    return [(bool(value), len(list(group))) for value, group in groupby(flags)]


def last_completed(phases: list[tuple[bool, int]], touching: bool) -> float:
    """Duration of the last phase of a kind that has ended; it ends with the first step of the next one."""
    ended = [length for value, length in phases[:-1] if value == touching]
    return (ended[-1] + 1) * DT if ended else 0.0


def expected(flags: np.ndarray, substep: int) -> dict[str, float]:
    """All timers of one foot, from its history up to now; ``substep`` counts those of the running policy step."""
    phases = runs(flags)
    touching, length = phases[-1]
    recent = flags[len(flags) - substep - 1 : len(flags)] if len(flags) > substep else flags
    return {
        "air": 0.0 if touching else length * DT,
        "contact": length * DT if touching else 0.0,
        "last_air": last_completed(phases, touching=False),
        "last_contact": last_completed(phases, touching=True),
        "touchdown": any(not before and after for before, after in pairwise(recent)),
    }


def run_through(timers: Feet, flags: np.ndarray) -> None:
    for k, row in enumerate(flags):
        if k % SUBSTEPS == 0:
            timers.begin_step()
        timers.touch(torch.as_tensor(row))


@pytest.mark.parametrize("seed", range(3))
def test_timers_agree_with_a_count_of_the_whole_history(seed: int) -> None:
    n = 5
    flags = random_contacts(seed, 400, n)
    timers = Feet(n, DT, torch.device("cpu"))
    for k in range(len(flags)):
        if k % SUBSTEPS == 0:
            timers.begin_step()
        timers.touch(torch.as_tensor(flags[k]))
        if k % 7 and k % SUBSTEPS:
            continue  # every seventh step and every policy step will do
        for env in range(n):
            for foot in range(4):
                want = expected(flags[: k + 1, env, foot], k % SUBSTEPS + 1)
                got = {name: getattr(timers, name)[env, foot].item() for name in want}
                assert got == pytest.approx(want, abs=1e-6), (k, env, foot)


def test_a_reset_zeroes_its_rows_and_they_go_on_as_new() -> None:
    flags = random_contacts(9, 200, 4)
    reset, plain, new = (Feet(4, DT, torch.device("cpu")) for _ in range(3))
    run_through(reset, flags[:100])
    run_through(plain, flags[:100])
    mask = torch.tensor([True, False, False, True])
    reset.reset(mask)
    for name in Feet.timers:
        assert not getattr(reset, name)[mask].any()
    for timers in (reset, plain, new):
        run_through(timers, flags[100:])
    for name in Feet.timers:
        after = getattr(reset, name)
        assert torch.equal(after[mask], getattr(new, name)[mask]), name
        assert torch.equal(after[~mask], getattr(plain, name)[~mask]), name


def test_the_closed_form_of_the_feet_is_the_models() -> None:
    model = load_robot("merged").compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = rng.uniform(*robot.JOINT_POS_LIMITS.T)
        data.qpos[:3], data.qpos[3:7], data.qpos[7:] = 0.0, (1.0, 0.0, 0.0, 0.0), q
        mujoco.mj_kinematics(model, data)
        feet = [data.site(f"{leg}_foot").xpos for leg in robot.LEGS]
        np.testing.assert_allclose(foot_positions(torch.as_tensor(q)[None])[0], feet, atol=1e-12)


@pytest.mark.parametrize("terrain", ["flat", "rough"])
def test_no_foot_starts_below_the_ground(terrain: str) -> None:
    core = Go1Core(parse_task(compose("train", [f"terrain={terrain}", "rand=table1"])), 256, seed=3)
    core.reset()
    height = core.snapshot().foot_height
    assert height is not None
    clear = height - robot.FOOT_RADIUS
    assert float(clear.min()) > -1e-4
    lowest = clear.amin(-1)
    assert (lowest < 1e-4).float().mean() > 0.2, "many are lifted just so far that they touch"
    assert (lowest > 1e-3).float().mean() > 0.1, "those that are clear stay where they are"
