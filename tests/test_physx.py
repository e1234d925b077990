"""PhysX as an engine: its contacts and sensors against laws and against MuJoCo's, and what it refuses.

What every engine owes is in tests/contracts/test_backends.py.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from go1exp import robot
from go1exp.cli import subjects
from go1exp.cli.places import shipped_policies
from go1exp.config.compose import compose
from go1exp.config.schema.physics import CpuBackend
from go1exp.config.schema.registry import ConfigError, Expected
from go1exp.evaluate import rollout
from go1exp.evaluate.rollout import EvalConfig, evaluate
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.engine import make_backend
from go1exp.sim.physics import agreement
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import TaskConfig, parse_parts
from go1exp.sim.terrain import Terrain, build_terrain
from go1exp.train import preflight
from go1exp.train.policy import load_run

INSTALLED = importlib.util.find_spec("sapien") is not None
needs_physx = pytest.mark.skipif(not INSTALLED, reason="sapien is not installed: pip install 'go1exp[physx]'")

PHYSX: Any = parse_parts(compose("eval", ["engine=physx", "engine.threads=1"]), ("engine",))[0]["engine"]
CPU = CpuBackend("cpu", threads=1)
ROUGH = ("terrain=rough", "terrain.rows=3", "terrain.cols=3")
DT = 0.002

Build = Callable[..., Any]


@pytest.fixture
def build(make_task: Callable[..., TaskConfig]) -> Build:
    """Make n robots on an engine, elliptic cones and IMU included."""

    def make(n: int, engine: Any = PHYSX, *overrides: str, held: Any = None) -> Any:
        task = make_task("contact=elliptic", *overrides)
        ground, contact = build_terrain(task.terrain), task.contact
        model, sensors = build_model(task.robot, ground, DT, contact=contact, imu=True, held=held)
        return make_backend(engine, model, sensors, n)

    return make


def put(backend: Any, qpos: np.ndarray, qvel: np.ndarray) -> None:
    mask = torch.ones(backend.num_envs, dtype=torch.bool)
    backend.reset(mask, torch.as_tensor(qpos), torch.as_tensor(qvel))


def standing(n: int, height: float = 0.31) -> tuple[np.ndarray, np.ndarray]:
    qpos = np.zeros((n, 19))
    qpos[:, 2], qpos[:, 3], qpos[:, 7:] = height, 1.0, robot.NOMINAL_STANCE
    return qpos, np.zeros((n, 18))


def hold(backend: Any, steps: int, each: Callable[[int], None] = lambda k: None) -> None:
    """Step with drives that hold the stance."""
    stance = torch.as_tensor(robot.NOMINAL_STANCE)
    for k in range(steps):
        backend.step(60.0 * (stance - backend.qpos[:, -12:]) - 1.5 * backend.qvel[:, -12:])
        each(k)


def feet(backend: Any) -> np.ndarray:
    """(N, 4, 4) contact points and force of each foot."""
    return backend.sensordata[:, backend.sensors.foot_contact].reshape(-1, 4, 4).numpy().copy()


def momentum(backend: Any, env: int = 0) -> np.ndarray:
    """(3,) of the whole robot, kg m/s."""
    data = mujoco.MjData(backend.model)
    data.qpos[:], data.qvel[:] = backend.qpos[env], backend.qvel[env]
    mujoco.mj_forward(backend.model, data)
    mujoco.mj_subtreeVel(backend.model, data)
    return backend.model.body_subtreemass[1] * data.subtree_linvel[1]


# ---------------------------------------------------------------------- the contract finds what is wrong


def _wrong(name: str, backend: Any) -> None:
    for one in backend._robots:
        link, hinge = one.links[3], one.links[3].joint
        {
            "a heavier calf": lambda link=link: setattr(link, "mass", 1.05 * link.mass),
            "no rotor inertia": lambda hinge=hinge: hinge.set_armature([0.0]),
            "sapien's own joint friction": lambda one=one: [j.set_friction(0.05) for j in one.joints],
            "a damped trunk": lambda one=one: setattr(one.links[0], "linear_damping", 0.5),
            "a moved centre of mass": lambda one=one: one._set_centres(backend.model.body_ipos + 0.005),
            "a wider stop": lambda hinge=hinge: hinge.set_limits([[-3.0, -0.8]]),
            "legs swapped": lambda one=one: setattr(one, "order", one.order[[3, 4, 5, 0, 1, 2, 6, 7, 8, 9, 10, 11]]),
            "another step": lambda one=one: setattr(one.system, "timestep", 0.001),
        }[name]()
    backend._order = backend._robots[0].order


@needs_physx
@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("a heavier calf", "link masses"),
        ("no rotor inertia", "mass matrix"),
        ("sapien's own joint friction", "fall: joints"),
        ("a damped trunk", "fall: trunk"),
        ("a moved centre of mass", "gravity torque"),
        ("a wider stop", "joint limits"),
        ("legs swapped", "names and order"),
        ("another step", "physics step"),
    ],
)
def test_the_contract_finds_an_engine_that_is_not_the_robot(build: Build, name: str, complaint: str) -> None:
    reference, judged = (build(agreement.robots_needed(), each) for each in (CPU, PHYSX))
    _wrong(name, judged)
    with pytest.raises(Expected, match=complaint) as caught:
        agreement.require(reference, judged, "physx")
    assert "\n" not in str(caught.value)


@needs_physx
def test_nothing_is_judged_on_an_engine_that_is_not_the_robot(
    make_task: Callable[..., TaskConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = rollout.make_backend

    def light(config: Any, *given: Any) -> Any:
        backend = made(config, *given)
        if config is PHYSX:
            _wrong("a heavier calf", backend)
        return backend

    monkeypatch.setattr(rollout, "make_backend", light)
    config = EvalConfig(((0.0, 0.0, 0.0),), 1, 1.0, 0.0, False, False, False, False, None, 1, engine=PHYSX)
    with pytest.raises(Expected, match="nothing is evaluated on it: link masses"):
        evaluate(make_task(), lambda observation: torch.zeros(1, 12), config)


# ---------------------------------------------------------------------- ground and contacts


@needs_physx
@pytest.mark.parametrize("ground", [(), ROUGH], ids=["flat", "rough"])
def test_what_touches_in_any_posture_is_what_touches_in_mujoco(
    build: Build, make_task: Callable[..., TaskConfig], ground: tuple[str, ...]
) -> None:
    """A field of triangles has no inside: what lies below it altogether does not count."""
    n = 100
    judged, reference = (build(n, each, *ground) for each in (PHYSX, CPU))
    rng, (low, high) = np.random.default_rng(0), robot.JOINT_POS_LIMITS.T
    qpos = np.zeros((n, 19))
    qpos[:, 2] = rng.uniform(0.05, 0.35, n)
    qpos[:, 3:7] = Rotation.random(n, random_state=0).as_quat(scalar_first=True)
    qpos[:, 7:] = rng.uniform(low, high, (n, 12))
    for backend in (judged, reference):
        put(backend, qpos, np.zeros((n, 18)))
    links = [b.sensordata[:, b.sensors.link_contacts].numpy() > 0 for b in (judged, reference)]
    touching = [feet(b)[..., 0] > 0 for b in (judged, reference)]
    if not ground:
        np.testing.assert_array_equal(links[0], links[1])
    places = reference.sensordata[:, reference.sensors.foot_pos_w].reshape(n, 4, 3).numpy()
    terrain: Terrain = build_terrain(make_task(*ground).terrain)
    above = places[..., 2] > terrain.height_at(places[..., :2])
    assert np.mean(touching[0][above] != touching[1][above]) <= (0.01 if ground else 0.0)
    assert touching[1][above].sum() > 8


@needs_physx
def test_triangles_lie_where_the_ground_is(build: Build, make_task: Callable[..., TaskConfig]) -> None:
    backend = build(1, PHYSX, *ROUGH)
    system = backend._robots[0].system
    terrain = build_terrain(make_task(*ROUGH).terrain)
    low, high, right, left = terrain.extent
    xy = np.random.default_rng(0).uniform([low + 0.1, right + 0.1], [high - 0.1, left - 0.1], (300, 2))
    xy = xy[np.linalg.norm(xy, axis=1) > 1.0]  # the robot stands in the middle
    hit = [system.raycast([*place, 5.0], [0.0, 0.0, -1.0], 10.0).position[2] for place in xy]
    heights = terrain.height_at(xy)
    np.testing.assert_allclose(hit, heights, atol=1e-5)
    assert np.ptp(heights) > 0.1


@needs_physx
@pytest.mark.parametrize("ground", [(), ROUGH], ids=["flat", "rough"])
def test_feet_bear_the_weight_and_do_not_sink(build: Build, ground: tuple[str, ...]) -> None:
    backend = build(2, PHYSX, *ground)
    put(backend, *standing(2))
    loads: list[float] = []
    hold(backend, 500, lambda k: loads.append(feet(backend)[0, :, 3].sum()) if k >= 400 else None)
    assert np.mean(loads) == pytest.approx(backend.model.body_subtreemass[1] * 9.81, rel=5e-3)  # it sways a little
    heights = backend.sensordata[:, backend.sensors.foot_pos_w].reshape(2, 4, 3)[..., 2]
    np.testing.assert_allclose(heights, robot.FOOT_RADIUS, atol=2e-4)


@needs_physx
def test_forces_on_the_feet_are_what_changes_the_momentum(build: Build) -> None:
    """A robot that slides on its feet, then stands: PhysX does not give friction, so Newton's law must."""
    backend = build(1)
    qpos, qvel = standing(1, height=0.328)  # PhysX says nothing of how it puts feet out of the ground
    qvel[:, 0], qvel[:, 1] = 1.2, 0.4
    put(backend, qpos, qvel)
    weight = backend.model.body_subtreemass[1] * 9.81
    before = momentum(backend)
    forces, changes = [], []
    for _ in range(60):
        hold(backend, 1)
        after = momentum(backend)
        forces.append(feet(backend)[0, :, 1:].sum(0))
        changes.append((after - before) / DT + [0.0, 0.0, weight])
        before = after
    force, change = np.array(forces), np.array(changes)
    assert np.abs(change[:, :2]).max() > 0.5 * weight
    assert np.abs(force - change).max() < 0.01 * weight


@needs_physx
@pytest.mark.parametrize("coefficient", [0.2, 0.5])
def test_a_sliding_robot_is_slowed_by_the_friction_of_its_feet(build: Build, coefficient: float) -> None:
    """The feet's coefficient is the contact's, whatever the ground's 1.0 says."""
    backend = build(1)
    backend.field("geom_friction")[:, backend.ids("geom", tuple(f"{leg}_foot" for leg in robot.LEGS)), 0] = coefficient
    qpos, qvel = standing(1)
    put(backend, qpos, qvel)
    hold(backend, 300)
    backend.qvel[:, 0] = 2.5
    start = momentum(backend)
    loads: list[float] = []
    hold(backend, 20, lambda k: loads.append(feet(backend)[0, :, 3].sum()))
    slowed = (start - momentum(backend))[0]
    assert slowed == pytest.approx(coefficient * np.sum(loads) * DT, rel=0.05)


@needs_physx
def test_a_sliding_foot_stays_on_the_ground_in_physx_and_hops_in_mujoco(build: Build) -> None:
    """Why feet slip longer in PhysX at the end of a stance (docs/engines.md)."""
    shares = []
    for engine in (PHYSX, CPU):
        backend, share = build(1, engine), 0.0
        put(backend, *standing(1, height=0.328))
        hold(backend, 250)
        backend.qvel[:, 0] = 1.0
        for _ in range(15):
            hold(backend, 1)
            share += (feet(backend)[0, :, 0] > 0).mean() / 15
        shares.append(share)
    assert shares[0] > 0.95
    assert shares[1] < 0.8


# ---------------------------------------------------------------------- sensors and state


@needs_physx
def test_the_imu_reads_as_in_mujoco_in_the_air(build: Build) -> None:
    backends = [build(5, each) for each in (PHYSX, CPU)]
    rng = np.random.default_rng(3)
    qpos, qvel = standing(5, height=2.0)
    qpos[:, 3:7] = Rotation.random(5, random_state=1).as_quat(scalar_first=True)
    qvel += rng.normal(0.0, 1.0, qvel.shape)
    for backend in backends:
        put(backend, qpos, qvel)
        backend.applied()[:, :6] = torch.tensor([60.0, -30.0, 40.0, 1.0, -2.0, 3.0])
        hold(backend, 2)
    s, (judged, reference) = backends[0].sensors, (b.sensordata.numpy() for b in backends)
    for block, bound in ((s.imu_gyro, 2e-3), (s.imu_acc, 0.1), (s.imu_quat, 1e-5)):
        np.testing.assert_allclose(judged[:, block], reference[:, block], atol=bound)
    assert np.abs(reference[:, s.imu_acc]).max() > 3.0


@needs_physx
def test_what_is_written_into_the_state_is_where_the_robot_goes_on(build: Build) -> None:
    backend = build(2)
    put(backend, *standing(2, height=1.0))
    hold(backend, 3)
    backend.qvel[1, :3] += torch.tensor([0.5, 0.0, 0.0])
    backend.qpos[1, 2] += 0.3
    hold(backend, 1)
    assert float(backend.qvel[1, 0] - backend.qvel[0, 0]) == pytest.approx(0.5, abs=1e-3)
    assert float(backend.qpos[1, 2] - backend.qpos[0, 2]) == pytest.approx(0.3, abs=1e-4)


@needs_physx
def test_a_robot_that_gets_another_centre_of_mass_leaves_the_others_alone(build: Build) -> None:
    ends = []
    for changed in (False, True):
        backend = build(3)
        backend.field("body_ipos")
        put(backend, *standing(3, height=0.328))
        hold(backend, 50)
        if changed:
            backend.field("body_ipos")[1, 1] += 0.02
            qpos, qvel = (torch.as_tensor(a) for a in standing(3, height=0.328))
            backend.reset(torch.tensor([False, True, False]), qpos, qvel)
        hold(backend, 50)
        ends.append(backend.qpos.clone())
    assert torch.equal(ends[0][[0, 2]], ends[1][[0, 2]])
    assert not torch.equal(ends[0][1], ends[1][1])


@needs_physx
def test_a_robot_starts_where_it_is_said_to_be_without_a_reset(build: Build) -> None:
    backends = [build(1, each) for each in (PHYSX, CPU)]
    for backend in backends:
        backend.qpos[:] = torch.as_tensor(standing(1, height=1.0)[0])
        backend.step(torch.zeros(1, 12, dtype=torch.float64))
    np.testing.assert_allclose(backends[0].qpos, backends[1].qpos, atol=1e-5)


@needs_physx
def test_a_robot_whose_state_is_no_number_is_seen_and_can_be_reset(build: Build) -> None:
    backend = build(2)
    put(backend, *standing(2, height=0.328))
    backend.qvel[1, 8] = torch.nan
    hold(backend, 2)
    assert torch.isfinite(backend.qpos).all(1).tolist() == [True, False]
    put(backend, *standing(2, height=0.328))
    hold(backend, 5)
    assert torch.isfinite(backend.qpos).all()
    assert torch.isfinite(backend.sensordata).all()


@needs_physx
def test_a_held_robot_swings_as_in_mujoco(build: Build) -> None:
    quat = (0.9689124217106447, 0.0, 0.24740395925452294, 0.0)
    held = [build(2, each, held=quat) for each in (PHYSX, CPU)]
    for backend in held:
        put(backend, np.tile(robot.NOMINAL_STANCE, (2, 1)), np.zeros((2, 12)))
        for _ in range(50):
            backend.step(torch.zeros(2, 12, dtype=torch.float64))
    np.testing.assert_allclose(held[0].qpos, held[1].qpos, atol=3e-3)
    assert float((held[1].qpos - torch.as_tensor(robot.NOMINAL_STANCE)).abs().max()) > 0.1
    s = held[0].sensors
    np.testing.assert_allclose(held[0].sensordata[:, s.imu_acc], held[1].sensordata[:, s.imu_acc], atol=1e-6)


@needs_physx
def test_a_robot_with_a_model_of_its_own_falls_as_in_mujoco(build: Build) -> None:
    """Masses, centres of mass, rotors, gravity and viscous friction; each makes a difference."""
    ends, plain = [], None
    for engine in (PHYSX, CPU):
        backend, rng = build(4, engine), np.random.default_rng(0)
        if engine is CPU:
            plain = build(4, engine)
        for name in ("body_mass", "body_inertia", "dof_armature"):
            live = backend.field(name)
            factor = torch.as_tensor(rng.uniform(0.7, 1.4, live.shape[:2])).reshape(
                *live.shape[:2], *[1] * (live.dim() - 2)
            )
            live.mul_(factor)
        backend.field("body_ipos")[:, 1] += torch.as_tensor(rng.uniform(-0.03, 0.03, (4, 3)))
        backend.field("opt.gravity")[:] += torch.as_tensor(rng.uniform(-1.0, 1.0, (4, 3)))
        backend.field("dof_damping")[:, 6:] = 0.3
        backend.derive_constants(torch.ones(4, dtype=torch.bool))
        for each in (backend, plain) if plain is not None else (backend,):
            qpos, qvel = standing(4, height=1.0)
            put(each, qpos, qvel + np.random.default_rng(5).normal(0.0, 1.0, qvel.shape))
            hold(each, 50)
        ends.append(backend.qpos.numpy().copy())
    assert plain is not None
    np.testing.assert_allclose(ends[0], ends[1], atol=5e-4)
    assert np.abs(ends[1] - plain.qpos.numpy()).max() > 5e-3


@needs_physx
def test_the_number_of_threads_changes_no_bit(build: Build) -> None:
    runs = []
    for threads in (1, 3):
        backend = build(5, dataclasses.replace(PHYSX, threads=threads))
        qpos, qvel = standing(5)
        put(backend, qpos, qvel + np.random.default_rng(0).normal(0.0, 0.5, qvel.shape))
        hold(backend, 60)
        runs.append(torch.cat([backend.qpos, backend.qvel, backend.sensordata], 1))
    assert torch.equal(*runs)


@needs_physx
@pytest.mark.parametrize(
    "changed",
    [{"solver": "pgs"}, {"position_iterations": 2}, {"velocity_iterations": 2}, {"contact_offset": 0.0005}],
    ids=str,
)
def test_each_setting_acts(build: Build, changed: dict[str, Any]) -> None:
    ends = []
    for settings in (PHYSX, dataclasses.replace(PHYSX, **changed)):
        backend = build(1, settings)
        qpos, qvel = standing(1, height=0.36)
        qvel[:, 0] = 1.0
        put(backend, qpos, qvel)
        hold(backend, 80)
        ends.append(backend.qpos.clone())
    assert not torch.equal(*ends)


# ---------------------------------------------------------------------- what is refused


@needs_physx
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("+rand.foot_restitution={when: reset}",), r"differ in geom_solref.*leave out rand\.foot_restitution"),
        (("+effect.joint_stop={}",), r"differ in jnt_solref.*leave out effect\.joint_stop"),
    ],
)
def test_what_physx_has_no_place_for_is_refused_before_anything_moves(
    make_task: Callable[..., TaskConfig], overrides: tuple[str, ...], message: str
) -> None:
    task = dataclasses.replace(make_task("rand=none", *overrides), backend=PHYSX)
    with pytest.raises(ConfigError, match=message) as caught:
        Go1Core(task, 1)
    assert len(caught.value.problems) == 1


def test_without_its_package_the_choice_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError) as caught:
        subjects.split_engine(compose("eval", ["engine=physx"]))
    (problem,) = caught.value.problems
    assert "pip install 'go1exp[physx]'" in problem


def test_without_its_package_the_engine_says_what_to_install(build: Build, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("sapien", "sapien.physx"):
        monkeypatch.setitem(sys.modules, name, None)
    for name in ("physx", "physx_robot", "physx_contacts"):
        monkeypatch.delitem(sys.modules, f"go1exp.sim.physics.{name}", raising=False)
    with pytest.raises(Expected, match=r"pip install 'go1exp\[physx\]'"):
        build(1)


def test_it_trains_nothing(make_task: Callable[..., TaskConfig]) -> None:
    from go1exp.sim.task import parse_train

    config = parse_train(compose("train"))
    config = dataclasses.replace(config, task=dataclasses.replace(config.task, backend=PHYSX))
    with pytest.raises(ConfigError, match="evaluates policies and trains none"):
        preflight.check_devices(config)


# ---------------------------------------------------------------------- a policy


@needs_physx
def test_a_shipped_policy_walks_in_physx_as_in_mujoco() -> None:
    config, policy, _ = load_run(shipped_policies()["clock"])
    task = subjects.with_robot(config.task, subjects.split_robot(compose("eval", ["contact=elliptic"]))[0])
    reports = []
    for engine in (PHYSX, CPU):
        brief = EvalConfig(((1.0, 0.0, 0.0),), 3, 2.0, 1.0, True, True, False, False, None, 5, engine=engine)
        reports.append(evaluate(task, policy, brief))
    judged, reference = reports
    assert judged["falls"] == reference["falls"] == 0
    for axis in ("x", "y", "yaw"):
        assert judged["rmse"][axis] == pytest.approx(reference["rmse"][axis], rel=0.3), axis
    assert judged["rmse"] != reference["rmse"]
    assert "agreement" in judged
    assert "agreement" not in reference
