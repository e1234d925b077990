"""What every physics backend owes, on the engines that this machine has.

``warp on cpu`` runs where mujoco-warp is installed: the same kernels, compiled for the processor. ``warp on cuda``
needs a GPU as well. ``physx`` runs where sapien is installed; what its rigid contacts do is in tests/test_physx.py.
"""

from __future__ import annotations

import copy
import importlib.util
import io
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.cli.subjects import split_engine as engine_of
from go1exp.config.compose import compose
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.engine import make_backend
from go1exp.sim.physics import agreement
from go1exp.sim.physics.backend import PhysicsBackend
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import TaskConfig
from go1exp.sim.terrain import build_terrain

HAS_WARP = importlib.util.find_spec("mujoco_warp") is not None
needs_warp = pytest.mark.skipif(not HAS_WARP, reason="mujoco-warp is not installed: pip install 'go1exp[gpu]'")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")

CPU = ("backend.threads=1",)
HAS_PHYSX = importlib.util.find_spec("sapien") is not None
needs_physx = pytest.mark.skipif(not HAS_PHYSX, reason="sapien is not installed: pip install 'go1exp[physx]'")

PHYSX = ("engine=physx",)
WARP_CPU = ("backend=warp", "backend.device=cpu", "backend.graph=false")
WARP_CUDA = ("backend=warp",)
ON_CPU = pytest.param(WARP_CPU, marks=needs_warp, id="warp on cpu")
ON_CUDA = pytest.param(WARP_CUDA, marks=[needs_warp, needs_gpu, pytest.mark.gpu], id="warp on cuda")
IN_PHYSX = pytest.param(PHYSX, marks=needs_physx, id="physx")
MUJOCOS = pytest.mark.parametrize("engine", [pytest.param(CPU, id="cpu"), ON_CPU, ON_CUDA])
ENGINES = pytest.mark.parametrize("engine", [pytest.param(CPU, id="cpu"), ON_CPU, ON_CUDA, IN_PHYSX])
OTHERS = pytest.mark.parametrize("engine", [ON_CPU, ON_CUDA, IN_PHYSX])
WARPS = pytest.mark.parametrize("engine", [ON_CPU, ON_CUDA])
GROUNDS = pytest.mark.parametrize(
    "ground", [(), ("terrain=rough", "terrain.rows=3", "terrain.cols=3")], ids=["flat", "rough"]
)

TRUNK = 8
"""Its column among the link contacts."""

Build = Callable[..., PhysicsBackend]


@pytest.fixture
def build(make_task: Callable[..., TaskConfig]) -> Build:
    """Make a backend of n robots from overrides."""

    def make(n: int, *overrides: str) -> PhysicsBackend:
        judge = [o for o in overrides if o.startswith("engine")]
        task = make_task(*(o for o in overrides if o not in judge))
        model, sensors = build_model(task.robot, build_terrain(task.terrain), task.sim.physics_dt)
        chosen = engine_of(compose("eval", judge))[0] if judge else task.backend
        return make_backend(chosen, model, sensors, n)

    return make


def everyone(backend: PhysicsBackend) -> torch.Tensor:
    return torch.ones(backend.num_envs, dtype=torch.bool, device=backend.qpos.device)


def put(backend: PhysicsBackend, mask: torch.Tensor, qpos: np.ndarray, qvel: np.ndarray) -> None:
    """Reset rows to a state given on the host."""
    device, dtype = backend.qpos.device, backend.qpos.dtype
    backend.reset(mask, *(torch.as_tensor(a, dtype=dtype, device=device) for a in (qpos, qvel)))


def drive(backend: PhysicsBackend, steps: int, start: int = 0) -> None:
    """Make steps in which each robot swings its legs about the stance, harder than a walk."""
    stance = torch.as_tensor(robot.NOMINAL_STANCE, dtype=backend.qpos.dtype, device=backend.qpos.device)
    for k in range(start, start + steps):
        target = stance + 0.2 * float(np.sin(4.0 * np.pi * 0.002 * k))
        backend.step(40.0 * (target - backend.qpos[:, -12:]) - backend.qvel[:, -12:])


def initial(n: int, height: float = robot.NOMINAL_HEIGHT, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Robots near the nominal stance, each a little different: qpos (n, 19), qvel (n, 18)."""
    rng = np.random.default_rng(seed)
    qpos, qvel = np.zeros((n, 19)), rng.normal(0.0, 0.3, (n, 18))
    qpos[:, 2] = height
    qpos[:, 3:7] = Rotation.from_rotvec(rng.normal(0.0, 0.1, (n, 3))).as_quat(scalar_first=True)
    qpos[:, 7:] = robot.NOMINAL_STANCE + rng.normal(0.0, 0.1, (n, 12))
    return qpos, qvel


def randomize(backend: PhysicsBackend, seed: int = 0) -> dict[str, np.ndarray]:
    """Give every robot masses, a trunk and feet of its own; return what was written."""
    n, model, rng = backend.num_envs, backend.model, np.random.default_rng(seed)
    factor = rng.uniform(0.8, 1.3, (n, model.nbody))
    own = {
        "body_mass": model.body_mass * factor,
        "body_inertia": model.body_inertia * factor[:, :, None],
        "body_ipos": model.body_ipos + rng.uniform(-0.02, 0.02, (n, model.nbody, 3)),
        "geom_friction": model.geom_friction * rng.uniform(0.6, 1.2, (n, model.ngeom, 1)),
    }
    for name, values in own.items():
        backend.field(name).copy_(torch.as_tensor(values))
    backend.derive_constants(everyone(backend))
    return own


def host(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().to(torch.float64, copy=True).numpy()


# ---------------------------------------------------------------------- state and sensors


@ENGINES
def test_a_reset_touches_masked_rows_only_and_they_go_on_like_new(build: Build, engine: tuple[str, ...]) -> None:
    backend, new = build(4, *engine), build(4, *engine)
    put(backend, everyone(backend), *initial(4))
    drive(backend, 60)
    before = [host(x) for x in (backend.qpos, backend.qvel, backend.sensordata)]
    mask = torch.tensor([False, True, False, True], device=backend.qpos.device)
    here, there = mask.cpu().numpy(), ~mask.cpu().numpy()
    fresh = initial(4, seed=5)
    garbage = [np.where(here[:, None], good, np.nan) for good in fresh]
    put(backend, mask, *garbage)
    put(new, everyone(new), *fresh)
    for was, name in zip(before, ("qpos", "qvel", "sensordata"), strict=True):
        np.testing.assert_array_equal(host(getattr(backend, name))[there], was[there], err_msg=name)
        np.testing.assert_allclose(host(getattr(backend, name))[here], host(getattr(new, name))[here], atol=1e-4)
    drive(backend, 20)
    drive(new, 20)
    np.testing.assert_allclose(host(backend.qpos)[here], host(new.qpos)[here], atol=1e-5)
    assert np.isfinite(host(backend.qpos)).all()


@ENGINES
def test_what_holds_the_links_is_mujocos_bias_of_the_state_before_the_step(
    build: Build, engine: tuple[str, ...]
) -> None:
    backend = build(2, *engine)
    bias = backend.bias()
    put(backend, everyone(backend), *initial(2, height=1.0))

    def serial(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        data, held = mujoco.MjData(backend.model), []
        for data.qpos[:], data.qvel[:] in zip(qpos, qvel, strict=True):
            mujoco.mj_forward(backend.model, data)
            held.append(data.qfrc_bias.copy())
        return np.stack(held)

    np.testing.assert_allclose(host(bias), serial(host(backend.qpos), host(backend.qvel)), rtol=1e-3, atol=1e-3)
    drive(backend, 20)
    before = host(backend.qpos), host(backend.qvel)
    drive(backend, 1, start=20)
    np.testing.assert_allclose(host(bias), serial(*before), rtol=1e-3, atol=1e-3)


@ENGINES
def test_after_a_step_sensors_describe_the_state_before_it(build: Build, engine: tuple[str, ...]) -> None:
    backend = build(2, *engine)
    put(backend, everyone(backend), *initial(2))
    drive(backend, 10)
    qpos, qvel = host(backend.qpos), host(backend.qvel)
    drive(backend, 1, start=10)
    s, data = backend.sensors, mujoco.MjData(backend.model)
    for env in range(2):
        data.qpos[:], data.qvel[:] = qpos[env], qvel[env]
        mujoco.mj_forward(backend.model, data)
        for block in (s.foot_pos_w, s.foot_vel_w):
            np.testing.assert_allclose(host(backend.sensordata)[env, block], data.sensordata[block], atol=2e-5)


@GROUNDS
@MUJOCOS
def test_contacts_of_any_posture_are_those_of_mujoco(
    build: Build, engine: tuple[str, ...], ground: tuple[str, ...]
) -> None:
    """Feet, links and forces, of robots turned any way up that have just touched the ground."""
    n = 40
    backend, reference = build(n, *engine, *ground), build(n, *CPU, *ground)
    rng, (low, high) = np.random.default_rng(0), robot.JOINT_POS_LIMITS.T
    qpos = np.zeros((n, 19))
    qpos[:, 2] = rng.uniform(0.05, 0.35, n)
    qpos[:, 3:7] = Rotation.random(n, random_state=0).as_quat(scalar_first=True)
    qpos[:, 7:] = rng.uniform(low, high, (n, 12))
    for b in (backend, reference):
        put(b, everyone(b), qpos, np.zeros((n, 18)))
    s, got, want = backend.sensors, host(backend.sensordata), host(reference.sensordata)
    feet, other = (a[:, s.foot_contact].reshape(n, 4, 4) for a in (got, want))
    # On edges of a height field the two engines now and then disagree about a contact of no depth.
    few = 0.0 if not ground else 0.03
    assert np.mean((feet[..., 0] > 0) != (other[..., 0] > 0)) <= few
    assert np.mean((got[:, s.link_contacts] > 0) != (want[:, s.link_contacts] > 0)) <= few
    assert (want[:, s.link_contacts] > 0).sum() > 30
    if not ground:
        # A box on a plane has four contacts in MuJoCo, up to eight in MuJoCo Warp.
        legs = np.arange(13) != TRUNK
        np.testing.assert_array_equal(got[:, s.link_contacts][:, legs], want[:, s.link_contacts][:, legs])
        np.testing.assert_array_equal(feet[..., 0], other[..., 0])
        upright = want[:, s.link_contacts][:, TRUNK] == 0
        np.testing.assert_allclose(feet[upright], other[upright], rtol=2e-3, atol=0.5)
        assert (other[upright][..., 3] > 1.0).sum() > 10


# ---------------------------------------------------------------------- the model


@ENGINES
def test_derived_constants_follow_the_masses_of_each_robot(build: Build, engine: tuple[str, ...]) -> None:
    backend = build(3, *engine)
    own = randomize(backend)
    untouched = {name: host(backend.field(name)) for name in ("body_subtreemass", "body_invweight0", "dof_invweight0")}
    backend.field("body_mass").mul_(1.5)
    mask = torch.tensor([False, True, False], device=backend.qpos.device)
    backend.derive_constants(mask)
    for env in range(3):
        model = copy.copy(backend.model)
        for name, values in own.items():
            getattr(model, name)[:] = values[env] * (1.5 if name == "body_mass" and env == 1 else 1.0)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        for name, was in untouched.items():
            np.testing.assert_allclose(host(backend.field(name))[env], getattr(model, name), rtol=1e-5, err_msg=name)
            if env != 1:
                np.testing.assert_array_equal(host(backend.field(name))[env], was[env])


@ENGINES
def test_fields_start_compiled_and_randomisation_starts_from_what_was_set(
    build: Build, engine: tuple[str, ...]
) -> None:
    backend = build(2, *engine)
    of_mujoco = ("body_quat", "jnt_solref") if engine != PHYSX else ()
    for name in ("geom_friction", "dof_frictionloss", "opt.gravity", *of_mujoco):
        compiled = backend.compiled(name)
        np.testing.assert_array_equal(host(backend.field(name)), np.stack([host(compiled)] * 2), err_msg=name)
        np.testing.assert_array_equal(host(backend.nominal(name))[0], host(compiled))
    twice = 2.0 * backend.field("dof_frictionloss") + 1.0
    backend.rebase({"dof_frictionloss": twice})
    backend.field("dof_frictionloss").zero_()
    np.testing.assert_array_equal(host(backend.nominal("dof_frictionloss")), host(twice))
    assert backend.ids("body", ("trunk",)).tolist() == [1]


@ENGINES
def test_gravity_friction_and_forces_of_each_robot_act(build: Build, engine: tuple[str, ...]) -> None:
    """In free fall of one step: half gravity; dry friction holds a joint; a force accelerates the trunk."""
    backend = build(3, *engine)
    gravity, friction = backend.field("opt.gravity"), backend.field("dof_frictionloss")
    gravity[1] *= 0.5
    friction[2, 6:] = 3.0
    qpos, _ = initial(3, height=1.0)
    qpos[:, 3:7] = [1.0, 0.0, 0.0, 0.0]
    put(backend, everyone(backend), qpos, np.zeros((3, 18)))
    torque = torch.full((3, 12), 1.0, dtype=backend.qpos.dtype, device=backend.qpos.device)
    backend.step(0.0 * torque)
    fall = host(backend.qvel)[:, 2] / 0.002
    np.testing.assert_allclose(fall, [-9.81, -4.905, -9.81], rtol=1e-3)
    for _ in range(5):
        backend.step(torque)
    speed = np.abs(host(backend.qvel)[:, 6:])
    assert speed[2].max() < 0.02 < 0.3 < speed[0].min()
    backend.applied()[:, 0] = 10.0
    before = host(backend.qvel)[0, 0]
    backend.step(0.0 * torque)
    assert host(backend.qvel)[0, 0] > before + 0.0005


@OTHERS
@pytest.mark.parametrize("changes", [(), ("robot=go1_rotor_complete", "sim.physics_dt=0.004")], ids=["go1", "other"])
def test_the_robot_in_the_air_is_that_of_mujoco(
    build: Build, engine: tuple[str, ...], changes: tuple[str, ...]
) -> None:
    """What evaluation asks of an engine before it judges."""
    reference, judged = (build(agreement.robots_needed(), *each, *changes) for each in (CPU, engine))
    checks = agreement.compare(reference, judged)
    assert [str(check) for check in checks if not check.holds] == []
    assert {check.name for check in checks} == set(agreement.TOLERANCES)


# ---------------------------------------------------------------------- saving, and from one engine to another


@GROUNDS
@ENGINES
def test_a_saved_state_continues_in_another_batch(
    build: Build, engine: tuple[str, ...], ground: tuple[str, ...]
) -> None:
    """On MuJoCo bit for bit."""
    first, second = build(3, *engine, *ground), build(3, *engine, *ground)
    randomize(first, seed=1)
    put(first, everyone(first), *initial(3))
    drive(first, 50)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    randomize(second, seed=2)
    put(second, everyone(second), *initial(3, seed=4))
    second.load_state_dict(torch.load(file, weights_only=True))
    np.testing.assert_array_equal(host(first.qpos), host(second.qpos))
    for b in (first, second):
        drive(b, 30, start=50)
    tolerance = 0.0 if engine == CPU else 1e-3 if engine == PHYSX else 1e-5  # PhysX does not give away its contacts
    for name in ("qpos", "qvel", "sensordata") if engine == CPU else ("qpos",):
        np.testing.assert_allclose(host(getattr(first, name)), host(getattr(second, name)), rtol=0, atol=tolerance)
    for name in ("body_mass", "body_subtreemass", "body_invweight0", "dof_invweight0") if engine == CPU else ():
        np.testing.assert_array_equal(host(first.field(name)), host(second.field(name)))


@WARPS
@pytest.mark.parametrize("back", [False, True], ids=["to the cpu", "from the cpu"])
def test_a_state_saved_by_one_engine_continues_in_the_other(build: Build, engine: tuple[str, ...], back: bool) -> None:
    first, second = build(2, *engine), build(2, *CPU)
    if back:
        first, second = second, first
    randomize(first)
    for name in ("body_mass", "body_inertia", "body_ipos", "geom_friction"):
        second.field(name)  # as the same configuration would have made them
    put(first, everyone(first), *initial(2, height=0.6))
    drive(first, 50)
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    file.seek(0)
    second.load_state_dict(torch.load(file, weights_only=True, map_location="cpu"))
    for name in ("body_mass", "body_invweight0", "dof_invweight0"):
        np.testing.assert_allclose(host(second.field(name)), host(first.field(name)), rtol=1e-5, err_msg=name)
    for b in (first, second):
        drive(b, 20, start=50)
    np.testing.assert_allclose(host(first.qpos), host(second.qpos), atol=2e-5)


# ---------------------------------------------------------------------- how far apart


@WARPS
def test_the_engines_part_slowly_in_the_air_and_by_centimetres_on_the_ground_in_a_second(
    build: Build, engine: tuple[str, ...]
) -> None:
    """float32 against float64: 1e-5 in a second of flight; on the ground a foot lands a step earlier or later."""
    for height, bound in ((8.0, 2e-4), (robot.NOMINAL_HEIGHT, 0.15)):
        pair = build(8, *engine), build(8, *CPU)
        for backend in pair:
            qpos, qvel = initial(8, height)
            put(backend, everyone(backend), qpos, qvel)
            drive(backend, 500)
        apart = np.abs(host(pair[0].qpos) - host(pair[1].qpos))
        assert np.median(apart) < bound / 3
        assert np.percentile(apart, 95) < bound


@WARPS
def test_the_environment_is_the_same_on_both_engines(
    make_task: Callable[..., TaskConfig], engine: tuple[str, ...]
) -> None:
    """As long as feet land and leave at the same physics step; one that does not changes all that follows."""
    cores = [Go1Core(make_task(*overrides), 16, seed=1) for overrides in (engine, CPU)]
    seen = [core.reset() for core in cores]
    np.testing.assert_allclose(host(seen[0]), host(seen[1]), atol=1e-5)
    generator = torch.Generator().manual_seed(0)
    alike = np.ones(16, dtype=bool)
    for _ in range(8):
        action = 0.3 * torch.randn(16, 12, generator=generator)
        results = [core.step(action.to(core.device)) for core in cores]
        for name in ("foot_air_time", "foot_contact_time"):
            mine, theirs = (host(getattr(core.snapshot(), name)) for core in cores)
            alike &= (np.abs(mine - theirs) < 1e-4).all(axis=1)
        for name in ("observation", "reward", "final_observation"):
            mine, theirs = (host(getattr(r, name))[alike] for r in results)
            assert np.percentile(np.abs(mine - theirs), 95) < 2e-3, name
        for name in ("terminated", "truncated"):
            assert torch.equal(getattr(results[0], name).cpu(), getattr(results[1], name)), name
        for name, scale in (("foot_peak_force", 300.0), ("foot_touchdown_speed", 1.0)):
            mine, theirs = (host(getattr(core.snapshot(), name))[alike] for core in cores)
            assert np.percentile(np.abs(mine - theirs), 95) < 5e-3 * scale, name
    assert alike.sum() >= 8
    assert cores[0].drain_metrics(8)["physics/overflow"] == 0.0


@WARPS
def test_random_numbers_of_the_device_are_those_of_the_host_bit_for_bit(build: Build, engine: tuple[str, ...]) -> None:
    backend: Any = build(2, *engine)
    device = backend.qpos.device
    fast = EnvRandom(3, 50, first_env=7, device=device, units=backend.units)
    plain = EnvRandom(3, 50, first_env=7)
    for name in ("one", "other"):
        for count in (1, 7, 48):
            drawn, wanted = (r.stream(name).uniform(count, 2, low=-1.0) for r in (fast, plain))
            assert torch.equal(drawn.cpu(), wanted)


@needs_warp
@needs_gpu
@pytest.mark.gpu
def test_a_captured_step_is_the_step_and_leaves_no_trace_of_its_recording(make_task: Callable[..., TaskConfig]) -> None:
    captured, called = (Go1Core(make_task(*WARP_CUDA, f"backend.graph={g}"), 64, seed=1) for g in ("true", "false"))
    for core in (captured, called):
        core.reset()
    generator = torch.Generator("cuda").manual_seed(0)
    for step in range(12):
        action = 0.4 * torch.randn(64, 12, generator=generator, device="cuda")
        a, b = captured.step(action), called.step(action)
        np.testing.assert_allclose(host(a.observation), host(b.observation), atol=1e-3, err_msg=f"step {step}")
        np.testing.assert_allclose(host(a.reward), host(b.reward), atol=1e-4)
        assert torch.equal(a.episode_length, b.episode_length)
        impacts = (core.feet for core in (captured, called))
        mine, theirs = (torch.cat([i.peak_force / 300.0, i.touchdown_speed]) for i in impacts)
        np.testing.assert_allclose(host(mine), host(theirs), atol=0.02)
    assert host(captured.feet.touchdown_speed).max() > 0.0
    for name, stream in captured.random._streams.items():
        assert torch.equal(stream.counter, called.random.stream(name).counter), name


def test_without_its_packages_or_a_gpu_warp_says_what_to_do(build: Build, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(Exception, match=r"pip install 'go1exp\[gpu\]'|torch finds no CUDA device; use backend=cpu"):
        build(1, *WARP_CUDA)
