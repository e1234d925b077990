"""What a configuration of actuators and effects must satisfy beyond each one's own schema."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import cast

import numpy as np

from go1exp.config.schema.joint_values import numbers, spread
from go1exp.config.schema.registry import Term, members, unknown_name
from go1exp.sim.effects.base import Effect


def nested_actuators(actuator: Term) -> Iterator[tuple[Term, str]]:
    """Yield the actuator and, if it is a wrapper, those in it from the outside in, each with its key path."""
    term, path = actuator, "actuator"
    yield term, path
    while inner := term.parameters.get("drive"):
        parameters = {k: v for k, v in inner.items() if k != "term"}
        term, path = Term("drive", members("actuator")[inner["term"]], parameters), f"{path}.drive"
        yield term, path


def has_gains(actuator: Term) -> bool:
    """Return whether the drive has a position and a speed gain; a wrapper has those of the ``drive`` in it."""
    *_, (innermost, _) = nested_actuators(actuator)
    return bool(innermost.entry.traits.get("gains"))


def on_mount(effects: Iterable[Term]) -> bool:
    """Return whether a held trunk needs the joints of a mount: whether an effect on it is somewhere not null."""
    return any(
        numbers(term.parameters.get(p.name, p.null)) != (p.null,) or p.name in term.slots.get("spread", ())
        for term in effects
        if issubclass(kind := cast("type[Effect]", term.entry.target), Effect) and kind.mounts
        for p in kind.params
        if math.isfinite(p.tolerance)
    )


def _values_problems(term: Term, path: str, joints: Sequence[str]) -> list[str]:
    problems = []
    for name, value in term.parameters.items():
        if isinstance(value, dict | tuple) and name in getattr(term.entry.target, "joint_values", ()):
            try:
                full = spread(value, joints)
            except ValueError as error:
                problems.append(f"{path}.{name} = {value!r}: {error}")
                continue
            without_value = [j for j, missing in zip(joints, np.isnan(full), strict=True) if missing]
            if without_value and term.entry.group == "actuator" and term.entry.parameters[name].default is not None:
                problems.append(f"{path}.{name} = {value!r}: gives {', '.join(without_value)} no value")
    return problems


def _leaves_the_model(term: Term, name: str) -> bool:
    """Return whether a parameter is null, and that is a word for what the model has and no value by itself."""
    params = {p.name: p for p in getattr(term.entry.target, "params", ())}
    return name in params and params[name].least is not None and term.parameters[name] == params[name].null


def actuator_problems(actuator: Term, effects: Iterable[Term], joints: Sequence[str]) -> list[str]:
    """Return what is wrong with actuator and effects together, one line each with its key path."""
    problems = [
        problem for term, path in nested_actuators(actuator) for problem in _values_problems(term, path, joints)
    ]
    for term in effects:
        path = f"effect.{term.key}"
        problems += _values_problems(term, path, joints)
        for name in term.slots.get("spread", ()):
            if name not in term.parameters:
                problems.append(unknown_name(f"{path}.spread.{name}", name, term.parameters, "parameter"))
            elif _leaves_the_model(term, name):
                problems.append(f"{path}.spread.{name}: needs {path}.{name}, the value that robots differ from")
        if term.entry.traits.get("gains") and not has_gains(actuator):
            problems.append(f"{path}: changes kp or kd, and actuator {actuator.entry.name!r} has neither")
    return problems
