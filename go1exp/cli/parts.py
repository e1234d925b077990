"""Settings of verbs that have groups too, checked together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, TypeVar

from go1exp.cli.settings import parse
from go1exp.config.schema.registry import ConfigError

T = TypeVar("T")

Reader = Callable[[Any], Any]
"""Turns what stands under a key into what the verb works with; raises ConfigError."""


def parse_with_groups(
    kind: type[T], container: Mapping[str, Any], groups: Sequence[str], **others: Reader
) -> tuple[T, dict[str, Any]]:
    """Validate a verb's settings together with its groups.

    Args:
        kind: the class of the settings.
        container: the composed configuration.
        groups: groups of ``go1exp.sim.task`` that the verb has.
        **others: for each further key the function that reads it.

    Returns:
        The settings, and what was read of groups and further keys, by key.

    Raises:
        ConfigError: with every problem of all of them.
    """
    from go1exp.sim.task import parse_parts

    parts, problems = parse_parts(container, tuple(groups))
    for key, read in others.items():
        try:
            parts[key] = read(container[key])
        except ConfigError as error:
            problems += error.problems
    try:
        separate = {*groups, *others} - {f.name for f in fields(kind)}  # type: ignore[arg-type]
        checked = parse(kind, {key: value for key, value in container.items() if key not in separate})
    except ConfigError as error:
        raise ConfigError([*problems, *error.problems]) from None
    if problems:
        raise ConfigError(problems)
    return checked, parts
