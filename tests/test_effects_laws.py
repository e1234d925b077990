"""The law of each effect: against a slow version with another way of reckoning, and where its answer is known.

The robot hangs in the air. In the experiments on one joint the front right calf moves, weightless, and the other joints
keep still, so that it is a mass on an axle.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.signal import lsim
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.compose import compose
from go1exp.config.schema.registry import Term, bind, members
from go1exp.deploy.runtime import go1_wire
from go1exp.robot.actuators import ActuatorSetup
from go1exp.robot.messages import LowCmd
from go1exp.sim.effects.base import Effect
from go1exp.sim.effects.stack import EffectStack
from go1exp.sim.env.plant import Plant, actuator_setup
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import MANY_TERMS, TaskConfig, parse_task
from go1exp.sim.terrain import build_terrain
from tests.small_run import plain

DT = 0.002
CALF = robot.JOINTS.index("FR_calf")
STANCE = torch.as_tensor(robot.NOMINAL_STANCE, dtype=torch.float64).unsqueeze(0)

Values = Mapping[str, Any]
Slow = Callable[..., float]


@cache
def task() -> TaskConfig:
    return parse_task(compose("train", plain("backend.threads=1")))


def term(group: str, name: str, values: Values) -> Term:
    bound, problems = bind(group, name, values, name, MANY_TERMS.get(group))
    assert bound, problems
    return bound


def stand(
    effects: Mapping[str, Values],
    *,
    dt: float = DT,
    gravity: bool = False,
    change: Callable[[mujoco.MjModel], None] = lambda m: None,
    q: Tensor = STANCE,
    qd: Tensor | None = None,
    kp: float = 20.0,
    kd: float = 0.5,
) -> Plant:
    """Hang up one robot with effects, by default weightless; ``change`` alters its model."""
    model, sensors = build_model(task().robot, build_terrain(task().terrain), dt, held=(1.0, 0.0, 0.0, 0.0))
    if not gravity:
        model.opt.gravity[:] = 0.0
    change(model)
    backend = MujocoCpu(model, sensors, 1, 1)
    setup = actuator_setup(task().robot, dt, backend, EnvRandom(0, 1))
    drive = term("actuator", "pd", {"kp": kp, "kd": kd})
    plant = Plant(backend, setup, drive, [term("effect", n, v) for n, v in effects.items()])
    plant.startup()
    backend.reset(torch.tensor([True]), q, torch.zeros_like(q) if qd is None else qd)
    plant.reset(torch.tensor([True]), q)
    return plant


# ---------------------------------------------------------------------- against slow versions


def slow_limit(tau: float, qd: float, effort: float, top: float, peak: float, droop: float, stall: float) -> float:
    """Stay within peak and line, by cases."""
    if (peak, droop) == (1.0, 0.0):
        return tau
    forward = math.inf if droop == 0.0 else peak * effort * stall * (1.0 - qd * droop / top)
    backward = math.inf if droop == 0.0 else peak * effort * stall * (1.0 + qd * droop / top)
    most, least = peak * effort, -peak * effort
    if forward < most:
        most = forward if forward > -peak * effort else -peak * effort
    if -backward > least:
        least = -backward if -backward < peak * effort else peak * effort
    return most if tau > most else least if tau < least else tau


INSTANT: dict[str, dict[str, Slow]] = {
    "viscous": {"on_joint": lambda e, q, qd: -e["damping"] * qd},
    "quadratic_drag": {"on_joint": lambda e, q, qd: -math.copysign(e["drag"] * qd**2, qd)},
    "parallel_stiffness": {"on_joint": lambda e, q, qd: e["stiffness"] * e["rest"] - e["stiffness"] * q},
    "cogging": {"on_joint": lambda e, q, qd: e["amplitude"] * math.sin(e["count"] * q + e["phase"])},
    "stribeck": {
        "on_friction": lambda e, b, tau, qd: (
            b + e["strength"] * math.exp(-math.exp(e["exponent"] * (math.log(abs(qd)) - math.log(e["speed"]))))
        )
    },
    "load_friction": {
        "on_load": lambda e, b, tau, out: (
            b
            + max(e["coefficient"] * tau, e["coefficient"] * e["external"] * out)
            - min(e["coefficient"] * tau, e["coefficient"] * e["external"] * out)
        )
    },
    "asymmetric_friction": {
        "on_joint": lambda e, q, qd: (e["backward"] - e["forward"]) / 2,
        "on_friction": lambda e, b, tau, qd: b + (e["backward"] + e["forward"]) / 2,
    },
    "strength": {"on_actuator": lambda e, tau, q, qd: e["scale"] * tau},
    "torque_speed_limit": {
        "on_actuator": lambda e, tau, q, qd: slow_limit(tau, qd, e["E"], e["V"], e["peak"], e["droop"], e["stall"])
    },
    "kp_scale": {"on_gains": lambda e, kp, kd: e["scale"] * kp},
    "kd_scale": {"on_gains": lambda e, kp, kd: e["scale"] * kd},
    "dead_band": {"on_error": lambda e, target, q: q if abs(target - q) <= e["band"] and e["band"] else target},
    "encoder_offset": {"on_encoder": lambda e, q, qd: q + e["offset"]},
}
"""By effect and hook: value for one joint at one instant, from its parameters and the hook's arguments."""


def scatter(effect: Effect, seed: int) -> None:
    """Give every robot and joint values of its own, some of them null, some at a bound."""
    generator = torch.Generator().manual_seed(seed)
    for p in effect.params:
        live = getattr(effect, p.name)
        live.copy_(p.low + (p.high - p.low) * torch.rand(live.shape, dtype=live.dtype, generator=generator))
        live[0], live[1], live[2] = p.null, p.low, p.high
    effect.prepare()


def noise(n: int, scale: float, seed: int) -> Tensor:
    return scale * torch.randn(n, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", INSTANT)
def test_a_law_without_memory_agrees_with_one_reckoned_joint_by_joint(
    name: str, drives: Callable[..., ActuatorSetup]
) -> None:
    setup = drives(8)
    effect = term("effect", name, {})(setup)
    scatter(effect, 1)
    q, qd, torque = noise(8, 2.0, 2), noise(8, 15.0, 3), noise(8, 25.0, 4)
    arguments = {
        "on_joint": (q, qd),
        "on_friction": (q.abs(), torque, qd),
        "on_load": (q.abs(), torque, 10.0 * q),
        "on_actuator": (torque, q, qd),
        "on_gains": (q.abs(), qd.abs()),
        "on_encoder": (q, qd),
        "on_error": (q + 0.002 * qd, q),
    }
    for hook, slow in INSTANT[name].items():
        given = arguments[hook]
        found = getattr(effect, hook)(*given)
        if isinstance(found, tuple):
            changed, kept = (1, 0) if name == "kd_scale" else (0, 1)
            assert torch.equal(found[kept], given[kept])
            found = found[changed]
        for i in range(8):
            for j in range(12):
                own = {p.name: float(getattr(effect, p.name)[i, j]) for p in effect.params}
                own |= {"E": float(setup.effort_limit[j]), "V": float(setup.velocity_limit[j])}
                expected = slow(own, *(float(x[i, j]) for x in given))
                assert float(found[i, j]) == pytest.approx(expected, rel=1e-12, abs=1e-12), (i, j, own)


def drive(effect: Effect, demand: Tensor) -> Tensor:
    """Let torques (T, N, J) through an effect."""
    still = torch.zeros_like(demand[0])
    return torch.stack([effect.on_actuator(tau, still, still) for tau in demand])


def demands(steps: int, n: int) -> Tensor:
    return torch.stack([noise(n, 5.0, 100 + k) for k in range(steps)])


def test_lag_agrees_with_scipys_solution_for_linear_pieces(drives: Callable[..., ActuatorSetup]) -> None:
    effect = term("effect", "lag", {})(drives(4))
    scatter(effect, 5)
    demand = demands(60, 4)
    found = drive(effect, demand)
    t = DT * np.arange(60)
    for i in range(4):
        for j in range(12):
            constant, u = float(effect.time[i, j]), demand[:, i, j].numpy()
            expected = u if constant == 0.0 else lsim(([1.0], [constant, 1.0]), u, t, X0=[constant * u[0]])[1]
            np.testing.assert_allclose(found[:, i, j], expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "hook"),
    [("torque_delay", "on_actuator"), ("command_delay", "on_target"), ("command_delay", "on_feedforward")],
)
def test_a_delay_agrees_with_interpolation_in_the_past(
    name: str, hook: str, drives: Callable[..., ActuatorSetup]
) -> None:
    effect = term("effect", name, {})(drives(5))
    scatter(effect, 6)
    demand = demands(60, 5)
    still = torch.zeros_like(demand[0])
    more = (still, still) if hook == "on_actuator" else ()
    found = torch.stack([getattr(effect, hook)(x, *more) for x in demand])
    t = DT * np.arange(60)
    for i in range(5):
        for j in range(12):
            expected = np.interp(t - float(effect.delay[i, j]), t, demand[:, i, j])
            np.testing.assert_allclose(found[:, i, j], expected, rtol=0, atol=1e-10)


def test_strength_drift_agrees_with_a_clock_of_its_own(drives: Callable[..., ActuatorSetup]) -> None:
    effect = term("effect", "strength_drift", {})(drives(5))
    scatter(effect, 7)
    effect.rate.mul_(50.0)  # so that some reach their floor within the test
    found = drive(effect, demands(60, 5))
    for k, demand in enumerate(demands(60, 5)):
        for i in range(5):
            for j in range(12):
                left = 1.0 - float(effect.rate[i, j]) * (k * DT)
                share = left if left > float(effect.floor[i, j]) else float(effect.floor[i, j])
                assert float(found[k, i, j]) == pytest.approx(share * float(demand[i, j]), rel=1e-12)


def test_coulomb_raises_the_bound_that_the_model_has() -> None:
    def rough(model: mujoco.MjModel) -> None:
        model.dof_frictionloss[:] = 0.2

    plant = stand({"coulomb": {"bound": {"calf": 0.4, "FR_hip": 0.1}}}, change=rough)
    for _ in range(2):
        bound = plant.backend.field("dof_frictionloss")[0].tolist()
        assert bound == pytest.approx([0.3, 0.2, 0.6] + [0.2, 0.2, 0.6] * 3)
        plant.step(STANCE)


def test_bounds_of_dry_friction_add_up() -> None:
    plant = stand(
        {
            "coulomb": {"bound": 0.4},
            "stribeck": {"strength": 0.3},
            "asymmetric_friction": {"forward": 0.2, "backward": 0.1},
            "load_friction": {"coefficient": 0.1},
        }
    )
    plant.step(STANCE + 0.1)  # half of the step counts in the first: 20 x 0.05 = 1 N m
    assert plant.torque[0].tolist() == pytest.approx([1.0] * 12)
    assert plant.backend.field("dof_frictionloss")[0].tolist() == pytest.approx([0.4 + 0.3 + 0.15 + 0.1] * 12)
    assert plant.backend.applied()[0].tolist() == pytest.approx([-0.05] * 12)


# ---------------------------------------------------------------------- known answers


def test_lag_vanishes_smoothly(drives: Callable[..., ActuatorSetup]) -> None:
    demand = demands(50, 1)
    change = float(demand.diff(dim=0).abs().max()) / DT
    apart = []
    for constant in (0.0, 1e-12, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3):
        found = drive(term("effect", "lag", {"time": constant})(drives(1)), demand)
        apart.append(float((found - demand).abs().max()))
        assert apart[-1] <= constant * change + 1e-12
    assert apart[0] == 0.0
    assert apart == sorted(apart)


def test_an_absent_lag_remembers_nothing_not_even_what_is_not_finite(drives: Callable[..., ActuatorSetup]) -> None:
    demand = demands(5, 1)
    demand[1] = math.nan
    found = drive(term("effect", "lag", {})(drives(1)), demand)
    assert torch.equal(found[2:], demand[2:])


def test_torque_speed_limit_without_limit_lets_pass_what_exceeds_the_peak(drives: Callable[..., ActuatorSetup]) -> None:
    demand = noise(3, 40.0, 0)
    effect = term("effect", "torque_speed_limit", {"stall": 2.0})(drives(3))
    assert torch.equal(effect.on_actuator(demand, demand, noise(3, 40.0, 1)), demand)


def test_the_limit_comes_last_in_whatever_order_effects_are_named() -> None:
    limited, strong = {"torque_speed_limit": {"peak": 0.5}}, {"strength": {"scale": 1.5}}
    for effects in ({**limited, **strong}, {**strong, **limited}):
        plant = stand(effects)
        plant.step(STANCE + 2.0)  # half of it counts in this step: 20 N m
        assert plant.torque[0, :3].tolist() == pytest.approx([0.5 * 23.7, 0.5 * 23.7, 0.5 * 35.55])


# ---------------------------------------------------------------------- one and the same motion


def swing(plant: Plant, dt: float, seconds: float, shift: float = 0.0, late: int = 0) -> Tensor:
    """Follow smooth targets that begin at rest; return the true angles (T, 12), every 2 ms."""
    every, phase = round(DT / dt), torch.arange(12, dtype=torch.float64)
    angles = []
    for k in range(round(seconds / dt)):
        t = max(k - late + 0.5, 0.0) * dt  # the middle of the step in which the target is in force
        size = min(t / 0.1, 1.0) ** 3 * (4.0 - 3.0 * min(t / 0.1, 1.0))
        plant.step(STANCE + shift + 0.3 * size * torch.sin(2.0 * math.pi * 3.0 * t + phase))
        if (k + 1) % every == 0:
            angles.append(plant.q[0].clone())
    return torch.stack(angles)


def apart(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().max())


def spring(model: mujoco.MjModel) -> None:
    model.jnt_stiffness[:] = 4.0
    model.qpos_spring[:] = np.tile([0.1, 0.7, -1.4], 4)


@pytest.mark.parametrize(
    ("effect", "values", "other"),
    [
        ("kp_scale", {"scale": 1.3}, {"kp": 26.0}),
        ("kd_scale", {"scale": 1.5}, {"kd": 0.75}),
        ("strength", {"scale": 1.2}, {"kp": 24.0, "kd": 0.6}),  # no drive saturates
        ("viscous", {"damping": 0.3}, {"kd": 0.8}),
        ("parallel_stiffness", {"stiffness": 4.0, "rest": [0.1, 0.7, -1.4]}, {"change": spring}),
    ],
)
def test_an_effect_is_another_robot_without_it(effect: str, values: Values, other: dict[str, Any]) -> None:
    found = swing(stand({effect: values}), DT, 0.2)
    assert apart(found, swing(stand({}, **other), DT, 0.2)) < 1e-12
    assert apart(found, swing(stand({}), DT, 0.2)) > 0.005


REMEMBERING: dict[str, Values] = {
    "command_delay": {"delay": 0.009},
    "torque_delay": {"delay": 0.005},
    "lag": {"time": 0.006},
    "strength_drift": {"rate": 0.2},
    "load_friction": {"coefficient": 0.1, "external": 1.0},
    "flexibility": {"compliance": 0.004},
    "backlash": {"gap": 0.01},
}
"""Effects with a past."""


def remembers(effect: Any) -> bool:
    """Whether it has a state beside the values of its parameters."""
    return len(effect.memory) > len(effect.params) or effect.state_dict is not Effect.state_dict


def test_effects_go_on_from_a_saved_state_bit_for_bit_and_begin_anew_at_a_reset() -> None:
    assert {name for name, entry in members("effect").items() if remembers(entry.target)} <= set(REMEMBERING)
    plant, other = stand(REMEMBERING), stand(REMEMBERING)
    first = swing(plant, DT, 0.1)
    state, engine = deepcopy(plant.state_dict()), deepcopy(plant.backend.state_dict())
    second = swing(plant, DT, 0.1)
    swing(other, DT, 0.03)
    other.load_state_dict(state)
    other.backend.load_state_dict(engine)
    assert torch.equal(swing(other, DT, 0.1), second)
    everyone = torch.tensor([True])
    plant.backend.reset(everyone, STANCE, torch.zeros_like(STANCE))
    plant.reset(everyone, STANCE)
    assert torch.equal(swing(plant, DT, 0.1), first)


def test_a_spread_is_even_about_what_is_given_and_stays_within_the_bounds(drives: Callable[..., ActuatorSetup]) -> None:
    calf, n = {"calf": 0.3}, 2000

    def drawn(name: str, values: Values, half: float) -> np.ndarray:
        (key,) = values or ("scale",)
        of_robots = EffectStack(
            [dataclasses.replace(term("effect", name, values), slots={"spread": {key: half}})], drives(n)
        )
        of_robots.draw()
        return np.asarray(getattr(of_robots.effects[name], key))

    bound = drawn("coulomb", {"bound": calf}, 0.1)
    assert not np.delete(bound, np.s_[2::3], axis=1).any()  # at the joints that are not named there is none
    for found, low, high in (
        (bound[:, 2::3], 0.2, 0.4),
        (drawn("strength", {}, 0.2), 0.8, 1.2),
        (drawn("foot_friction", {"scale": 0.7}, 0.3), 0.4, 1.0),
    ):
        quarters = np.quantile(found, [0.0, 0.25, 0.5, 0.75, 1.0])
        np.testing.assert_allclose(quarters, np.linspace(low, high, 5), atol=0.05 * (high - low))
        assert low <= found.min() < found.max() <= high
        assert len(np.unique(found)) > 0.99 * found.size
    assert (drawn("viscous", {"damping": 0.05}, 0.1) == 0.0).mean() == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("steps", [1.0, 3.0])
def test_fixed_point_cuts_gains_and_torques_as_the_go1s_packets_do(
    steps: float, drives: Callable[..., ActuatorSetup]
) -> None:
    setup = drives(1)
    law = term("effect", "fixed_point", {"steps": steps})(setup)
    gains, torque = setup.zeros() + 2.35, setup.zeros() - 2.35
    kp, kd = law.on_gains(gains, gains)
    cut = [float(values[0, 0]) for values in (kp, kd, law.on_feedforward(torque))]
    # the same numbers through a packet, in units of the coarser steps
    packet = LowCmd(np.zeros(12), *(np.full(12, 2.35 / steps),) * 2, feedforward=np.full(12, -2.35 / steps))
    asked = go1_wire.unpack_command(go1_wire.pack_command(packet))
    assert isinstance(asked, go1_wire.MotorCommand)
    assert cut == pytest.approx([steps * values[0] for values in (asked.kp, asked.kd, asked.tau)], abs=1e-12)
    assert cut[1] < 2.35 < 2.35 + cut[1] - cut[2]
    assert torch.equal(law.on_report(torque), law.on_feedforward(torque))  # the same field both ways


def test_fixed_point_cuts_what_the_drives_report_and_not_what_they_make() -> None:
    plant, plain = stand({"fixed_point": {"steps": 1.0}}), stand({})  # kp = 20 and kd = 0.5 are whole steps
    for one in (plant, plain):
        one.step(STANCE + 0.0123)
    assert torch.equal(plant.torque, plain.torque)
    made, reported = plain.torque[0].tolist(), plant.reported_torque()[0].tolist()
    assert reported == [math.copysign(math.floor(abs(value) * 256) / 256, value) for value in made]
    assert any(a != b for a, b in zip(made, reported, strict=True))
    assert torch.equal(plain.reported_torque(), plain.torque)


def test_a_delay_of_whole_steps_is_the_targets_of_these_steps_ago() -> None:
    delayed, plain = stand({"command_delay": {"delay": 0.01}}), stand({})
    for plant in (delayed, plain):
        plant.step(STANCE)
    assert torch.equal(swing(delayed, DT, 0.2), swing(plain, DT, 0.2, late=5))


def test_a_drive_that_comes_on_makes_its_torque_as_late_as_ever() -> None:
    plant = stand({"lag": {"time": 0.005}})
    plant.enabled = torch.tensor([False])
    for _ in range(5):
        plant.step(STANCE + 0.1)
        assert torch.count_nonzero(plant.torque) == 0
    made = []
    plant.enabled = torch.tensor([True])
    for _ in range(5):
        plain = stand({})
        plain.backend.reset(torch.tensor([True]), plant.q.clone(), plant.qd.clone())
        plain.reset(torch.tensor([True]), STANCE + 0.1)
        plain.step(STANCE + 0.1)
        plant.step(STANCE + 0.1)
        made.append(float(plant.torque[0, CALF] / plain.torque[0, CALF]))
    t = DT * np.arange(6)
    _, risen, _ = lsim(([1.0], [0.005, 1.0]), np.minimum(t / DT, 1.0), t)
    np.testing.assert_allclose(made, risen[1:], rtol=0, atol=0.05)  # the joint moves, so that the demand falls


def test_an_encoder_with_an_offset_is_a_target_with_the_opposite_one() -> None:
    found = swing(stand({"encoder_offset": {"offset": 0.02}}), DT, 0.2)
    assert apart(found, swing(stand({}), DT, 0.2, shift=-0.02)) > 1e-4  # it began there already: see reset
    plant = stand({"encoder_offset": {"offset": 0.02}}, kp=50.0, kd=3.0)
    for _ in range(600):
        plant.step(STANCE)
    assert apart(plant.q, STANCE - 0.02) < 1e-6
    assert apart(plant.effects.on_encoder(plant.q, plant.qd)[0], STANCE) < 1e-6


def lock(model: mujoco.MjModel) -> None:
    """Hold all joints but the calf by rotors without measure.

    MuJoCo reckons the joints' inertial torques on each other with speeds of half a step ago, which is first order and
    no effect's doing.
    """
    model.dof_armature[np.arange(robot.NUM_JOINTS) != CALF] = 1e9


SMOOTH: dict[str, Values] = {
    "viscous": {"damping": 0.3},
    "quadratic_drag": {"drag": 0.03},
    "parallel_stiffness": {"stiffness": 5.0, "rest": [0.0, 0.0, 0.0]},
    "cogging": {"amplitude": 0.3},
    "lag": {"time": 0.006},
    "torque_delay": {"delay": 0.005},
    "command_delay": {"delay": 0.009},
    "strength_drift": {"rate": 0.2, "floor": 0.1},
}


@pytest.mark.parametrize("name", SMOOTH)
def test_half_the_step_is_a_quarter_of_the_error(name: str) -> None:
    """Second order, and 2 ms are near enough: 0.5 mrad is the noise of an encoder."""
    runs = {}
    for dt in (0.002, 0.001, 0.00025):
        plant = stand({name: SMOOTH[name]}, dt=dt, change=lock)
        values = plant.effects.effects[name].state_dict()
        if name == "parallel_stiffness":
            values["rest"] = STANCE  # no torque at the start: a jump of acceleration would be first order by itself
        if name == "cogging":
            values["phase"] = -values["count"] * STANCE
        plant.effects.effects[name].load_state_dict(values)
        runs[dt] = swing(plant, dt, 0.2)
    coarse, fine = (apart(runs[dt], runs[0.00025]) for dt in (0.002, 0.001))
    assert coarse < 5e-4
    assert coarse / fine > 3.5  # against a run at 1/8: 63/15 = 4.2
    assert apart(runs[0.002], swing(stand({}, change=lock), DT, 0.2)) > 2e-3


# ---------------------------------------------------------------------- dry friction on one joint


def sweep(effects: Mapping[str, Values], speed: float, seconds: float = 0.2) -> float:
    """Return the torque with which the drive moves the calf steadily, N m."""
    q, qd = STANCE.clone(), torch.zeros_like(STANCE)
    q[0, CALF] = -1.8 - 0.5 * seconds * speed
    qd[0, CALF] = speed
    plant = stand(effects, q=q, qd=qd, kp=60.0, kd=2.0)
    target = q.clone()
    for k in range(round(seconds / DT)):
        target[0, CALF] = q[0, CALF] + speed * DT * (k + 0.5)
        plant.step(target)
    assert float(plant.speed()[0, CALF]) == pytest.approx(speed, rel=2e-3)
    return float(plant.torque[0, CALF])


@pytest.mark.parametrize(
    ("effects", "speed", "torque"),
    [
        ({"coulomb": {"bound": 0.4}}, 1.0, 0.4),
        ({"coulomb": {"bound": 0.4}}, -1.0, -0.4),
        ({"viscous": {"damping": 0.1}}, 5.0, 0.5),
        ({"quadratic_drag": {"drag": 0.02}}, 5.0, 0.5),
        ({"quadratic_drag": {"drag": 0.02}}, -5.0, -0.5),
        ({"stribeck": {"strength": 0.3, "speed": 1.0}}, 0.5, 0.3 * math.exp(-0.25)),
        ({"stribeck": {"strength": 0.3, "speed": 1.0, "exponent": 1.0}}, -2.0, -0.3 * math.exp(-2.0)),
        ({"asymmetric_friction": {"forward": 0.4, "backward": 0.1}}, 1.0, 0.4),
        ({"asymmetric_friction": {"forward": 0.4, "backward": 0.1}}, -1.0, -0.1),
        ({"coulomb": {"bound": 0.4}, "load_friction": {"coefficient": 0.2}}, 1.0, 0.4 / (1.0 - 0.2)),
        ({"coulomb": {"bound": 0.2}, "viscous": {"damping": 0.1}, "stribeck": {"strength": 0.3}}, 2.0, 0.4),
    ],
)
def test_a_drive_makes_up_for_friction_in_steady_motion(
    effects: Mapping[str, Values], speed: float, torque: float
) -> None:
    assert sweep(effects, speed) == pytest.approx(torque, rel=5e-3, abs=5e-4)


@pytest.mark.parametrize(
    ("effects", "breaking"),
    [
        ({"coulomb": {"bound": 0.4}}, 0.4),
        ({"coulomb": {"bound": 0.3}, "stribeck": {"strength": 0.2, "speed": 0.1}}, 0.5),
        ({"asymmetric_friction": {"forward": 0.5, "backward": 0.1}}, 0.5),
        ({"coulomb": {"bound": 0.4}, "load_friction": {"coefficient": 0.2}}, 0.5),
    ],
)
def test_a_joint_sticks_until_the_drive_overcomes_its_friction(effects: Mapping[str, Values], breaking: float) -> None:
    plant = stand(effects)
    moved, torque = [], []
    for k in range(300):
        target = STANCE.clone()
        target[0, CALF] += 0.05 * DT * (k + 0.5)  # 1 N m/s
        plant.step(target)
        moved.append(abs(float(plant.q[0, CALF] - STANCE[0, CALF])))
        torque.append(float(plant.torque[0, CALF]))
    loose = next(k for k, m in enumerate(moved) if m > 1e-5)
    assert torque[loose] == pytest.approx(breaking, rel=0.02)
    assert moved[-1] > 2e-3


@pytest.mark.parametrize("load", [0.0, 0.3], ids=["dry", "loaded"])
@pytest.mark.parametrize("share", [0.5, 0.9, 1.1, 2.0])
def test_a_weight_on_a_rough_axle_sticks_or_slips(share: float, load: float) -> None:
    """Coulomb's block on a slope: drives off, gravity pulls the calf, the other joints are held by theirs.

    Of the friction, which is a share of the weight's torque, ``load`` is that of the gears that this torque loads.
    """
    q = STANCE.clone()
    q[0, CALF] = -2.0
    reference = stand({}, gravity=True, q=q).backend
    model, data = reference.model, mujoco.MjData(reference.model)
    data.qpos[:] = q[0]
    mujoco.mj_forward(model, data)
    weight, column = -float(data.qfrc_bias[CALF]), np.zeros(model.nv)
    mujoco.mj_mulM(model, data, column, np.eye(model.nv)[CALF])
    bound = {"hip": 3.0, "thigh": 3.0, "calf": 3.0, "FR_calf": (share - load) * abs(weight)}
    gears = {"coefficient": {"FR_calf": 0.5}, "external": 2.0 * load}
    plant = stand({"coulomb": {"bound": bound}, "load_friction": gears}, gravity=True, q=q, kp=0.0, kd=0.0)
    steps = 10
    for _ in range(steps):
        plant.step(q)
    others = torch.arange(12) != CALF
    assert float((plant.q - q)[0, others].abs().max()) < 1e-6
    if share > 1.0:
        for _ in range(490):
            plant.step(q)
        assert abs(float(plant.q[0, CALF] - q[0, CALF])) < 1e-3
    else:
        speed = (1.0 - share) * weight / column[CALF] * steps * DT
        assert float(plant.qd[0, CALF]) == pytest.approx(speed, rel=0.05)


@pytest.mark.parametrize(("external", "load"), [(0.0, 1.0), (1.0, 2.0), (0.4, 1.4)])
def test_a_weight_that_is_held_loads_the_gears_from_both_sides(external: float, load: float) -> None:
    """BAM's |motor torque - external torque|: a weight w that the drive holds counts as w + external w."""
    plant = stand({"load_friction": {"coefficient": 1e-3, "external": external}}, gravity=True, kp=300.0, kd=5.0)
    for _ in range(500):
        plant.step(STANCE)
    weight = plant.backend.bias()[0].abs()
    assert weight[2::3].min() > 0.1
    bound = plant.backend.field("dof_frictionloss")[0]
    assert bound[2::3].tolist() == pytest.approx((1e-3 * load * weight[2::3]).tolist(), rel=0.01)


def test_without_a_share_from_outside_the_gears_feel_the_drive_alone_bit_for_bit(
    drives: Callable[..., ActuatorSetup],
) -> None:
    effect: Any = term("effect", "load_friction", {"coefficient": 0.13})(drives(8))
    bound, torque, outside = noise(8, 1.0, 5).abs(), noise(8, 25.0, 6), noise(8, 9.0, 7)
    assert torch.equal(effect.on_load(bound, torque, outside), bound + effect.coefficient * torque.abs())


def test_a_swing_without_a_drive_loses_what_the_loaded_gears_take() -> None:
    """The calf falls from 1.2 rad beside the vertical; SciPy integrates I qdd = weight - friction of the weight."""
    q = STANCE.clone()
    q[0, CALF] = -2.6
    gears = {"coefficient": {"FR_calf": 0.3}, "external": 1.0}
    others = {"hip": 3.0, "thigh": 3.0, "calf": 3.0, "FR_calf": 0.0}
    plant = stand({"coulomb": {"bound": others}, "load_friction": gears}, gravity=True, q=q, kp=0.0, kd=0.0, dt=0.001)
    model = plant.backend.model
    data, column = mujoco.MjData(model), np.zeros(model.nv)
    data.qpos[:] = q[0]
    mujoco.mj_forward(model, data)
    mujoco.mj_mulM(model, data, column, np.eye(model.nv)[CALF])

    def slopes(_: float, state: np.ndarray) -> list[float]:
        data.qpos[CALF], data.qvel[CALF] = state
        mujoco.mj_forward(model, data)
        weight = -data.qfrc_bias[CALF]
        return [state[1], (weight - 0.3 * abs(weight) * np.sign(state[1])) / column[CALF]]

    found = []
    for _ in range(150):
        plant.step(q)
        found.append(float(plant.q[0, CALF]))
    expected = solve_ivp(slopes, (0.0, 0.15), [-2.6, 0.0], rtol=1e-8, atol=1e-10, first_step=1e-4).y[0, -1]
    free = stand({"coulomb": {"bound": others}}, gravity=True, q=q, kp=0.0, kd=0.0, dt=0.001)
    for _ in range(150):
        free.step(q)
    assert abs(expected + 2.6) > 0.1
    assert abs(float(free.q[0, CALF]) - expected) > 0.05
    assert found[-1] == pytest.approx(expected, abs=1e-3)
