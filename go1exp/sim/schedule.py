"""The group ``schedule``: which settings of a task may change while a policy is trained, and within what bounds.

A name of the group is one ramp (``config/schema/training.py``)::

    soft_landings: {set: reward.touchdown_speed.weight, from: 0.0, to: -20.0, start: 70e6, over: 30e6}
    smooth: {set: reward.action_smoothness.weight, from: -0.5, to: -1.5, start: 70e6, over: 30e6}
    delay: {set: actuator.command, from: [0.0, 0.0], to: [0.0, 0.03], start: 40e6, over: 20e6}
    stiff: {set: contact.time_constant, from: 0.02, to: 0.005, when: {measure: gait/trot_error, below: 0.1}, over: 20e6}

``start`` and ``over`` count steps of all robots together, iterations, or shares of the training (``unit``). The
configured values of ``reward``, ``actuator``, ``contact`` and ``command`` are those of a run without the schedule, and
those with which the policy is evaluated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic import ValidationError

from go1exp.config.schema.physics import ContactConfig
from go1exp.config.schema.registry import Term, as_json, explain, unknown_name
from go1exp.config.schema.settings import adapter
from go1exp.config.schema.training import Ramp, Value
from go1exp.mdp.commands import AXES

DELAY = "actuator.command"
CONTACT_TIME = "contact.time_constant"
WEIGHT = "weight"
SHARES = ("command.zero_fraction", "command.slow_fraction")
"""Shares of commands; one that is 0 is not drawn, and cannot change."""
RANGES = tuple(f"command.{axis}" for axis in AXES)
"""Ranges that commands are drawn from."""
DRAWN = (*SHARES, *RANGES)
FEET_CONTACT_FIELD = "geom_solref"
"""Model field that holds the time constant of the feet's contacts."""

KEYS = ("set", "from", "to", "start", "over", "when", "unit", "optional")


def parse(settings: object, parts: Mapping[str, Any]) -> tuple[dict[str, Ramp], list[str]]:
    """Validate the group ``schedule`` against the other parts of a configuration; return its ramps and the problems."""
    if not isinstance(settings, Mapping):
        return {}, [f"schedule = {settings!r}: must be a mapping of ramps"]
    ramps: dict[str, Ramp] = {}
    problems: list[str] = []
    for key, given in settings.items():
        if given is None:  # taken away, as an ablation does
            continue
        try:
            ramps[str(key)] = _with_end(adapter(Ramp).validate_json(as_json(given)), parts)
        except ValidationError as error:
            problems += explain(error, f"schedule.{key}", KEYS)
    setters: dict[str, str] = {}
    for key, ramp in ramps.items():
        if ramp.path in setters:
            problems.append(f"schedule.{key}.set = {ramp.path!r}: is set by schedule.{setters[ramp.path]} too")
        setters[ramp.path] = key
        problems += _target_problems(f"schedule.{key}", ramp, parts)
    silent = silent_rows(parts.get("reward", ()), ramps.values())
    return {k: _waiting(ramp, silent) for k, ramp in ramps.items() if not _left_out(ramp, parts)}, problems


def silent_rows(reward: Iterable[Term], ramps: Iterable[Ramp]) -> set[str]:
    """Return the metrics of rewards of weight 0, which are not computed, unless a ramp gives them a weight."""
    paths = {ramp.path for ramp in ramps}
    return {f"reward/{t.key}" for t in reward if not t.slots[WEIGHT] and f"reward.{t.key}.{WEIGHT}" not in paths}


def _waiting(ramp: Ramp, silent: set[str]) -> Ramp:
    """Return the ramp without conditions on rewards that an ablation has taken away."""
    when = None
    for trigger in reversed(ramp.when.all() if ramp.when else ()):
        when = when if trigger.measure in silent else dataclasses.replace(trigger, also=when)
    return dataclasses.replace(ramp, when=when)


def _left_out(ramp: Ramp, parts: Mapping[str, Any]) -> bool:
    """Return whether a ramp is optional and the task has no such setting, or sets it for each robot."""
    taken = ramp.path == CONTACT_TIME and _contact_problems("", parts)
    return ramp.optional and (ramp.path not in changeable(parts) or bool(taken))


def _with_end(ramp: Ramp, parts: Mapping[str, Any]) -> Ramp:
    """Return the ramp with the configured value at its end if it names none, and as it is if its setting is unknown."""
    if ramp.last is not None or ramp.path not in changeable(parts):
        return ramp
    if ramp.path == CONTACT_TIME:
        value: Value = parts["contact"].time_constant
    elif ramp.path == DELAY:
        value = parts["actuator"].parameters["command"]
    elif ramp.path in DRAWN:
        value = parts["command"].parameters[ramp.path.removeprefix("command.")]
    else:
        key, _, name = ramp.path.removeprefix("reward.").rpartition(".")
        term = next(t for t in parts["reward"] if t.key == key)
        value = float(term.slots[WEIGHT] if name == WEIGHT else term.parameters[name])
    return dataclasses.replace(ramp, last=value)


def changeable(parts: Mapping[str, Any]) -> list[str]:
    """Return the keys of all settings that a schedule may change: of rewards, delay, contact and commands."""
    paths = [f"reward.{t.key}.{name}" for t in parts.get("reward") or () for name in (WEIGHT, *_numbers(t))]
    command = parts["command"].parameters if parts.get("command") else {}
    drawn = [path for path in SHARES if command.get(path.removeprefix("command."))]
    drawn += [path for path in RANGES if isinstance(command.get(path.removeprefix("command.")), tuple)]
    contact = [CONTACT_TIME] if parts.get("contact") else []
    actuator = parts.get("actuator")
    delay = [DELAY] if actuator is not None and actuator.entry.name == "delay" else []
    return [*paths, *delay, *contact, *drawn]


def _numbers(term: Term) -> list[str]:
    fixed = term.entry.traits.get("fixed", ())
    values = term.parameters.items()
    return [k for k, v in values if isinstance(v, int | float) and not isinstance(v, bool) and k not in fixed]


def _target_problems(path: str, ramp: Ramp, parts: Mapping[str, Any]) -> list[str]:
    if _left_out(ramp, parts):
        return []
    known = changeable(parts)
    if ramp.path not in known:
        if ramp.path == DELAY and parts.get("actuator"):
            return [f"{path}.set = {DELAY!r}: needs actuator=delay"]
        if ramp.path in SHARES:
            return [f"{path}.set = {ramp.path!r}: needs a {ramp.path} above 0, which the ramp leads to"]
        return [unknown_name(f"{path}.set", ramp.path, known, "setting")]
    problems = []
    assert ramp.last is not None
    for end, value in (("from", ramp.first), ("to", ramp.last)):
        of_value = _value_problems(f"{path}.{end}", ramp.path, value, parts)
        problems += of_value[:1]
    if ramp.path == CONTACT_TIME:
        problems += _contact_problems(path, parts)
    return problems


def _value_problems(path: str, target: str, value: Value, parts: Mapping[str, Any]) -> list[str]:
    if target == CONTACT_TIME:
        settings = {"time_constant": value, "cone": "pyramidal", "impratio": 1.0}
        try:
            adapter(ContactConfig).validate_json(as_json(settings))
        except ValidationError as error:
            return _renamed(explain(error, "", settings), "time_constant", path)
        return []
    if target == DELAY:
        term = parts["actuator"]
        of_delay = _renamed(term.entry.check({**term.parameters, "command": value}, "")[1], "command", path)
        longest = term.parameters["command"][1]
        if not of_delay and isinstance(value, tuple) and value[1] > longest:
            of_delay = [f"{path} = {list(value)!r}: exceeds {DELAY} = {list(term.parameters['command'])}, the longest"]
        return of_delay
    group, _, rest = target.partition(".")
    key, _, name = rest.rpartition(".")
    term = parts["command"] if group == "command" else next(t for t in parts["reward"] if t.key == key)
    if name == WEIGHT:
        return [] if isinstance(value, float) else [f"{path} = {list(value)!r}: must be one number"]
    return _renamed(term.entry.check({**term.parameters, name: value}, "")[1], name, path)


def _renamed(problems: list[str], name: str, path: str) -> list[str]:
    """Put the key path of a ramp in the place of the parameter's name at the beginning of each message."""
    return [f"{path}{problem.removeprefix(name)}" for problem in problems]


def _contact_problems(path: str, parts: Mapping[str, Any]) -> list[str]:
    """Refuse a ramp of the contact together with terms that set the contact of each robot."""
    fields = {f"rand.{t.key}": t.entry.traits.get("fields", ()) for t in parts.get("rand") or ()}
    fields |= {f"effect.{t.key}": t.entry.target.fields for t in parts.get("effect") or ()}
    others = [name for name, written in fields.items() if FEET_CONTACT_FIELD in written]
    return [
        f"{path}.set = {CONTACT_TIME!r}: {other} sets the contact of each robot; use one of the two" for other in others
    ]
