"""Effects of inertia, sensors, contact and transmission against computations that know nothing of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.compose import compose
from go1exp.config.schema.registry import bind_list
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.effects.base import Gears, Measured
from go1exp.sim.effects.gears import TwoMass
from go1exp.sim.env.plant import Plant, actuator_setup
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import TaskConfig, parse_task
from go1exp.sim.terrain import build_terrain
from tests.small_run import plain

G = 9.81
CALVES = slice(2, None, 3)
HIPS, THIGHS = slice(0, None, 3), slice(1, None, 3)
Quat = tuple[float, float, float, float]
LEVEL: Quat = (1.0, 0.0, 0.0, 0.0)


def engine(plant: Plant) -> MujocoCpu:
    """The plant's physics, to look into."""
    assert isinstance(plant.backend, MujocoCpu)
    return plant.backend


@cache
def task() -> TaskConfig:
    return parse_task(compose("train", plain("rand=none", "backend.threads=1")))


def rig(
    effects: Mapping[str, Mapping[str, Any]],
    *,
    held: Quat | None = LEVEL,
    kp: float = 35.0,
    kd: float = 1.2,
    dt: float = 0.002,
    n: int = 1,
    stance: np.ndarray = robot.NOMINAL_STANCE,
    height: float = robot.NOMINAL_HEIGHT,
) -> Plant:
    """Build robots with effects, at rest in ``stance``."""
    backend = MujocoCpu(*build_model(task().robot, build_terrain(task().terrain), dt, held=held), n, 1)
    terms = bind_list("effect", [effects], "effect")
    plant = Plant(backend, actuator_setup(task().robot, dt, backend, EnvRandom(0, n)), task().actuator, terms)
    plant.set_gains(*(torch.full_like(plant.q, gain) for gain in (kp, kd)))
    plant.startup()
    qpos = torch.zeros_like(backend.qpos)
    qpos[:, -robot.NUM_JOINTS :] = torch.as_tensor(stance)
    if held is None:
        qpos[:, 2], qpos[:, 3] = height, 1.0
    start(plant, qpos)
    return plant


def start(plant: Plant, qpos: Tensor, qvel: Tensor | None = None) -> None:
    """Put the robots into a state, which is also their target."""
    everyone = torch.ones(len(qpos), dtype=torch.bool)
    plant.backend.reset(everyone, qpos, torch.zeros_like(plant.backend.qvel) if qvel is None else qvel)
    plant.reset(everyone, qpos[:, -robot.NUM_JOINTS :])


def settle(plant: Plant, target: Tensor | np.ndarray = robot.NOMINAL_STANCE, seconds: float = 1.0) -> Tensor:
    """Hold ``target`` and return the joint angles (N, J) in the end."""
    goal = torch.as_tensor(target).expand(plant.q.shape)
    for _ in range(round(seconds / plant.backend.model.opt.timestep)):
        plant.step(goal)
    return plant.q.clone()


# ---------------------------------------------------------------------- inertia


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the mass matrix as MuJoCo has it."""
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def by_jacobians(model: mujoco.MjModel, data: mujoco.MjData, body: Mapping[str, np.ndarray], rotor: np.ndarray) -> Any:
    """Return mass matrix and gravity's torques of links given by mass, com and inertia in their own frames."""
    full, weight = np.diag(rotor), np.zeros(model.nv)
    for b in range(1, model.nbody):
        turn = data.xmat[b].reshape(3, 3)
        com = data.xpos[b] + turn @ body["com"][b]
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, linear, angular, com, b)
        inertia = turn @ body["inertia"][b] @ turn.T
        full += body["mass"][b] * linear.T @ linear + angular.T @ inertia @ angular
        weight += body["mass"][b] * G * linear[2]
    return full, weight


def links_of(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return mass, centre and inertia (3, 3) of all bodies, in their frames."""
    axes = Rotation.from_quat(model.body_iquat, scalar_first=True).as_matrix()
    inertia = np.einsum("bij,bj,bkj->bik", axes, model.body_inertia, axes)
    return {"mass": model.body_mass.copy(), "com": model.body_ipos.copy(), "inertia": inertia}


def expected(name: str, model: mujoco.MjModel) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the links and rotors that an effect should make of ``model``, written down anew."""
    body, rotor = links_of(model), model.dof_armature.copy()
    trunk = model.body("trunk").id
    links = [model.body(joint).id for joint in robot.JOINTS]
    calves = links[CALVES]
    if name == "armature":
        rotor[-12:] += [0.002, 0.002, -0.003] * 4
    elif name == "link_mass":
        body["mass"][calves] *= 1.3
        body["inertia"][calves] *= 1.3
    elif name == "link_inertia":
        body["inertia"][links] *= 0.7
    elif name == "link_com":
        body["com"][calves] += [0.007, -0.004, -0.012]
    elif name == "com_offset":
        body["com"][trunk] += [0.03, -0.01, 0.02]
    return body, rotor


EDITS: dict[str, dict[str, Any]] = {
    "armature": {"added": [0.002, 0.002, -0.003]},
    "link_mass": {"scale": {"calf": 1.3}},
    "link_inertia": {"scale": 0.7},
    "link_com": {"along": {"calf": 0.012}, "forward": {"calf": 0.007}, "left": {"calf": -0.004}},
    "com_offset": {"x": 0.03, "y": -0.01, "z": 0.02},
}


def somewhere(model: mujoco.MjModel) -> mujoco.MjData:
    """Return a state with every joint and the trunk turned, at rest."""
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    data.qpos[:3] = 0.0, 0.0, 2.0
    data.qpos[3:7] = Rotation.random(rng=rng).as_quat(scalar_first=True)
    data.qpos[7:] = robot.NOMINAL_STANCE + rng.uniform(-0.4, 0.4, 12)
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("name", EDITS)
def test_inertia_and_weight_are_those_of_the_links_written_down_anew(name: str) -> None:
    edited = engine(rig({name: EDITS[name]}, held=None)).env_model(0)
    compiled = build_model(task().robot, build_terrain(task().terrain), 0.002)[0]
    body, rotor = expected(name, compiled)
    plain = by_jacobians(compiled, somewhere(compiled), links_of(compiled), compiled.dof_armature)
    assert np.allclose(mass_matrix(compiled, somewhere(compiled)), plain[0], atol=1e-9)  # the reference is right
    full, weight = by_jacobians(compiled, somewhere(compiled), body, rotor)
    data = somewhere(edited)
    assert np.allclose(mass_matrix(edited, data), full, atol=1e-9)
    assert np.allclose(data.qfrc_bias, weight, atol=1e-9)
    changed = np.abs(full - plain[0]).max() + np.abs(weight - plain[1]).max()
    assert changed > 1e-4


def with_bodies(loads: Mapping[str, tuple[float, tuple[float, float, float]]]) -> mujoco.MjModel:
    """Compile a robot that carries real bodies: name of the link -> mass, kg, and place in its frame, m."""
    from go1exp.sim.physics.scene import load_robot

    spec = load_robot(task().robot.inertia)
    for link, (mass, at) in loads.items():
        box = spec.body(link).add_body(name=f"{link}_load", pos=list(at))
        box.explicitinertial, box.mass, box.inertia, box.ipos = True, mass, [1e-12] * 3, [0.0] * 3
    for kind, name in enumerate(robot.JOINT_KINDS):
        for leg in robot.LEGS:
            spec.joint(f"{leg}_{name}").armature = task().robot.armature[kind]
    return spec.compile()


@pytest.mark.parametrize(
    ("effect", "links", "mass", "at"),
    [
        ("payload", ["trunk"], 3.0, (0.1, -0.05, 0.12)),
        ("payload", ["trunk"], 0.4, (-0.2, 0.0, -0.1)),
        ("point_load", [f"{leg}_calf" for leg in robot.LEGS], 0.15, (0.01, -0.02, -0.213)),
        ("point_load", [f"{leg}_thigh" for leg in robot.LEGS], 0.15, (0.0, 0.03, -0.1)),
    ],
)
def test_a_load_is_a_body_on_its_link(
    effect: str, links: list[str], mass: float, at: tuple[float, float, float]
) -> None:
    """Mass matrix, gravity and Coriolis torques against a robot compiled with such bodies."""
    share: Any = {link: mass for link in links} if effect == "point_load" else mass
    edited = engine(rig({effect: {"mass": share, **dict(zip("xyz", at, strict=True))}}, held=None)).env_model(0)
    real = with_bodies({link: (mass, at) for link in links})
    a, b = somewhere(edited), somewhere(real)
    assert edited.body_subtreemass[1] == pytest.approx(real.body_subtreemass[1], rel=1e-12)
    assert np.allclose(a.subtree_com[1], b.subtree_com[1], atol=1e-12)
    assert np.allclose(mass_matrix(edited, a), mass_matrix(real, b), atol=1e-9)
    a.qvel[:] = b.qvel[:] = np.random.default_rng(1).normal(0.0, 3.0, 18)
    mujoco.mj_forward(edited, a)
    mujoco.mj_forward(real, b)
    assert np.allclose(a.qfrc_bias, b.qfrc_bias, atol=1e-7)


@pytest.mark.slow("go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_payload_taken_away_undoes_one_and_leaves_an_inertia() -> None:
    both = {
        "first": {"term": "payload", "mass": 0.8, "z": 0.05},
        "second": {"term": "payload", "mass": -0.8, "z": 0.05},
    }
    edited, plain = engine(rig(both, held=None)).env_model(0), rig({}, held=None).backend.model
    a, b = somewhere(edited), somewhere(plain)
    assert np.allclose(mass_matrix(edited, a), mass_matrix(plain, b), atol=1e-9)
    corner = {"payload": {"mass": -1.0, "x": 0.3, "y": 0.2, "z": 0.3}}
    assert engine(rig(corner, held=None)).env_model(0).body_inertia[1].min() > 0.09 * plain.body_inertia[1].min()


# ---------------------------------------------------------------------- gravity, forces, IMU


@pytest.mark.parametrize("held", [LEVEL, (0.8, 0.0, 0.6, 0.0)])
def test_a_tilted_stand_moves_as_a_robot_held_in_that_orientation(held: Quat) -> None:
    roll, pitch = 0.11, -0.17
    tilt = Rotation.from_euler("YX", [pitch, roll])  # intrinsic: pitch, then roll
    turned = (Rotation.from_quat(held, scalar_first=True) * tilt).as_quat(scalar_first=True)
    effect = rig({"base_tilt": {"roll": roll, "pitch": pitch}}, held=held)
    truth = rig({}, held=tuple(turned))
    level = rig({}, held=held)
    for plant in (effect, truth, level):
        settle(plant, robot.NOMINAL_STANCE + 0.2, 0.3)
    assert torch.allclose(effect.q, truth.q, atol=1e-9)
    assert (level.q - truth.q).abs().max() > 3e-3
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    believed = torch.as_tensor(Rotation.from_quat(held, scalar_first=True).inv().apply(down.numpy()))
    seen = effect.effects.measure(Measured(effect.q, effect.qd, gravity=believed)).gravity
    assert seen is not None
    assert np.allclose(seen, Rotation.from_quat(turned, scalar_first=True).inv().apply(down.numpy()), atol=1e-12)


def test_an_imu_that_sits_tilted_turns_its_readings_and_nothing_else() -> None:
    plant, plain = (rig(e, held=None) for e in ({"base_tilt": {"roll": 0.1, "pitch": 0.2}}, {}))
    assert torch.equal(settle(plant, seconds=0.2), settle(plain, seconds=0.2))
    true = [torch.as_tensor(np.random.default_rng(k).normal(size=(1, 3))) for k in range(3)]
    seen = plant.effects.measure(Measured(plant.q, plant.qd, *true))
    mounted = Rotation.from_euler("YX", [0.2, 0.1])
    for reading, vector in zip((seen.gravity, seen.gyro, seen.acc), true, strict=True):
        assert reading is not None
        assert np.allclose(reading, mounted.inv().apply(vector.numpy()), atol=1e-12)


def test_a_wrench_accelerates_the_whole_robot_by_force_over_mass() -> None:
    force = np.array([6.0, -3.0, 20.0])
    plant = rig({"external_wrench": dict(zip("xyz", force, strict=True))}, held=None, height=2.0)
    settle(plant, seconds=0.1)
    model, data = engine(plant).env_model(0), engine(plant).env_data(0)
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    mass = model.body_subtreemass[1]
    assert np.allclose(data.subtree_linvel[1], 0.1 * (force / mass - [0.0, 0.0, G]), atol=1e-4)


# ---------------------------------------------------------------------- contact


@pytest.mark.slow("go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
@pytest.mark.parametrize("scale", [0.3, 0.5])
def test_feet_slip_beyond_friction_times_weight(scale: float) -> None:
    """Pushed beyond it a robot gains speed by (force - friction) / mass; below, its feet only creep (soft contact)."""
    friction = scale * 0.8

    def gain(share: float) -> float:
        plant = rig(
            {"foot_friction": {"scale": scale}, "external_wrench": {}}, held=None, kp=150.0, kd=3.0, height=0.318
        )
        settle(plant, seconds=0.3)
        push: Any = plant.effects.effects["external_wrench"]
        push.x.fill_(share * friction * plant.backend.model.body_subtreemass[1] * G)
        settle(plant, seconds=0.15)
        before = float(plant.backend.qvel[0, 0])
        settle(plant, seconds=0.3)
        return (float(plant.backend.qvel[0, 0]) - before) / 0.3

    assert gain(0.9) < 0.0
    assert gain(1.3) == pytest.approx(0.3 * friction * G, rel=0.05)


def test_the_foot_has_the_say_in_a_contact() -> None:
    model = engine(rig({"foot_friction": {"scale": 0.5}}, held=None)).env_model(0)
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7:] = (0.0, 0.0, 0.318, 1.0, 0.0, 0.0, 0.0), robot.NOMINAL_STANCE
    mujoco.mj_forward(model, data)
    assert 0 < data.ncon <= 4
    assert all(c.friction[0] == pytest.approx(0.4) for c in data.contact)


def test_feet_sink_with_the_square_of_the_time_constant() -> None:
    def sink(time_constant: float) -> np.ndarray:
        plant = rig({"ground_compliance": {"time_constant": time_constant}}, held=None, kp=150.0, kd=3.0, height=0.318)
        settle(plant)
        blocks = plant.backend.sensors
        return robot.FOOT_RADIUS - plant.backend.sensordata[0, blocks.foot_pos_w].numpy().reshape(4, 3)[:, 2]

    shallow, deep = sink(0.04), sink(0.08)
    assert (shallow > 1e-3).all()
    assert np.allclose(deep / shallow, 4.0, rtol=0.1)


def test_a_restitution_that_is_randomised_acts_on_soft_ground_too() -> None:
    from go1exp.mdp.randomizations import foot_restitution

    plant = rig({"ground_compliance": {"time_constant": 0.05}}, held=None, n=2)
    stream = EnvRandom(1, 2).stream("x")
    foot_restitution(plant.backend, stream, torch.ones(2, dtype=torch.bool), range=(0.3, 0.5))
    model = engine(plant).env_model(1)
    foot = model.geom("FL_foot").id
    assert model.geom_solref[foot].prod() == pytest.approx(0.05)  # the spring stays
    assert model.geom_solref[foot, 1] < 1.0


def test_a_soft_stop_yields_with_the_square_of_its_time_constant() -> None:
    beyond = np.array([0.0, 0.8, robot.JOINT_POS_LIMITS[2, 1] + 0.2] * 4)
    rest = np.array([0.0, 0.8, robot.JOINT_POS_LIMITS[2, 1] - 0.02] * 4)

    def give(time_constant: float) -> Tensor:
        found = settle(rig({"joint_stop": {"time_constant": time_constant}}, stance=rest), beyond)
        return found[0, CALVES] - robot.JOINT_POS_LIMITS[2, 1]

    hard, soft = give(0.05), give(0.1)
    assert (hard > 1e-3).all()
    # The drive pushes less, the further the joint goes.
    force = [0.2 - hard, 0.2 - soft]
    assert torch.allclose((soft / hard) * (force[0] / force[1]), torch.full_like(hard, 4.0), rtol=0.15)


def thrown(values: Mapping[str, Any], speed: float = 3.0, dt: float = 0.00025) -> tuple[Tensor, Tensor]:
    """Throw weightless calves at their upper stops, all other joints blocked; return angles and speeds (K, 4)."""
    stance = robot.NOMINAL_STANCE.copy()
    stance[CALVES] = robot.JOINT_POS_LIMITS[2, 1] - 0.1
    plant = rig({"joint_stop": values}, kp=0.0, kd=0.0, dt=dt, stance=stance)
    plant.backend.field("opt.gravity").zero_()
    armature = plant.backend.field("dof_armature")
    armature[:, HIPS], armature[:, THIGHS] = 1e4, 1e4
    plant.backend.derive_constants(torch.ones(1, dtype=torch.bool))
    velocity = torch.zeros_like(plant.q)
    velocity[:, CALVES] = speed
    start(plant, plant.q.clone(), velocity)
    states = []
    for _ in range(round(0.25 / dt)):
        plant.step(plant.q)
        states.append(torch.stack([plant.q[0, CALVES], plant.qd[0, CALVES]]))
    q, qd = torch.stack(states, dim=1)
    return q, qd


@pytest.mark.parametrize("e", [0.05, 0.3, 0.6])
def test_a_joint_comes_back_from_its_stop_with_its_restitution(e: float) -> None:
    _, qd = thrown({"restitution": e})
    assert torch.allclose(-qd[-1] / 3.0, torch.full_like(qd[-1], e), atol=0.03), -qd[-1] / 3.0


def test_no_stop_gives_back_more_than_it_got() -> None:
    """All softnesses and rebounds, at the step of training."""
    for time_constant in (0.004, 0.02, 0.2):
        for e in (0.02, 0.7):
            _, qd = thrown({"restitution": e, "time_constant": time_constant}, dt=0.002)
            assert qd.abs().max() <= 3.0 * (1.0 + 1e-4)  # what blocks the other joints is not infinitely heavy
            assert (-qd[-1] < 0.9 * 3.0).all()


@pytest.mark.parametrize("shift", [-0.15, 0.12])
def test_a_shifted_stop_is_met_where_it_is(shift: float) -> None:
    beyond = np.array([0.0, 0.8, robot.JOINT_POS_LIMITS[2, 1] + 0.3] * 4)
    hard = {"time_constant": 0.004, "upper": {"calf": shift}}
    q = settle(rig({"joint_stop": hard}), beyond)[0, CALVES]
    assert torch.allclose(q, torch.full_like(q, robot.JOINT_POS_LIMITS[2, 1] + shift), atol=0.01)


def test_no_stop_passes_the_middle_of_its_range() -> None:
    plant = rig({"joint_stop": {}})
    narrow = plant.backend.model.jnt_range.copy()
    narrow[:, 1] = narrow[:, 0] + 0.2
    plant.backend.model.jnt_range[:] = narrow
    effect: Any = plant.effects.effects["joint_stop"]
    effect.lower.fill_(0.3)
    effect.upper.fill_(-0.3)
    plant.refresh()
    ends = plant.backend.field("jnt_range")[0].numpy()
    assert np.allclose(ends, narrow.mean(1)[:, None])


# ---------------------------------------------------------------------- transmission


def gears(compliance: float = 0.0, gap: float = 0.0, damping: float = 0.02, n: int = 1) -> Gears:
    return Gears(*(torch.full((n, 12), x, dtype=torch.float64) for x in (compliance, gap, damping)))


def frequency(signal: np.ndarray, dt: float) -> float:
    """Return the frequency of a decaying oscillation by its crossings of zero, Hz."""
    k = np.flatnonzero(np.diff(np.sign(signal)))
    crossings = k + signal[k] / (signal[k] - signal[k + 1])
    return float((len(crossings) - 1) / (2.0 * dt * (crossings[-1] - crossings[0])))


@pytest.mark.slow("go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
@pytest.mark.parametrize("compliance", [1 / 60, 1 / 150, 1 / 400])
@pytest.mark.parametrize(("dt", "tolerance"), [(0.00025, 0.003), (0.002, 0.08)])
def test_rotor_and_calf_swing_at_the_two_mass_frequency(compliance: float, dt: float, tolerance: float) -> None:
    """All other joints blocked, weightless; the trapezoidal rule slows a swing by (2 pi f dt)^2 / 12."""
    plant = rig({"flexibility": {"compliance": {"calf": compliance}, "damping": 0.02}}, kp=0.0, kd=0.0, dt=dt)
    plant.backend.field("opt.gravity").zero_()
    inertia = plant._inertia  # what the engine takes for the rotors of gears that do not yield
    inertia[:, HIPS], inertia[:, THIGHS] = 1e4, 1e4
    model = plant.backend.model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.NOMINAL_STANCE
    mujoco.mj_forward(model, data)
    rotor = robot.ROTOR_ARMATURE[2]
    calf = mass_matrix(model, data)[2, 2] - rotor
    assert plant.effects.rotors is not None
    plant.effects.rotors.twist[:, CALVES] = 0.01
    twist = []
    for _ in range(round(0.25 / dt)):
        plant.step(plant.q)
        twist.append(float(plant.effects.rotors.twist[0, 2]))
    right = math.sqrt((1.0 / rotor + 1.0 / calf) / compliance) / (2.0 * math.pi)
    found = frequency(np.array(twist), dt)
    assert found == pytest.approx(right, rel=tolerance)
    assert found == pytest.approx(right * (1.0 - (2.0 * math.pi * right * dt) ** 2 / 12.0), rel=0.02)


def test_a_spring_twists_by_compliance_times_torque_and_the_drive_reads_the_rotor() -> None:
    compliance = 0.01
    plant = rig({"flexibility": {"compliance": compliance}})
    q = settle(plant, seconds=2.0)
    assert plant.effects.rotors is not None
    assert torch.allclose(plant.effects.rotors.twist, compliance * plant.torque, atol=1e-7)
    seen = plant.effects.measure(Measured(plant.q, plant.qd)).joint_pos
    assert torch.allclose(seen, q + compliance * plant.torque, atol=1e-7)
    assert torch.allclose(plant.torque, 35.0 * (torch.as_tensor(robot.NOMINAL_STANCE) - seen), atol=1e-7)
    assert plant.torque.abs().max() > 0.5


def test_flexibility_and_backlash_are_in_series() -> None:
    """At rest under load: half of the gap, and the spring's twist."""
    compliance, gap = 0.01, 0.02
    plant = rig({"flexibility": {"compliance": compliance, "damping": 0.3}, "backlash": {"gap": gap}})
    settle(plant, seconds=3.0)
    loaded = plant.torque.abs() > 0.3
    assert loaded.sum() >= 8
    assert plant.effects.rotors is not None
    twist = plant.torque.sign() * 0.5 * gap + compliance * plant.torque
    assert torch.allclose(plant.effects.rotors.twist[loaded], twist[loaded], atol=1e-5)


def test_within_the_gap_no_torque_passes_and_the_joint_has_lost_its_rotor(drives: Any) -> None:
    setup: ActuatorSetup = drives(1)
    rotors = TwoMass(setup)
    torque = torch.full((1, 12), 0.5, dtype=torch.float64)
    rotor = torch.full_like(torque, 0.0045)
    rigid, through, carried = rotors.transmit(gears(gap=0.05), torque, rotor)
    assert not rigid.any()
    assert not through.any()
    assert not carried.any()
    rotors.follow(torch.zeros_like(torque))
    assert torch.allclose(rotors.rate, 0.002 * torque / rotor)
    still, read = torch.zeros_like(torque), []
    for _ in range(3):
        rotors.transmit(gears(gap=0.05), torque, rotor)
        rotors.follow(still)
        read.append(rotors.motor(still, still))
    (before, _), (_, speed), (after, _) = read
    assert torch.allclose(speed, (after - before) / 0.004)  # at the instant of the angle, not half a step earlier


@pytest.mark.slow("go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_the_stiffer_a_spring_the_more_it_is_a_rigid_gear() -> None:
    target = robot.NOMINAL_STANCE + 0.2
    rigid = settle(rig({}), target, 0.1)
    errors = [
        float((settle(rig({"flexibility": {"compliance": c}}), target, 0.1) - rigid).abs().max())
        for c in (1e-2, 1e-3, 1e-4, 1e-6)
    ]
    assert all(b < 0.3 * a for a, b in itertools.pairwise(errors)), errors
    assert errors[-1] < 1e-4


def kinetic(plant: Plant) -> Tensor:
    """(N,) kinetic energy of links and rotors, J."""
    assert plant.effects.rotors is not None
    found = []
    for env in range(len(plant.q)):
        model, data = engine(plant).env_model(env), engine(plant).env_data(env)
        model.dof_armature[:] = 0.0
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_energyVel(model, data)
        found.append(data.energy[1])
    speed = plant.qd + plant.effects.rotors.rate
    rotor = torch.as_tensor(robot.per_joint(robot.ROTOR_ARMATURE))
    return torch.tensor(found) + (0.5 * rotor * speed**2).sum(1)


@pytest.mark.slow("go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
@pytest.mark.parametrize("kinds", [("flexibility",), ("backlash",), ("flexibility", "backlash")])
def test_gears_make_no_energy(kinds: tuple[str, ...]) -> None:
    """Drives off, weightless, legs thrown about, all values within the bounds: links and rotors only lose speed."""
    n, rng = 12, np.random.default_rng(5)
    plant = rig({kind: {} for kind in kinds}, kp=0.0, kd=0.0, n=n)
    plant.backend.field("opt.gravity").zero_()
    for kind, effect in plant.effects.effects.items():
        for p in effect.params:
            share = torch.as_tensor(rng.uniform(0.0, 1.0, (n, 12)) ** (3 if p.name == "compliance" else 1))
            getattr(effect, p.name).copy_(p.low + (p.high - p.low) * share)
        assert kind in kinds
    velocity = torch.as_tensor(rng.normal(0.0, 4.0, (n, 12)))
    start(plant, plant.q.clone(), velocity)
    assert plant.effects.rotors is not None
    plant.effects.rotors.rate.copy_(torch.as_tensor(rng.normal(0.0, 2.0, (n, 12))))
    energy = [kinetic(plant)]
    for _ in range(50):
        settle(plant, seconds=0.002)
        energy.append(kinetic(plant))
    relative = torch.stack(energy) / energy[0]
    assert relative.max() < 1.02
    assert relative[-1].median() < 0.98


def test_a_gear_may_carry_more_than_the_drive_can_make() -> None:
    """A rotor at speed that is stopped by its gear: the drive's limit is not the gear's."""
    plant = rig({"flexibility": {"compliance": 1e-3}}, kp=0.0, kd=0.0)
    plant.backend.field("opt.gravity").zero_()
    assert plant.effects.rotors is not None
    plant.effects.rotors.twist[:, CALVES] = 0.1  # 100 N m
    before = plant.qd.clone()
    plant.step(plant.q)
    torque = plant.backend.applied()[0, CALVES]
    assert (torque > 50.0).all()
    assert ((plant.qd - before)[0, CALVES] > 0.0).all()


@pytest.mark.slow("go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_free_play_between_upright_and_upside_down_is_the_gap() -> None:
    gap, upside_down = 0.02, (0.0, 1.0, 0.0, 0.0)
    q = {
        (b, held): settle(rig({"backlash": {"gap": b}}, held=held, kp=400.0, kd=2.0), seconds=2.0)
        for b in (0.0, gap)
        for held in (LEVEL, upside_down)
    }
    rigid = q[0.0, LEVEL] - q[0.0, upside_down]
    loose = q[gap, LEVEL] - q[gap, upside_down]
    play = (loose - rigid) * rigid.sign()
    assert torch.allclose(play[:, THIGHS], torch.full_like(play[:, THIGHS], gap), rtol=0.05)
    assert torch.allclose(play[:, CALVES], torch.full_like(play[:, CALVES], gap), rtol=0.05)


def test_a_shifted_calf_hangs_lower_by_the_torque_of_its_weight() -> None:
    """Static: kp x (change of angle) = weight x shift x sin(pitch of the calf), thigh and calf alike."""
    shift, kp = 0.02, 400.0
    a, b = (settle(rig({"link_com": {"along": {"calf": s}}}, kp=kp, kd=4.0)) for s in (0.0, shift))
    q = robot.NOMINAL_STANCE
    mass = rig({}).backend.model.body("FR_calf").mass[0]
    lever = shift * np.sin(q[THIGHS] + q[CALVES]) * np.cos(q[HIPS])
    for joint in (THIGHS, CALVES):
        assert np.allclose(kp * (b - a)[0, joint].numpy(), -mass * G * lever, atol=2e-3, rtol=0.05)
    assert np.abs(lever).min() > 0.005
