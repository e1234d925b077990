"""One number for all joints, or different ones: how a configuration writes values per joint."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from pydantic import Field, ValidationError, ValidatorFunctionWrapHandler, WrapValidator

JointValues = float | Annotated[tuple[float, ...], Field(min_length=1)] | dict[str, float]
"""A number (every joint); a list: hip, thigh, calf, or one value for each joint; or a mapping from names to numbers.

A name is a joint (``FR_calf``), a kind (``calf``) or a leg (``FR``); a joint beats a kind, a kind beats a leg.
"""


def numbers(values: JointValues) -> tuple[float, ...]:
    """Return the numbers that ``values`` holds, in whatever form."""
    if isinstance(values, Mapping):
        return tuple(values.values())
    return tuple(values) if isinstance(values, tuple) else (float(values),)


def each_within(low: float, high: float = math.inf) -> WrapValidator:
    """Return a validator which demands values of one of the forms, every number between ``low`` and ``high``."""

    def check(given: object, parse: ValidatorFunctionWrapHandler) -> JointValues:
        try:
            values: JointValues = parse(tuple(given) if isinstance(given, list) else given)
        except ValidationError:
            forms = "a number, a list (hip, thigh, calf, or one for each joint) or a mapping from joints to numbers"
            raise ValueError(f"must be {forms}") from None
        if not all(low <= v <= high for v in numbers(values)):
            bound = f"at least {low:g}" if high == math.inf else f"between {low:g} and {high:g}"
            raise ValueError(f"every value must be {bound}")
        return values

    return WrapValidator(check)


def _matches(name: str, joint: str) -> int:
    """Return how closely ``name`` means ``joint``: 3 itself, 2 its kind, 1 its leg, 0 not at all."""
    if name == joint:
        return 3
    return 2 if joint.endswith(f"_{name}") else 1 if joint.startswith(f"{name}_") else 0


def spread(values: JointValues | Sequence[float], joints: Sequence[str]) -> np.ndarray:
    """Return one value per joint (J,); NaN where a mapping names no value.

    Raises:
        ValueError: if a name means no joint, or a list has neither 3 (hip, thigh, calf) nor J values.
    """
    if isinstance(values, int | float):
        return np.full(len(joints), float(values))
    if isinstance(values, Mapping):
        for name in values:
            if not any(_matches(name, joint) for joint in joints):
                kinds = sorted({j.rsplit("_", 1)[-1] for j in joints})
                raise ValueError(
                    f"no joint is called {name!r}; joints are {', '.join(joints)}; kinds {', '.join(kinds)}"
                )
        best = [max(values, key=lambda name: _matches(name, joint), default=None) for joint in joints]
        named = [(b if b is not None and _matches(b, j) else None) for b, j in zip(best, joints, strict=True)]
        return np.array([np.nan if n is None else float(values[n]) for n in named])
    given = np.asarray(values, dtype=float)
    if len(given) == len(joints):
        return given
    if len(given) == 3 and len(joints) % 3 == 0:
        return np.tile(given, len(joints) // 3)
    raise ValueError(f"{len(given)} values for {len(joints)} joints; give one, hip-thigh-calf, or one for each")
