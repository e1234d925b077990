"""What actuators and effects promise."""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from typing import Any

import torch
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.compose import compose
from go1exp.config.schema.joint_values import numbers
from go1exp.config.schema.registry import ConfigError, Entry, Term, bind
from go1exp.extend.testing.description import ALONE, CONTINUES, MASKED, checked, equal, expect
from go1exp.robot.actuators import ActuatorSetup
from go1exp.sim.actuator.motors import Actuator
from go1exp.sim.effects.base import Effect
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import MANY_TERMS, TaskConfig, parse_task

PHYSICS_DT = 0.002


def go1_actuators(n: int, first_env: int = 0, **changes: Any) -> ActuatorSetup:
    """Describe the actuators of n Go1 robots at 2 ms; keyword arguments change that."""

    def per_joint(values: tuple[float, float, float]) -> Tensor:
        return torch.as_tensor(robot.per_joint(values))

    usual: dict[str, Any] = {
        "num_envs": n,
        "physics_dt": PHYSICS_DT,
        "joints": robot.JOINTS,
        "effort_limit": per_joint(robot.EFFORT_LIMIT),
        "velocity_limit": per_joint(robot.VELOCITY_LIMIT),
        "armature": per_joint(robot.ROTOR_ARMATURE),
        "random": EnvRandom(0, n, first_env),
        "device": torch.device("cpu"),
        "dtype": torch.float64,
    }
    return ActuatorSetup(**{**usual, **changes})


def _noise(n: int, scale: float, seed: int) -> Tensor:
    """Return (n, 12) of random numbers, whose first rows do not depend on n."""
    generators = [torch.Generator().manual_seed(1000 * seed + i) for i in range(n)]
    return scale * torch.stack([torch.randn(12, dtype=torch.float64, generator=g) for g in generators])


def _moment(n: int, k: int, size: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Return target, angle and speed (n, 12) at step k."""
    return _noise(n, 0.3 * size, 3 * k), _noise(n, 0.3 * size, 3 * k + 1), _noise(n, 3.0 * size, 3 * k + 2)


def check_actuator(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """Torques within the limit; the same alone and in a batch; begins an episode anew; continues from its state."""
    values = checked(entry, parameters)

    def make(n: int, first: int = 0) -> Actuator:
        made: Actuator = entry.target(go1_actuators(n, first), **values)
        made.reset(torch.ones(n, dtype=torch.bool))
        return made

    batch, alone = make(5), make(1, 3)
    limit = go1_actuators(1).effort_limit
    within = f"torques must stay within {limit.tolist()[:3]} N m"
    one, fresh = make(5), make(5)
    for k in range(30):
        inputs = _moment(5, k, size=10.0 if k % 10 == 9 else 1.0)
        copies = [x.clone() for x in inputs]
        torque = batch.torque(*inputs).clone()
        expect(entry, torque.shape == (5, 12) and torque.dtype == torch.float64, "torques must be (N, J) as its inputs")
        expect(entry, torch.isfinite(torque).all(), "torques must be finite")
        expect(entry, bool((torque.abs() <= limit).all()), within)
        expect(
            entry, all(torch.equal(a, b) for a, b in zip(inputs, copies, strict=True)), "it must not write its inputs"
        )
        expect(entry, equal(alone.torque(*(x[3:4] for x in inputs)), torque[3:4], exact), ALONE)
        if k < 20:
            expect(entry, torch.equal(one.torque(*inputs), torque), "it must do the same with the same inputs")
        if k == 19:
            fresh.load_state_dict(one.state_dict())
            one.reset(torch.arange(5) < 2)
        if k >= 20:
            expect(entry, torch.equal(fresh.torque(*inputs), torque), CONTINUES)
            expect(entry, torch.equal(one.torque(*inputs)[2:], torque[2:]), MASKED)


# ---------------------------------------------------------------------- effects


def kind(entry: Entry) -> type[Effect]:
    """Return the class of an effect."""
    expect(entry, isinstance(entry.target, type) and issubclass(entry.target, Effect), "an effect is a class of Effect")
    target: type[Effect] = entry.target  # type: ignore[assignment]
    return target


@cache
def _task() -> TaskConfig:
    return parse_task(compose("train", ["backend.threads=1", "sim.episode_s=0.16"]))


def _core(effects: tuple[Term, ...], n: int, first_env: int = 0) -> Go1Core:
    return Go1Core(dataclasses.replace(_task(), effect=effects), n, seed=5, first_env=first_env, noise=False)


def _action(n: int, k: int, first_env: int = 0) -> Tensor:
    row = torch.arange(first_env, first_env + n).unsqueeze(1)
    return 4.0 * torch.sin(0.9 * k + torch.arange(12.0) + 0.7 * row)


def _run(core: Go1Core, steps: int, first_step: int = 0) -> list[Tensor]:
    """Let robots tumble through short episodes; return what they and their sensors did."""
    read = []
    for k in range(first_step, first_step + steps):
        result = core.step(_action(core.num_envs, k, core.random.first_env))
        read += [
            result.observation.clone(),
            result.reward.clone(),
            core.backend.qpos.clone(),
            core.plant.torque.clone(),
        ]
    return read


@cache
def _plain(steps: int) -> list[Tensor]:
    core = _core((), 2)
    core.reset()
    return _run(core, steps)


def _bound(entry: Entry, values: dict[str, object]) -> Term:
    term, problems = bind("effect", entry.name, values, f"effect.{entry.name}", MANY_TERMS["effect"])
    if term is None:
        raise ConfigError(problems)
    return term


def check_effect(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """Parameters with units and bounds; no effect at its null values; a state that is saved and restored.

    Parameters other than the null ones are needed for the rest: by default five tolerances, as far as the bounds go.
    """
    params = kind(entry).params
    sizes = [p for p in params if p.tolerance != math.inf]
    expect(entry, sizes, "it must have a parameter with a tolerance, whose null value means that it is absent")
    for p in params:
        expect(entry, p.name.isidentifier() and p.unit and p.doc, f"{p.name}: needs a unit and what it is")
        expect(entry, p.low <= p.null <= p.high and p.low < p.high, f"{p.name}: low <= null <= high must hold")
        expect(entry, p.tolerance > 0.0, f"{p.name}: its tolerance must be positive")
        for value, right in ((p.low, True), (p.high, True), (p.low - 1.0, False), (p.high + 1.0, False)):
            problems = entry.check({p.name: value}, "effect")[1]
            expect(entry, (not problems) == right, f"{p.name} = {value}: must be {'taken' if right else 'refused'}")
    defaults, _ = entry.check({}, "effect")
    nulls = {p.name: p.null for p in params}
    expect(entry, {k: numbers(v)[0] for k, v in defaults.items()} == nulls, "its defaults must be its null values")
    steps = 10
    core = _core((_bound(entry, {}),), 2)
    core.reset()
    same = all(torch.equal(a, b) for a, b in zip(_plain(steps), _run(core, steps), strict=True))
    expect(entry, same, "at its null values the robot must move as without it, bit for bit")
    probes = {p.name: _probe(p.null, p.low, p.high, 5.0 * p.tolerance) for p in sizes}
    _check_present(entry, _bound(entry, {**probes, **parameters}), steps, exact)


def _probe(null: float, low: float, high: float, step: float) -> float:
    return min(null + step, high) if null < high else max(null - step, low)


def _check_present(entry: Entry, term: Term, steps: int, exact: bool) -> None:
    first, second, alone = _core((term,), 3), _core((term,), 3), _core((term,), 1, first_env=1)
    for core in (first, second, alone):
        core.reset()
    together, single = _run(first, steps), _run(alone, steps)
    expect(entry, all(torch.isfinite(x).all() for x in together), "the robot must stay finite")
    expect(entry, all(equal(a[1:2], b, exact) for a, b in zip(together, single, strict=True)), ALONE)
    second.load_state_dict(first.state_dict())
    ahead = zip(_run(first, 4, steps), _run(second, 4, steps), strict=True)
    expect(entry, all(torch.equal(a, b) for a, b in ahead), CONTINUES)
    mask = torch.tensor([True, False, False])
    before = first.plant.effects.effects[term.key].state_dict()
    first.plant.effects.reset(mask)
    after = first.plant.effects.effects[term.key].state_dict()
    of_robots = {k: v for k, v in before.items() if isinstance(v, Tensor) and v.dim() > 0 and len(v) == 3}
    untouched = [torch.equal(after[k][~mask], v[~mask]) for k, v in of_robots.items()]
    expect(entry, all(untouched), MASKED)
