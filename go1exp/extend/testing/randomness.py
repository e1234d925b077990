"""What randomisations, commands, events, curricula and excitations promise: the same for the same seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.randomness import EnvRandom, Stream
from go1exp.config.compose import compose
from go1exp.config.schema.registry import Entry
from go1exp.extend.testing.description import ALONE, CONTINUES, checked, equal, expect
from go1exp.logs.excitations import Motion
from go1exp.mdp.kinematics import KinematicState
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import Sensors, build_model
from go1exp.sim.task import parse_parts
from go1exp.sim.terrain import build_terrain

DT = 0.02


def stream(n: int, seed: int = 0, first_env: int = 0) -> Stream:
    """Return a stream of random numbers for n robots."""
    return EnvRandom(seed, n, first_env).stream("here")


def everyone(n: int) -> Tensor:
    """Return (n,) of true."""
    return torch.ones(n, dtype=torch.bool)


@cache
def _scene() -> tuple[Any, Sensors]:
    parts, _ = parse_parts(compose("train"), ("robot", "terrain", "sim"))
    return build_model(parts["robot"], build_terrain(parts["terrain"]), parts["sim"].physics_dt)


def backend(n: int) -> MujocoCpu:
    """Return n nominal robots on flat ground."""
    return MujocoCpu(*_scene(), n, threads=1)


def model_fields(robots: MujocoCpu) -> dict[str, Tensor]:
    """Return copies of all fields that differ between robots."""
    return robots.state_dict()["fields"]


def with_fields(robots: MujocoCpu, entry: Entry) -> dict[str, Tensor]:
    """Make the fields that a term declares differ between robots, and return them."""
    for name in entry.traits["fields"]:
        robots.field(name)
    return model_fields(robots)


def start_states(n: int) -> KinematicState:
    """Return where the environment starts before any randomisation: nominal stance, at rest, float64."""
    qpos, qvel = torch.zeros(n, 19, dtype=torch.float64), torch.zeros(n, 18, dtype=torch.float64)
    qpos[:, 2], qpos[:, 3] = 0.33, 1.0
    qpos[:, 7:] = torch.as_tensor(robot.NOMINAL_STANCE)
    return KinematicState.view(qpos, qvel)


def parts(state: KinematicState) -> dict[str, Tensor]:
    """Return copies of the parts of a state."""
    return {f.name: getattr(state, f.name).clone() for f in fields(KinematicState)}


def check_randomization(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """Draws by seed, the same alone and in a batch; of the model, in masked rows of declared fields only.

    A trait ``null`` (parameters at which the robot is the nominal one) is tried as well.
    """
    kind = entry.traits.get("kind")
    expect(entry, kind in ("model", "state"), 'it must say what it changes: kind="model" or kind="state"')
    values = checked(entry, parameters)
    (_check_model if kind == "model" else _check_state)(entry, values)
    if "null" in entry.traits:
        _check_null(entry, {**values, **entry.traits["null"]})


def _check_model(entry: Entry, values: dict[str, Any]) -> None:
    declared = set(entry.traits.get("fields") or ())
    expect(entry, declared, 'it must say which fields it writes: fields=("geom_friction",)')
    robots, mask = backend(5), torch.tensor([True, False, True, False, True])
    before = with_fields(robots, entry)
    entry.target(robots, stream(5), mask, **values)
    after = model_fields(robots)
    expect(entry, set(after) == declared, f"it declares {sorted(declared)} and writes {sorted(after)}")
    for name, now in after.items():
        changed = (now != before[name]).flatten(1).any(1)
        expect(entry, torch.equal(changed, mask), f"it must change {name} in the masked rows and no others")
    entry.target(robots, stream(5, 9), everyone(5), **values)
    entry.target(robots, stream(5), everyone(5), **values)
    again, other, alone = backend(5), backend(5), backend(1)
    entry.target(again, stream(5), everyone(5), **values)
    entry.target(other, stream(5, 8), everyone(5), **values)
    entry.target(alone, stream(1, first_env=2), everyone(1), **values)
    for name in declared:
        drawn = robots.field(name)
        expect(entry, torch.equal(drawn, again.field(name)), "it must draw from the nominal model, by its seed alone")
        expect(entry, not torch.equal(drawn, other.field(name)), "another seed must give another robot")
        expect(entry, torch.equal(drawn[2], alone.field(name)[0]), ALONE)


def _check_state(entry: Entry, values: dict[str, Any]) -> None:
    batch, again, other, alone = start_states(4), start_states(4), start_states(4), start_states(1)
    entry.target(batch, stream(4, 7), **values)
    entry.target(again, stream(4, 7), **values)
    entry.target(other, stream(4, 8), **values)
    entry.target(alone, stream(1, 7, first_env=3), **values)
    written = 0
    for name, now in parts(batch).items():
        expect(entry, torch.isfinite(now).all(), f"{name} must be finite")
        expect(entry, torch.equal(now, parts(again)[name]), "it must draw by its seed alone")
        expect(entry, torch.equal(now[3], parts(alone)[name][0]), ALONE)
        written += not torch.equal(now, parts(other)[name])
    expect(entry, written, "another seed must give another state")


def _check_null(entry: Entry, values: dict[str, Any]) -> None:
    if entry.traits["kind"] == "state":
        state = start_states(6)
        entry.target(state, stream(6), **values)
        same = all(torch.allclose(v, parts(start_states(6))[k]) for k, v in parts(state).items())
    else:
        robots = backend(3)
        before = with_fields(robots, entry)
        entry.target(robots, stream(3), everyone(3), **values)
        same = all(torch.allclose(v, before[k], rtol=1e-6) for k, v in model_fields(robots).items())
    expect(entry, same, f"with {entry.traits['null']} the robot must stay the nominal one")


def check_command(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """A velocity (N, 3) in one tensor, the same alone and in a batch; continues from its saved state."""
    values = checked(entry, parameters)
    batch, alone = entry.target(stream(6), **values), entry.target(stream(1, first_env=4), **values)
    held, restart = batch.value, everyone(6)
    for k in range(100):
        batch.advance(DT, restart)
        alone.advance(DT, restart[4:5])
        expect(
            entry, batch.value.shape == (6, 3) and batch.value.dtype == torch.float32, "value must be (N, 3) float32"
        )
        expect(entry, torch.isfinite(batch.value).all(), "value must be finite")
        expect(entry, equal(batch.value[4:5], alone.value, exact), ALONE)
        restart = torch.tensor([k % 7 == 0, False, False, k == 3, k % 20 == 0, False])
    expect(
        entry, batch.value is held, "value must be changed in place: a captured GPU graph would not see an assignment"
    )

    def make(random: EnvRandom) -> Any:
        return entry.target(random.stream("command"), **values)

    def step(made: Any, restart: Tensor) -> dict[str, Tensor]:
        made.advance(DT, restart)
        return {"value": made.value}

    _check_continues(entry, make, step)


def check_event(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """Leaves a restarted robot alone; the same alone and in a batch; continues from its saved state."""
    values = checked(entry, parameters)
    batch, alone = entry.target(stream(5), **values), entry.target(stream(1, first_env=3), **values)
    state, single = start_states(5), start_states(1)
    batch.advance(state, 30.0, everyone(5))
    alone.advance(single, 30.0, everyone(1))
    for name, now in parts(start_states(5)).items():
        expect(entry, torch.equal(getattr(state, name), now), f"it must leave {name} of a robot that begins as it is")
    for _ in range(30):
        batch.advance(state, 1.0, ~everyone(5))
        alone.advance(single, 1.0, ~everyone(1))
        for name, now in parts(single).items():
            expect(entry, torch.isfinite(now).all(), f"{name} must stay finite")
            expect(entry, equal(getattr(state, name)[3:4], now, exact), ALONE)

    def make(random: EnvRandom) -> Any:
        return entry.target(random.stream("event"), **values), start_states(6)

    def step(made: Any, restart: Tensor) -> dict[str, Tensor]:
        made[0].advance(made[1], 1.0, restart)
        return parts(made[1])

    _check_continues(entry, make, step)


def _check_continues(
    entry: Entry, make: Callable[[EnvRandom], Any], step: Callable[[Any, Tensor], dict[str, Tensor]]
) -> None:
    random, twin_random = EnvRandom(0, 6), EnvRandom(9, 6)
    first, second = make(random), make(twin_random)
    step(first, everyone(6))
    for _ in range(20):
        step(first, ~everyone(6))
    twin_random.load_state_dict(random.state_dict())
    pair = isinstance(first, tuple)
    (second[0] if pair else second).load_state_dict((first[0] if pair else first).state_dict())
    if pair:
        for name, now in parts(first[1]).items():
            getattr(second[1], name).copy_(now)
    for k in range(40):
        restart = everyone(6) if k % 10 == 9 else ~everyone(6)  # so that something is drawn anew
        a, b = step(first, restart), step(second, restart)
        expect(entry, all(torch.equal(v, b[k]) for k, v in a.items()), CONTINUES)


def check_curriculum(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """Keeps levels on the map and treats each robot by itself."""
    rule, n = entry.target(**checked(entry, parameters)), 300
    generator = torch.Generator().manual_seed(0)
    level, anywhere = (torch.randint(0, 10, (n,), generator=generator) for _ in range(2))
    walked, asked = (top * torch.rand(n, generator=generator) for top in (8.0, 20.0))
    after = rule(level, walked, asked, 8.0, 9, anywhere)
    expect(entry, after.shape == (n,) and after.dtype == torch.int64, "it must return levels (N,) int64")
    expect(entry, bool((after >= 0).all() and (after <= 9).all()), "levels must stay on the map")
    for i in range(0, n, 29):
        row = slice(i, i + 1)
        alone = rule(level[row], walked[row], asked[row], 8.0, 9, anywhere[row])
        expect(entry, torch.equal(alone, after[row]), ALONE)


RATE_HZ, SECONDS = 200.0, 20.0


def check_excitation(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """A motion of the Go1's joints within their limits; the same for the same seed."""
    values = checked(entry, parameters)
    t = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    centre, limits = robot.NOMINAL_STANCE.copy(), robot.JOINT_POS_LIMITS.copy()

    def make(seed: int) -> Motion:
        motion = entry.target(t, centre, limits, np.random.default_rng(seed), **values)
        expect(entry, isinstance(motion, Motion), "it must return a Motion")
        return motion

    motion, again = make(0), make(0)
    expect(entry, motion.target.shape == (len(t), len(centre)), "its targets must be (T, J)")
    expect(entry, motion.torque_enable.shape == (len(t),), "torque_enable must be (T,)")
    expect(entry, motion.torque_enable.dtype == bool, "torque_enable must be true or false")
    expect(entry, motion.start.shape == centre.shape, "its start must be (J,)")
    for angles in (motion.target, motion.start):
        within = np.isfinite(angles).all() and (angles >= limits[:, 0]).all() and (angles <= limits[:, 1]).all()
        expect(entry, within, "it must stay within the joints' limits")
    same = np.array_equal(motion.target, again.target) and np.array_equal(motion.torque_enable, again.torque_enable)
    expect(entry, same, "the same seed must give the same motion")
    kept = np.array_equal(centre, robot.NOMINAL_STANCE) and np.array_equal(limits, robot.JOINT_POS_LIMITS)
    expect(entry, kept, "it must leave centre and limits as they are")
