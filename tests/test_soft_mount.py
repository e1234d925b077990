"""``effect=soft_mount`` against closed forms, and against MuJoCo's own springs and drives at a small step."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.compose import compose
from go1exp.config.schema.registry import Term, bind_list
from go1exp.gap.data.prepare import Ready
from go1exp.gap.replay.replayer import LEVEL, Replayer
from go1exp.gap.replay.rows import Rows, Theta, mounted, on_fixed_base, variants
from go1exp.gap.result import GapSettings
from go1exp.gap.robots.description import ModelConfig, parse_model
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.go1 import suspended
from go1exp.gap.score.angle_errors import unexplained
from go1exp.gap.score.likelihood import state_probes
from go1exp.gap.search.fit import stacked
from go1exp.gap.stages.explain import explain
from go1exp.logs.recording import read_folder
from go1exp.sim.effects.rules import on_mount
from go1exp.sim.effects.tolerances import DECLARED
from go1exp.sim.effects.trunk import SoftMount
from go1exp.sim.env.plant import Plant, actuator_setup
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import TaskConfig, parse_task
from go1exp.sim.terrain import build_terrain
from tests.laboratory import recorded

MASS, INERTIA, G = 12.0, (0.1, 0.2, 0.3), 9.81
BLOCK = f"""<mujoco><worldbody><body name="block" pos="0 0 1">
  <inertial mass="{MASS}" pos="0 0 0" diaginertia="{INERTIA[0]} {INERTIA[1]} {INERTIA[2]}"/>
  <body name="arm"><joint name="arm" axis="0 1 0" armature="0.01"/>
    <inertial mass="1e-9" pos="0 0 0" diaginertia="1e-12 1e-12 1e-12"/></body>
</body></worldbody></mujoco>"""
"""A trunk with hardly anything on it, so that it swings alone."""

TILTED = (math.cos(0.2), math.sin(0.2), 0.0, 0.0)
SOFT = {"sway": 5e-4, "heave": 2e-4, "roll": 0.01, "pitch": 0.02, "damping": 0.1}
COMPLIANCE = [SOFT[name] for name in ("sway", "sway", "heave", "roll", "pitch")]


def soft(values: Mapping[str, Any]) -> list[Term]:
    return bind_list("effect", [{"soft_mount": values}], "effect")


def block(folder: Path, values: Mapping[str, Any], dt: float, quat: tuple[float, ...] = TILTED) -> Plant:
    """A block on a mount, whose one joint has no drive."""
    (folder / "block.xml").write_text(BLOCK)
    words = {"mjcf": str(folder / "block.xml"), "robots": ["block"], "base": "block", "joints": ["arm"]}
    config = parse_model({**words, "torque_limit": 1.0, "speed_limit": 1.0})
    assert isinstance(config, ModelConfig)
    machine = FixedBase.from_config(config)
    backend, setup = machine.build(1, dt, quat, 1, mounted=True)
    plant = Plant(backend, setup, machine.drive(), soft(values))
    plant.set_gains(torch.zeros(1, 1).double(), torch.zeros(1, 1).double())
    plant.startup()
    return plant


def released(plant: Plant, at: np.ndarray, steps: int, load: np.ndarray | None = None) -> np.ndarray:
    """Let the trunk go at coordinates ``at`` (5,) of the mount, loaded; return them at every step (T, 5)."""
    qpos = torch.zeros_like(plant.backend.qpos)
    qpos[0, :5] = torch.as_tensor(at)
    everyone, target = torch.ones(1, dtype=torch.bool), torch.zeros_like(plant.q)
    plant.backend.reset(everyone, qpos, torch.zeros_like(plant.backend.qvel))
    plant.reset(everyone, target)
    if load is not None:
        plant.backend.applied()[0, :5] = torch.as_tensor(load)
    found = []
    for _ in range(steps):
        found.append(plant.backend.qpos[0, :5].numpy().copy())
        plant.step(target)
    return np.array(found)


# ---------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("direction", range(5), ids=robot.MOUNT)
def test_a_block_swings_in_each_direction_as_a_mass_on_a_spring(tmp_path: Path, direction: int) -> None:
    """x = x0 exp(-z w t) (cos(v t) + z w / v sin(v t)), w = 1 / sqrt(compliance inertia), v = w sqrt(1 - z^2)."""
    dt, first = 0.0002, np.zeros(5)
    first[direction] = 0.01
    found = released(block(tmp_path, SOFT, dt), first, 2000)
    t, z = dt * np.arange(2000), SOFT["damping"]
    w = 1.0 / math.sqrt(COMPLIANCE[direction] * (MASS, MASS, MASS, *INERTIA[:2])[direction])
    v = w * math.sqrt(1.0 - z**2)
    expected = 0.01 * np.exp(-z * w * t) * (np.cos(v * t) + z * w / v * np.sin(v * t))
    assert np.abs(found[:, direction] - expected).max() < 1e-4  # of 0.01; of first order in the step
    assert np.abs(np.delete(found, direction, axis=1)).max() < 2e-4  # products of small angles


def test_the_weight_is_borne_without_deflection_and_a_load_deflects_by_the_compliance(tmp_path: Path) -> None:
    plant = block(tmp_path, {**SOFT, "damping": 1.0}, 0.001)
    assert np.abs(released(plant, np.zeros(5), 500)).max() < 1e-9
    load = np.array([3.0, -2.0, 5.0, 0.2, 0.1])
    found = released(plant, np.zeros(5), 4000, load)[-1]
    np.testing.assert_allclose(found, load * COMPLIANCE, rtol=5e-3)  # angles of 2 mrad mix axes by as much


@pytest.mark.parametrize("compliance", [1e-12, 1e-8, 1e-6, 1e-5])
def test_a_spring_that_the_step_cannot_resolve_stays_stable_and_deflects_as_much_at_rest(
    tmp_path: Path, compliance: float
) -> None:
    plant = block(tmp_path, {"heave": compliance, "damping": 0.01}, 0.002)
    found = released(plant, np.array([0, 0, 1e-3, 0, 0.0]), 3000)
    assert np.abs(found[:, 2]).max() <= 1e-3 * 1.001
    assert np.abs(found[-200:, 2]).max() < 1e-3
    critical = block(tmp_path, {"heave": compliance, "damping": 1.0}, 0.002)
    load = np.array([0.0, 0.0, 100.0, 0.0, 0.0])
    assert released(critical, np.zeros(5), 3000, load)[-1, 2] == pytest.approx(100.0 * compliance, rel=1e-3)


# ---------------------------------------------------------------------- a hung Go1


@cache
def task() -> TaskConfig:
    return parse_task(compose("train", ["rand=none", "actuator=pd", "contact=soft", "backend.threads=1"]))


def hanging(dt: float, rows: list[Mapping[str, float]], mount: bool = True) -> Plant:
    """Hang up Go1s, each on a mount of its own."""
    ground = build_terrain(task().terrain)
    backend = MujocoCpu(*build_model(task().robot, ground, dt, held=(1.0, 0.0, 0.0, 0.0), mounted=mount), len(rows), 1)
    terms = soft({}) if mount else []
    plant = Plant(backend, actuator_setup(task().robot, dt, backend, EnvRandom(0, len(rows))), task().actuator, terms)
    for k, values in enumerate(rows):
        for name, value in values.items():
            getattr(plant.effects.effects["soft_mount"], name)[k] = value
    plant.set_gains(*(torch.full_like(plant.q, gain) for gain in (KP, KD)))
    plant.startup()
    qpos = torch.zeros_like(backend.qpos)
    qpos[:, -robot.NUM_JOINTS :] = torch.as_tensor(robot.NOMINAL_STANCE)
    everyone = torch.ones(len(rows), dtype=torch.bool)
    backend.reset(everyone, qpos, torch.zeros_like(backend.qvel))
    plant.reset(everyone, qpos[:, -robot.NUM_JOINTS :].clone())
    return plant


KP, KD, EVERY = 35.0, 1.2, 0.004


def target(t: float) -> np.ndarray:
    """Joints that swing out of step, and all together, commanded every 4 ms."""
    k, t = np.arange(robot.NUM_JOINTS), EVERY * math.floor(t / EVERY + 1e-6)
    return np.asarray(robot.NOMINAL_STANCE) + 0.2 * np.sin(2 * np.pi * (1.5 + 0.1 * k) * t) + 0.1 * np.sin(15.0 * t)


def followed(plant: Plant, dt: float, seconds: float) -> Tensor:
    """Return the coordinates (T, N, nq) every 4 ms."""
    found, n = [], len(plant.q)
    for k in range(round(seconds / dt)):
        if k % round(EVERY / dt) == 0:
            found.append(plant.backend.qpos.clone())
        plant.step(torch.as_tensor(target(k * dt)).repeat(n, 1))
    return torch.stack(found)


def engines_own(dt: float, seconds: float) -> Tensor:
    """The same of MuJoCo alone: springs, dampers and position drives of a model of its own, Runge-Kutta."""
    model = build_model(task().robot, build_terrain(task().terrain), dt, held=(1.0, 0.0, 0.0, 0.0), mounted=True)[0]
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
    model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2] = KP, -KP, -KD
    full = np.zeros((model.nv, model.nv))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)  # at straight legs
    k = 1.0 / np.array(COMPLIANCE)
    model.jnt_stiffness[:5] = k
    model.dof_damping[:5] = 2.0 * SOFT["damping"] * np.sqrt(k * np.diag(full)[:5])
    model.qpos_spring[2] = G * model.body_mass.sum() * SOFT["heave"]
    data.qpos[5:] = robot.NOMINAL_STANCE
    found = []
    for n in range(round(seconds / dt)):
        if n % round(EVERY / dt) == 0:
            found.append(torch.tensor(data.qpos.copy()))
        data.ctrl[:] = target(n * dt)
        mujoco.mj_step(model, data)
    return torch.stack(found).unsqueeze(1)


def test_legs_and_trunk_move_as_those_of_mujocos_own_springs_and_drives() -> None:
    seconds = 0.6
    reference = engines_own(0.0002, seconds)
    moved = float(reference[:, 0, 3:5].abs().max())
    assert moved > 0.02  # the trunk turns by that, rad
    errors = {dt: (followed(hanging(dt, [SOFT]), dt, seconds) - reference).abs() for dt in (0.002, 0.001)}
    assert float(errors[0.002][..., 5:].max()) < 1.0e-3  # rad
    assert float(errors[0.001].max()) < 0.6 * float(errors[0.002].max())  # it is the step's error
    bolt = followed(hanging(0.001, [{}], mount=False), 0.001, seconds)
    assert float((bolt - reference[..., 5:]).abs().max()) > 10 * float(errors[0.001][..., 5:].max())


def test_legs_on_a_mount_without_compliance_move_as_bolted_whatever_the_others_do() -> None:
    plain = followed(hanging(0.002, [{}], mount=False), 0.002, 0.4)
    both = followed(hanging(0.002, [{}, SOFT]), 0.002, 0.4)
    assert float(both[:, 0, :5].abs().max()) < 1e-7
    assert float((both[:, 0, 5:] - plain[:, 0]).abs().max()) < 1e-7
    assert float((both[:, 1, 5:] - plain[:, 0]).abs().max()) > 1e-3


def test_a_mount_takes_energy_from_a_robot_that_nothing_drives() -> None:
    """Weightless, drives off, let go from a deflection: what moves and what the springs hold, together."""
    plant = hanging(0.001, [{**SOFT, "damping": 0.3}])
    plant.set_gains(torch.zeros_like(plant.q), torch.zeros_like(plant.q))
    backend = plant.backend
    assert isinstance(backend, MujocoCpu)
    backend.field("opt.gravity").zero_()
    backend.field("qpos_spring").zero_()
    qpos = backend.qpos.clone()
    qpos[0, :5] = torch.tensor([0.02, -0.02, 0.02, 0.1, -0.1])
    backend.reset(torch.tensor([True]), qpos, torch.zeros_like(backend.qvel))
    plant.reset(torch.tensor([True]), plant.q.clone())
    model, energy = backend.env_model(0), []
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    for k in range(400):
        if k % 10 == 0:
            data = backend.env_data(0)
            mujoco.mj_forward(model, data)
            energy.append(float(data.energy.sum()))
        plant.step(plant.q.clone())
    assert all(after <= before * (1.0 + 2e-3) for before, after in pairwise(energy)), energy
    assert energy[-1] < 0.9 * energy[0]


# ---------------------------------------------------------------------- who has a mount


def test_only_a_mount_that_gives_way_needs_joints_of_the_trunk() -> None:
    assert not on_mount([])
    assert not on_mount(soft({"damping": 0.5}))
    assert on_mount(soft({"roll": 1e-5}))


def test_rows_without_compliance_are_simulated_bolted() -> None:
    roll, other = np.array([[0.0], [0.01], [0.0]]), np.full((3, 12), 0.1)
    shape = np.full((3, 1), 0.4)  # which does nothing by itself
    values = {("soft_mount", "roll"): roll, ("soft_mount", "damping"): shape, ("coulomb", "bound"): other}
    rows = Rows(np.arange(3), values)
    assert mounted(rows).tolist() == [False, True, False]
    assert list(on_fixed_base(rows).values) == [("coulomb", "bound")]


def test_a_free_trunk_has_no_mount() -> None:
    ground = build_terrain(task().terrain)
    backend = MujocoCpu(*build_model(task().robot, ground, 0.002), 1, 1)
    setup = actuator_setup(task().robot, 0.002, backend, EnvRandom(0, 1))
    assert (setup.floating, setup.mounted) == (True, False)
    assert SoftMount(setup, roll=0.01).fields == ()


# ---------------------------------------------------------------------- in a replay of recordings


@cache
def replayer() -> Replayer:
    """Four windows of one recording of a Go1 that hangs."""
    machine, recordings = suspended(task().robot), read_folder(data_root() / "assets/demo/suspended_go1")[:1]
    windows = machine.windows(Ready(tuple(recordings), GapSettings(stride_s=0.4)))
    return machine.replayer(windows, np.tile(LEVEL, (len(windows), 1)), 64, 1)


def replayed(theta: Theta, more: Theta | None = None) -> list[np.ndarray]:
    """Replay four windows with ``theta``, and then also with ``more`` beside it in one call."""
    four, machine = np.arange(4), replayer().machine
    rows = [variants(machine, values, four, []) for values in (theta, *([] if more is None else [more]))]
    return list(replayer().run(stacked(rows, DECLARED), 0.001).reshape(len(rows), 4, *replayer().windows.y.shape[1:]))


def test_null_values_change_no_bit_of_a_replay_whatever_is_replayed_beside_them() -> None:
    null, roll = {("soft_mount", "roll"): np.zeros(1)}, {("soft_mount", "roll"): np.array([0.02])}
    (plain,) = replayed({})
    first, second = replayed(null, roll)
    assert np.array_equal(plain, first)
    assert np.array_equal(plain, replayed({**null, ("soft_mount", "damping"): np.array([0.7])})[0])
    assert np.array_equal(second, replayed(roll)[0])
    assert np.abs(second - plain)[:, :, 0].max() > 1e-3


def test_a_replay_begins_where_the_mount_bears_the_legs_or_so_far_from_it_as_is_asked() -> None:
    values = {("soft_mount", name): np.array([value]) for name, value in SOFT.items()}
    soft_rows = variants(replayer().machine, values, np.arange(4), [])
    load = np.tile([1.0, 2.0, 3.0, 0.1, 0.2, 5.0, 0.0, 0.0, 0.0, 0.5], (4, 1))
    plant = replayer()._plant(soft_rows, 0.001, True)
    w, backend = replayer().windows, plant.backend
    assert isinstance(backend, MujocoCpu)
    q, qd = torch.as_tensor(w.q[:4]), torch.as_tensor(w.qd[:4])
    rest, still = replayer()._state(plant, soft_rows, q, qd)
    moved, speed = replayer()._state(plant, dataclasses.replace(soft_rows, mount=load), q, qd)
    model = backend.env_model(0)
    data = mujoco.MjData(model)
    for k in range(4):
        data.qpos[5:] = w.q[k]
        mujoco.mj_forward(model, data)
        lever = data.subtree_com[1] - data.xpos[1]  # from the trunk's origin to the centre of mass
        x, y = G * model.body_mass.sum() * lever[:2]
        expected = [0.0, 0.0, 0.0, -SOFT["roll"] * y, SOFT["pitch"] * x]
        np.testing.assert_allclose(rest[k, :5], expected, atol=1e-9)
    assert torch.equal(rest[:, 5:], q)
    assert torch.equal(still[:, :5], torch.zeros(4, 5).double())
    np.testing.assert_allclose((moved - rest)[:, :5], load[:, :5] * COMPLIANCE, atol=1e-12)
    swing = np.sqrt(np.array(COMPLIANCE) / model.dof_M0[:5])  # 1 / sqrt(stiffness inertia)
    np.testing.assert_allclose(speed[:, :5], load[:, 5:] * swing, atol=1e-9)


def test_what_the_trunk_does_at_first_is_unknown_only_on_a_mount() -> None:
    machine = replayer().machine
    plain, soft_ones = state_probes(machine), state_probes(machine, {("soft_mount", "roll"): np.array([0.01])})
    assert [p.key for p in plain] == ["q"] * 3 + ["qd"] * 3
    assert [p.key for p in soft_ones] == ["q"] * 3 + ["qd"] * 3 + ["mount"] * 10


def test_what_all_legs_feel_explains_their_errors_by_one_number() -> None:
    """Two legs, three samples of one joint each; the trunk would move the first sample of both the same way."""
    state = np.zeros((1, 2, 3, 2))
    state[..., 0, 0] = 100.0  # the trunk's, as good as unknown
    state[..., 1, 1] = 100.0  # each leg's own
    windows = SimpleNamespace(t=np.zeros((1, 3)), quantities=("q",))
    score: Any = SimpleNamespace(state=state, common=np.array([True, False]), windows=windows)
    residual = np.array([[[1.0, 4.0, 7.0], [-1.0, -5.0, 8.0]]])
    left = unexplained(score, residual, np.arange(1))[0, :, :, 0, 0]
    np.testing.assert_allclose(left, [[1.0, 0.0, 7.0], [-1.0, 0.0, 8.0]], atol=1e-3)
    same = unexplained(score, np.abs(residual), np.arange(1))[0, :, :, 0, 0]
    np.testing.assert_allclose(same, [[0.0, 0.0, 7.0], [0.0, 0.0, 8.0]], atol=1e-3)
    score.common = np.zeros(2, dtype=bool)
    np.testing.assert_allclose(unexplained(score, residual, np.arange(1))[0, :, 0, 0, 0], 0.0, atol=1e-3)


# ---------------------------------------------------------------------- found in recordings


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_hidden_mount_is_named_with_its_values_and_not_taken_for_a_tilt_or_inertia() -> None:
    hidden = {"roll": 0.012, "pitch": 0.008, "damping": 0.15}
    made = ["physics_dt=0.0005", "seconds=3", "excitation=[chirp,steps]", "gains=[[20,0.5],[35,1.2]]"]
    rig, recordings = recorded(made, {"soft_mount": hidden})
    settings = GapSettings(
        stride_s=0.6,
        effects=("soft_mount", "base_tilt", "link_com", "armature", "coulomb", "flexibility"),
        shortlist=4,
        max_terms=1,
        bootstraps=20,
        overlays=1,
    )
    result = explain(recordings, suspended(rig.robot), settings)
    assert [n.effect for n in result.named] == ["soft_mount"]
    values = result.named[0].params
    assert values["roll"]["robot"] == pytest.approx(0.012, rel=0.15)
    assert values["pitch"]["robot"] == pytest.approx(0.008, rel=0.15)
    assert values["damping"]["robot"] == pytest.approx(0.15, rel=0.15)
    assert result.closed > 0.75
