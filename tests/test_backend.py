"""The batch of simulations against serial ``mj_step`` loops, bit for bit, and against the rule of ``backend.py``."""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from go1exp import robot
from go1exp.config.schema.registry import members
from go1exp.sim.env.core import Go1Core
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import Sensors, build_model
from go1exp.sim.task import TaskConfig
from go1exp.sim.terrain import build_terrain
from tests.contracts.test_backends import GROUNDS, randomize
from tests.contracts.test_backends import initial as states

Build = Callable[..., MujocoCpu]


@pytest.fixture
def scene(make_task: Callable[..., TaskConfig]) -> Callable[..., tuple[mujoco.MjModel, Sensors]]:
    def build(*overrides: str) -> tuple[mujoco.MjModel, Sensors]:
        task = make_task(*overrides)
        return build_model(task.robot, build_terrain(task.terrain), task.sim.physics_dt)

    return build


@pytest.fixture
def make_backend(scene: Callable[..., tuple[mujoco.MjModel, Sensors]]) -> Build:
    return lambda n, *overrides, threads=1: MujocoCpu(*scene(*overrides), n, threads)


def initial(n: int, height: float = robot.NOMINAL_HEIGHT) -> tuple[torch.Tensor, torch.Tensor]:
    """Robots near the nominal stance, each a little different: qpos (n, 19), qvel (n, 18)."""
    qpos, qvel = states(n, height)
    return torch.as_tensor(qpos), torch.as_tensor(qvel)


def torques(n: int, steps: int, seed: int = 0) -> torch.Tensor:
    """Torques (steps, n, 12) that change every step and sometimes exceed the limit."""
    return torch.as_tensor(np.random.default_rng(seed).normal(0.0, 10.0, (steps, n, 12)))


def everyone(n: int) -> torch.Tensor:
    return torch.ones(n, dtype=torch.bool)


def own_model(nominal: mujoco.MjModel, own: dict[str, np.ndarray], env: int) -> mujoco.MjModel:
    """One simulation's model, made without the batch."""
    model = copy.copy(nominal)
    for name, values in own.items():
        getattr(model, name)[:] = values[env]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def start(model: mujoco.MjModel, qpos: torch.Tensor, qvel: torch.Tensor) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos.numpy(), qvel.numpy()
    mujoco.mj_forward(model, data)
    return data


def test_steps_read_no_clock() -> None:
    """MuJoCo's timers cost a tenth of a step. In a process of its own: MuJoCo's viewer gives the timers its clock."""
    code = """
import mujoco
import go1exp.sim.physics.mujoco_cpu
model = mujoco.MjModel.from_xml_string("<mujoco/>")
data = mujoco.MjData(model)
mujoco.mj_step(model, data, 3)
step = data.timer[mujoco.mjtTimer.mjTIMER_STEP]
print(step.number, step.duration)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["3", "0.0"]


@GROUNDS
def test_a_batch_is_a_serial_loop_over_its_own_models_bit_for_bit(make_backend: Build, ground: tuple[str, ...]) -> None:
    n, steps = 3, 250
    backend = make_backend(n, *ground)
    own = randomize(backend)
    qpos, qvel = initial(n)
    backend.reset(everyone(n), qpos, qvel)
    models = [own_model(backend.model, own, i) for i in range(n)]
    serial = [start(models[i], qpos[i], qvel[i]) for i in range(n)]
    touched = False
    for ctrl in torques(n, steps):
        backend.step(ctrl)
        for i, data in enumerate(serial):
            data.ctrl[:] = ctrl[i].numpy()
            mujoco.mj_step(models[i], data)
            touched |= data.ncon > 0
            np.testing.assert_array_equal(backend.qpos[i], data.qpos)
            np.testing.assert_array_equal(backend.qvel[i], data.qvel)
            np.testing.assert_array_equal(backend.sensordata[i], data.sensordata)
    assert touched


def test_the_step_tensors_stay_the_same_objects_in_memory(make_backend: Build) -> None:
    backend = make_backend(2)
    addresses = [x.data_ptr() for x in (backend.qpos, backend.qvel, backend.sensordata, backend.field("body_mass"))]
    backend.reset(everyone(2), *initial(2))
    backend.step(torques(2, 1)[0])
    backend.load_state_dict(backend.state_dict())
    now = [x.data_ptr() for x in (backend.qpos, backend.qvel, backend.sensordata, backend.field("body_mass"))]
    assert now == addresses


# What the contact sensors mean


def stand(backend: MujocoCpu, seconds: float) -> np.ndarray:
    """Hold the nominal stance and return the contact block (N, 4, 4) averaged over the last 0.1 s."""
    n = backend.num_envs
    qpos, qvel = torch.zeros(n, 19, dtype=torch.float64), torch.zeros(n, 18, dtype=torch.float64)
    qpos[:, 2], qpos[:, 3] = 0.32, 1.0
    qpos[:, 7:] = torch.as_tensor(robot.NOMINAL_STANCE)
    backend.reset(everyone(n), qpos, qvel)
    target, readings = torch.as_tensor(robot.NOMINAL_STANCE), []
    for _ in range(round(seconds / 0.002)):
        backend.step(50.0 * (target - backend.qpos[:, 7:]) - 2.0 * backend.qvel[:, 6:])
        readings.append(backend.sensordata[:, backend.sensors.foot_contact].reshape(n, 4, 4).numpy().copy())
    return np.mean(readings[-50:], axis=0)


@pytest.mark.parametrize(
    ("ground", "mass"),
    [
        ((), 12.743),
        (("robot=go1_rotor_complete",), 13.099),
        (("terrain=rough", "terrain.rows=1", "terrain.cols=1"), 12.743),
    ],
    ids=["plane", "with rotors", "height field"],
)
def test_the_forces_on_the_feet_of_a_standing_robot_add_up_to_its_weight(
    make_backend: Build, ground: tuple[str, ...], mass: float
) -> None:
    contact = stand(make_backend(2, *ground), 1.2)
    assert (contact[..., 0] > 0).all()
    force = contact[..., 1:].sum(axis=1)  # over the feet
    np.testing.assert_allclose(force[:, 2], mass * 9.81, rtol=5e-3)
    np.testing.assert_allclose(force[:, :2], 0.0, atol=1.0)
    assert (contact[..., 3] > 15.0).all()  # each of them bears a share; the ground pushes it up


def random_poses(backend: MujocoCpu, n: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Robots in any posture, turned any way up, with their lowest shape 3 to 40 mm in the ground."""
    rng = np.random.default_rng(seed)
    low, high = robot.JOINT_POS_LIMITS.T
    qpos = np.zeros((n, 19))
    qpos[:, 2] = 1.0
    qpos[:, 3:7] = Rotation.random(n, random_state=seed).as_quat(scalar_first=True)
    qpos[:, 7:] = rng.uniform(low, high, (n, 12))
    data, nearest = mujoco.MjData(backend.model), np.zeros(6)
    floor = backend.model.geom("floor").id
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_forward(backend.model, data)
        gaps = [
            mujoco.mj_geomDistance(backend.model, data, floor, g, 3.0, nearest)
            for g in range(backend.model.ngeom)
            if g != floor
        ]
        q[2] -= min(gaps) + rng.uniform(0.003, 0.04)
    return torch.as_tensor(qpos), torch.zeros(n, 18, dtype=torch.float64)


PARTS = ("foot", "thigh", "calf", "trunk")


def counted(model: mujoco.MjModel, qpos: np.ndarray) -> dict[str, Any]:
    """Contacts of one pose by geom, from MuJoCo's own list: per leg for foot, thigh and calf without foot."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    found: dict[str, Any] = {"trunk": 0, **{part: np.zeros(4) for part in ("foot", "thigh", "calf", "hip")}}
    for contact in data.contact:
        assert model.geom("floor").id in contact.geom
        geom = next(int(g) for g in contact.geom if g != model.geom("floor").id)
        name, body = model.geom(geom).name, model.body(model.geom_bodyid[geom]).name
        if body == "trunk":
            found["trunk"] += 1
            continue
        leg, part = body.split("_")
        found["foot" if name.endswith("_foot") else part][robot.LEGS.index(leg)] += 1
    return found


def test_contact_counts_are_those_of_mujocos_contact_list_in_any_posture(make_backend: Build) -> None:
    n = 200
    backend = make_backend(n)
    backend.reset(everyone(n), *random_poses(backend, n))
    feet = backend.sensordata[:, backend.sensors.foot_contact].reshape(n, 4, 4)[..., 0].numpy()
    links = backend.sensordata[:, backend.sensors.link_contacts].numpy()
    seen = dict.fromkeys([*PARTS, "hip"], 0.0)
    for i in range(n):
        want = counted(backend.model, backend.qpos[i].numpy())
        np.testing.assert_array_equal(feet[i], want["foot"])
        np.testing.assert_array_equal(links[i, 0:4], want["thigh"])
        np.testing.assert_array_equal(links[i, 4:8] - feet[i], want["calf"])
        assert links[i, 8] == want["trunk"]
        np.testing.assert_array_equal(links[i, 9:13], want["hip"])
        for part in seen:
            seen[part] += np.sum(want[part])
    assert all(count >= 5 for count in seen.values()), seen


def test_the_snapshot_names_the_parts_that_touch_and_a_foot_is_no_calf(start_core: Callable[..., Go1Core]) -> None:
    """With one physics step per policy step, the flags of the step are those of the pose it began with."""
    n = 150
    core = start_core("sim.policy_dt=0.002", "rand=none", "event=none", "termination=none", num_envs=n, noise=False)
    assert isinstance(core.backend, MujocoCpu)
    qpos, qvel = random_poses(core.backend, n, seed=1)
    core.backend.reset(everyone(n), qpos, qvel)
    core.step(torch.zeros(n, 12))
    s = core.snapshot()
    calf_beside_foot = 0
    for i in range(n):
        want = counted(core.backend.model, qpos[i].numpy())
        bears = core.backend.sensordata[i, core.backend.sensors.foot_contact].reshape(4, 4)[:, 1:].norm(dim=-1) > 0
        np.testing.assert_array_equal(s.foot_contact[i], (want["foot"] > 0) & bears.numpy())
        np.testing.assert_array_equal(s.thigh_contact[i], want["thigh"] > 0)
        np.testing.assert_array_equal(s.calf_contact[i], want["calf"] > 0)
        assert s.trunk_contact[i] == (want["trunk"] > 0 or want["hip"].any())
        calf_beside_foot += bool(((want["foot"] > 0) & (want["calf"] > 0)).any())
    alone = s.foot_contact & ~s.calf_contact
    assert alone.sum() > 5
    assert (s.calf_contact & ~s.foot_contact).sum() > 5
    assert members("termination")["trunk_contact"].target(s).sum() > 5


def test_a_fault_is_seen_and_not_healed(make_backend: Build, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """MuJoCo would by itself put a robot whose state is not finite back to where the model starts."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file
    backend = make_backend(2)
    backend.reset(everyone(2), *initial(2))
    backend.qvel[0, 7] = torch.nan
    backend.step(torques(2, 1)[0])
    assert not torch.isfinite(backend.qvel[0]).all()
    assert torch.isfinite(backend.qpos[1]).all()
    assert torch.isfinite(backend.qvel[1]).all()


@pytest.mark.parametrize("decoration", [False, True])
def test_a_scene_leaves_the_next_one_as_it_was(make_task: Callable[..., TaskConfig], decoration: bool) -> None:
    task = make_task()
    ground = build_terrain(task.terrain)

    def compiled(**how: Any) -> bytes:
        model, _ = build_model(task.robot, ground, 0.002, decoration, **how)
        content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, content)
        return content.tobytes()

    first = compiled()
    assert compiled(held=(1.0, 0.0, 0.0, 0.0), mounted=True, imu=True) != first
    assert compiled() == first
