"""What a program gives to an environment, checked: the words name the argument, as those for a setting name its key."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from typing import Any

from go1exp.config.schema.registry import ConfigError


def whole(name: str, value: Any, least: int) -> int:
    """Return a whole number of at least ``least``.

    Raises:
        ConfigError: if ``value`` is something else.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = least - 1
    if isinstance(value, bool) or number < least:
        raise ConfigError([f"{name} = {value!r}: must be a whole number, {least} or more"])
    return number


def listed(overrides: Any) -> Sequence[str]:
    """Return overrides as a list.

    Raises:
        ConfigError: if they are one text, or one of them is no text.
    """
    if isinstance(overrides, str):
        raise ConfigError([f"overrides = {overrides!r}: must be a list of texts, such as [{overrides!r}]"])
    given = list(overrides) if isinstance(overrides, Iterable) else [overrides]
    if not isinstance(overrides, Iterable) or not all(isinstance(text, str) for text in given):
        raise ConfigError([f"overrides = {overrides!r}: must be a list of texts, such as ['reward=paper']"])
    return given
