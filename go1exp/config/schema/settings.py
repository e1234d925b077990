"""The one idiom for settings: a frozen dataclass that pydantic checks, its attributes documented in its docstring.

``settings`` makes such a class, ``parse`` fills it from a composed configuration, ``lines`` returns what each key
means, which is what ``--help`` prints.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, TypeVar, dataclass_transform, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass

from go1exp.config.schema.plugins import KEY as PLUGINS
from go1exp.config.schema.registry import STRICT, ConfigError, as_json, explain

T = TypeVar("T")

MISSING = "???"
"""What stands in a composed configuration where the user must give a value."""


@dataclass_transform(frozen_default=True, kw_only_default=True)
def settings(kind: type[T]) -> type[T]:
    """Class decorator: a frozen dataclass whose types and ranges are checked, strictly, whoever makes one."""
    return pydantic_dataclass(kind, frozen=True, kw_only=True, config=STRICT)  # type: ignore[return-value]


adapter: Callable[[Any], TypeAdapter[Any]] = cache(TypeAdapter)
"""What checks data of a type, made once for each: to make one takes milliseconds."""


def parse(kind: type[T], container: Mapping[str, Any], examples: Mapping[str, str] | None = None, path: str = "") -> T:
    """Validate plain data as ``kind``.

    Args:
        kind: a class made by ``settings``, or another dataclass.
        container: a composed configuration, by key. Its ``plugins`` are loaded by ``config/schema/plugins.py``.
        examples: how a key that has no default is given, by key.
        path: of the container, for messages.

    Raises:
        ConfigError: with every problem.
    """
    container = {key: value for key, value in container.items() if key != PLUGINS}
    absent = [key for key, value in container.items() if value == MISSING]
    if absent:
        hints = examples or {}
        raise ConfigError([f"{key}: required, such as {hints.get(key, f'{key}=...')}" for key in absent])
    try:
        return adapter(kind).validate_json(as_json(container))
    except ValidationError as error:
        raise ConfigError(explain(error, path, [f.name for f in fields(kind)])) from None  # type: ignore[arg-type]


def subset(kind: type[T], given: object, **others: object) -> T:
    """Return the ``kind`` whose attributes are those of the same name of ``given``; ``others`` give the rest."""
    names = [f.name for f in fields(kind)]  # type: ignore[arg-type]
    return kind(**{**{name: getattr(given, name) for name in names if hasattr(given, name)}, **others})


def attributes(kind: type) -> dict[str, str]:
    """Return what a class's docstring says in its section ``Attributes``, its bases' included, as name -> text."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        doc = inspect.cleandoc(base.__dict__.get("__doc__") or "")
        section = re.search(r"^Attributes:\n((?:[ \t]+.*\n?|\n)+)", doc, re.MULTILINE)
        for name, text in re.findall(r"^ {4}(\w+): (.*(?:\n {5,}.*)*)", section[1] if section else "", re.MULTILINE):
            texts[name] = " ".join(text.split())
    return texts


def lines(kind: type, path: str = "") -> dict[str, str]:
    """Return the key paths of a settings class, nested ones included, each with its text; empty where there is none."""
    texts = attributes(kind)
    hints = get_type_hints(kind)
    keys: dict[str, str] = {}
    for field in fields(kind):
        key = f"{path}{field.name}"
        keys[key] = texts.get(field.name, "")
        for member in (hints[field.name], *get_args(hints[field.name])):
            if is_dataclass(member) and isinstance(member, type):
                keys |= lines(member, f"{key}.")
    return keys
