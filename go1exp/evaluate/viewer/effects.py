"""Effects that a user of the window switches on and off and sizes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from go1exp import robot
from go1exp.config.choices import choice_files, config_folder, load
from go1exp.config.schema.contact import ContactConfig
from go1exp.config.schema.joint_values import JointValues, numbers
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.sim.effects.base import Param
from go1exp.sim.effects.rules import actuator_problems
from go1exp.sim.effects.tolerances import Tolerances
from go1exp.sim.task import parse_parts

LARGEST = 3.0
"""Where the slider of an effect's size ends, in sizes of its choice."""


def catalogue(effects: tuple[Term, ...], randomize: bool) -> tuple[dict[str, Term], dict[str, float]]:
    """Return every effect by name at size 1, and the sizes of those that the robot has.

    One of the robot's own that does nothing, since only its spread did in training, is as its choice has it, and off.

    Args:
        effects: of the robot.
        randomize: let the spread of its own effects act.
    """
    known: dict[str, Term] = {}
    for file in choice_files("effect", [config_folder()]).values():
        parts, problems = parse_parts({"effect": load(file)}, ("effect",))
        if not problems:
            known |= {term.key: term for term in parts["effect"]}
    sizes = dict.fromkeys(known, 0.0)
    for term in effects:
        spread = randomize and any(term.slots.get("spread", {}).values())
        if spread or _acts(term):
            known[term.key] = term if spread else dataclasses.replace(term, slots={"spread": {}})
            sizes[term.key] = 1.0
    return dict(sorted(known.items())), sizes


def _acts(term: Term) -> bool:
    nulls = {p.name: p.null for p in params_of(term)}
    return any(v != nulls[name] for name, value in term.parameters.items() for v in numbers(value))


def acting(
    sizes: Mapping[str, float], effects: Mapping[str, Term], actuator: Term, contact: ContactConfig
) -> tuple[Term, ...]:
    """Return the effects of a size above 0, at that size.

    Args:
        sizes: by name.
        effects: by name, at size 1.
        actuator: the drives.
        contact: of the feet.

    Raises:
        ConfigError: if a name is not known, or effects and drives do not go together.
    """
    if strange := [name for name in sizes if name not in effects]:
        raise ConfigError([f"effect {strange[0]!r}: known are {', '.join(effects)}"])
    chosen = {name: size for name, size in sizes.items() if size > 0.0}
    terms = tuple(
        effects[name] if size == 1.0 else resized(effects[name], size, contact) for name, size in chosen.items()
    )
    if problems := actuator_problems(actuator, terms, robot.JOINTS):
        raise ConfigError(problems)
    return terms


def resized(term: Term, size: float, contact: ContactConfig) -> Term:
    """Return an effect whose parameters are ``size`` times as far from null, within their limits, alike in all robots.

    A parameter per joint keeps its joints; one of which every value is null, a shape, stays. Null is what a robot has
    whose feet have this contact.
    """
    parameters, known = dict(term.parameters), Tolerances(contact=contact)
    for p in params_of(term):
        left_alone = p.least is not None and parameters.get(p.name) == p.null  # what the model has stays
        if p.name in parameters and not left_alone:
            parameters[p.name] = _scaled(parameters[p.name], known.param((term.entry.name, p.name)), size)
    return dataclasses.replace(term, parameters=parameters, slots={**term.slots, "spread": {}})


def params_of(term: Term) -> tuple[Param, ...]:
    """Return the declarations of an effect's parameters."""
    declared: tuple[Param, ...] = vars(term.entry.target)["params"]
    return declared


def _scaled(value: JointValues, param: Param, size: float) -> Any:
    def one(v: float) -> float:
        return min(max(param.null + size * (v - param.null), param.low), param.high)

    if isinstance(value, Mapping):
        return {joint: one(v) for joint, v in value.items()}
    if isinstance(value, tuple | list):
        return tuple(one(v) for v in value)
    return one(float(value))


def lines(effects: Mapping[str, Term]) -> dict[str, str]:
    """Return a line for each effect: its words, and its values at size 1."""
    return {name: _about(term) for name, term in effects.items()}


def _about(term: Any) -> str:
    units = {p.name: "" if p.unit == "-" else f" {p.unit}" for p in params_of(term)}
    values = ", ".join(f"{name} {value}{units.get(name, '')}" for name, value in term.parameters.items())
    return f"{term.entry.target.title}; at size 1: {values}"
