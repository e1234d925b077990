"""Judging a policy on another robot than the one that it was trained on."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from go1exp.sim.task import TaskConfig

CHOICES = ("actuator", "effect", "contact")
"""Groups that a run's own choice can be replaced in; null or absent keeps it."""


def split(container: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the checked choices of another robot, by group, and what is left of the configuration.

    Raises:
        ConfigError: with every problem of the choices.
    """
    from go1exp.config.schema.registry import ConfigError
    from go1exp.sim.task import parse_parts

    chosen = {name: container[name] for name in CHOICES if container.get(name) is not None}
    parts, problems = parse_parts(chosen, tuple(chosen))
    if problems:
        raise ConfigError(problems)
    return parts, {name: value for name, value in container.items() if name not in CHOICES}


def replaced(task: TaskConfig, parts: dict[str, Any]) -> TaskConfig:
    """Return the task with the other robot in it.

    Raises:
        ConfigError: if actuator and effects do not go together.
    """
    from go1exp import robot
    from go1exp.config.schema.registry import ConfigError
    from go1exp.sim.effects.rules import actuator_problems

    changed = dataclasses.replace(task, **parts)
    if problems := actuator_problems(changed.actuator, changed.effect, robot.JOINTS):
        raise ConfigError(problems)
    return changed


def described(parts: dict[str, Any]) -> dict[str, Any]:
    """Return the choices as plain data, for a report."""
    from go1exp.config.schema.registry import Term

    def plain(part: Any) -> Any:
        if isinstance(part, tuple):
            return [plain(term) for term in part]
        return {"term": part.entry.name, **part.parameters} if isinstance(part, Term) else dataclasses.asdict(part)

    return {name: plain(part) for name, part in parts.items()}
