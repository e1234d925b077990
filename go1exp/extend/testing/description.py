"""Checks of a term's description and schema, and what the checks of all kinds share."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from go1exp.config.schema.registry import ConfigError, Entry

RTOL, ATOL = 1e-5, 1e-6
"""What float32 may round differently in a batch of another size."""

ALONE = "a robot must get the same alone and in a batch"
CONTINUES = "it must continue from its saved state bit for bit"
MASKED = "reset must touch masked rows only"
"""Promises of several kinds of terms."""


def expect(entry: Entry, holds: object, promise: str) -> None:
    """Raise AssertionError, naming the term and its place, unless a promise holds."""
    if not holds:
        raise AssertionError(f"{entry.group}.{entry.name} ({entry.place}): {promise}")


def equal(a: Tensor, b: Tensor, exact: bool) -> bool:
    """Return whether two results are the same, to the bit or but for rounding."""
    if a.shape != b.shape or a.dtype != b.dtype:
        return False
    return torch.equal(a, b) if exact or not a.is_floating_point() else torch.allclose(a, b, rtol=RTOL, atol=ATOL)


def checked(entry: Entry, parameters: dict[str, object]) -> dict[str, Any]:
    """Return the parameters with defaults filled in; raise ConfigError if they do not fit."""
    values, problems = entry.check(parameters, f"{entry.group}.{entry.name}")
    if problems:
        raise ConfigError(problems)
    return values


def check_description(entry: Entry) -> None:
    """Check a term's sentence and its schema."""
    expect(entry, entry.doc.endswith(".") and entry.doc[0].isupper(), "its docstring must begin with one sentence")
    defaults = {name: p.default for name, p in entry.parameters.items() if p.default is not p.empty}
    required = [name for name in entry.parameters if name not in defaults]
    values, problems = entry.check(defaults, entry.name)
    missing = [f"{entry.name}.{name}: required, but not given" for name in required]
    expect(entry, problems == missing, f"its defaults must pass its own schema: {'; '.join(problems)}")
    if not required:
        expect(entry, {k: values[k] for k in defaults} == defaults, "its defaults must be of the annotated types")
    _, problems = entry.check({"no_such_thing": 1.0}, entry.name)
    expect(entry, any("no_such_thing" in p for p in problems), "it must refuse a parameter that it does not have")
