"""What a measure promises."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from go1exp import robot
from go1exp.config.schema.registry import Entry
from go1exp.extend.testing.description import checked, expect
from go1exp.mdp.measures.trace import NotMeasured, Trace, columns

STEPS, SAMPLES, ROBOTS = 150, 10, 5


def random_trace(robots: int = ROBOTS, seed: int = 0) -> Trace:
    """Return robots that walk somehow; the second falls half way, the third stands, the fourth never counts."""
    rng = np.random.default_rng(seed)
    length = STEPS * SAMPLES
    phase = rng.uniform(0, 1, (robots, 4)) + np.arange(length)[:, None, None] * 0.002 * rng.uniform(1.5, 3, (robots, 1))
    contact = phase % 1.0 < 0.5
    counts = np.ones((STEPS, robots), bool)
    command = np.tile(rng.normal(size=(robots, 3)), (STEPS, 1, 1))
    if robots > 3:
        counts[STEPS // 2 :, 1], counts[:, 3], command[:, 2], contact[:, 2] = False, False, 0.0, True

    def positive(*shape: int) -> np.ndarray:
        return rng.uniform(0.1, 1.0, (STEPS, robots, *shape))

    def signed(*shape: int) -> np.ndarray:
        return rng.normal(size=(STEPS, robots, *shape))

    joints, legs = robot.NUM_JOINTS, robot.NUM_LEGS
    gravity = np.array([0.0, 0.0, -1.0]) + 0.1 * signed(3)
    values = {
        "command": command,
        "base_lin_vel_b": 0.5 + 0.1 * signed(3),
        "projected_gravity_b": gravity / np.linalg.norm(gravity, axis=-1, keepdims=True),
        "base_height": positive(),
        "joint_vel": signed(joints),
        "joint_torque": signed(joints),
        "joint_target": signed(joints),
        "positive_power": positive(),
        "foot_height": positive(legs),
        "foot_depth": 0.01 * positive(legs),
        "foot_slip_speed": positive(legs),
        "foot_force": 100.0 * positive(legs),
        "foot_peak_force": 300.0 * positive(legs),
        "foot_touchdown_speed": positive(legs),
    }
    assert list(values) == columns()
    return Trace(contact=contact, contact_dt=0.002, counts=counts, mass=np.linspace(12.0, 14.0, robots), **values)


def part(trace: Trace, which: list[int]) -> Trace:
    """Return some robots of a trace."""
    changed = {f.name: getattr(trace, f.name) for f in dataclasses.fields(Trace)}
    for name, values in changed.items():
        if name == "mass":
            changed[name] = None if values is None else values[which]
        elif name != "contact_dt":
            changed[name] = None if values is None else values[:, which]
    return Trace(**changed)


def without(trace: Trace, *names: str) -> Trace:
    """Return a trace that does not have these columns."""
    missing: dict[str, Any] = dict.fromkeys(names)
    return dataclasses.replace(trace, **missing)


def check_measure(entry: Entry, parameters: dict[str, object], exact: bool) -> None:
    """One number for each robot, or each of its feet: its own alone, NaN where undefined; and a unit."""
    values = checked(entry, parameters)
    per = entry.traits.get("per", "robot")
    unit = entry.traits.get("unit")
    expect(entry, isinstance(unit, str) and unit, "it must say its unit: @measure(name, unit='m/s')")
    expect(entry, per in ("robot", "foot"), "it has a value per 'robot' or per 'foot'")
    shape = (ROBOTS, robot.NUM_LEGS) if per == "foot" else (ROBOTS,)

    def compute(trace: Trace) -> np.ndarray:
        result = entry.target(trace, **values)
        expect(entry, isinstance(result, np.ndarray), "it must return an array")
        expect(entry, result.shape == (trace.robots, *shape[1:]), f"it must be (N{', 4' if per == 'foot' else ''})")
        kind = "U" if unit == "name" else "f"
        expect(entry, result.dtype.kind == kind, "it must be of floating point, or text if its unit is 'name'")
        return result

    trace = random_trace()
    together = compute(trace)
    expect(entry, _undefined(together[3]).all(), "it must be NaN for a robot of which no step counts")
    again = random_trace()
    kept = all(_same(getattr(trace, f.name), getattr(again, f.name)) for f in dataclasses.fields(Trace))
    expect(entry, kept, "it must leave the trace as it is")
    for n in range(ROBOTS):
        alone = compute(part(trace, [n]))
        expect(entry, _same(alone, together[n : n + 1]), "a robot must get the same alone and among others")
    empty: dict[str, Any] = {name: np.full_like(getattr(trace, name), np.nan) for name in columns()}
    compute(dataclasses.replace(trace, **empty))
    for name in (*columns(), "mass"):
        try:
            compute(without(trace, name))
        except NotMeasured as error:
            expect(entry, name in str(error), "the column that it needs must be named")


def _undefined(values: np.ndarray) -> np.ndarray:
    return np.asarray(values == "") if values.dtype.kind == "U" else np.isnan(values)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and a.dtype.kind == "f":
        return a.shape == b.shape and np.allclose(a, b, rtol=1e-9, atol=1e-12, equal_nan=True)
    return bool(np.array_equal(a, b))
