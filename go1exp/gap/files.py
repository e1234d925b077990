"""A result as a file, so that every stage of the workflow can be run again by itself."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import TypeAdapter, ValidationError

from go1exp.base.errors import Unusable
from go1exp.base.files import write_json
from go1exp.config.schema.physics import ContactConfig, read_contact
from go1exp.gap.result import GapResult, GapSettings

RESULT = "verdict.json"  # name of the file in the output folder

EFFECT, CALIBRATION, COMPENSATING = "effect.yaml", "calibration.yaml", "compensating.yaml"
"""What is missing; the nominal parameters within their tolerances; what only makes up for something unknown."""

APPLIED = "applied.json"  # what the written files do at the step of training

MADE_OF_IT = (EFFECT, CALIBRATION, COMPENSATING, APPLIED, "report.html", "report.json")
"""Files that are made of a result, beside it."""


class GapFileError(Unusable):
    """A result file that is missing or not whole."""


def save(result: GapResult, folder: Path) -> Path:
    """Write a result and return its file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / RESULT
    write_json(path, result.as_dict(), indent=1)
    return path


def remove_older(folder: Path) -> list[str]:
    """Remove what was made of an earlier result in a folder, and return the names: a new result has others or none."""
    older = [name for name in MADE_OF_IT if (folder / name).is_file()]
    for name in older:
        (folder / name).unlink()
    return older


def load(folder: Path) -> GapResult:
    """Read the result in a folder; GapFileError if there is none, or it is not one."""
    path = folder / RESULT
    if folder.is_file():
        raise GapFileError(f"{folder}: is a file; out must be the folder of an answer, with {RESULT}")
    if not path.is_file():
        raise GapFileError(f"{path}: no such file; run go1exp gap explain first")
    try:
        return from_dict(json.loads(path.read_text()))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        why = f"has no {error}" if isinstance(error, KeyError) else str(error)
        raise GapFileError(f"{path}: not a result of go1exp gap ({why}); run go1exp gap explain again") from None


def from_dict(plain: Mapping[str, Any]) -> GapResult:
    """Turn what ``GapResult.as_dict`` returned, and JSON kept, into a result; None is NaN where a number belongs."""
    return _read(GapResult, plain, "")


def search_of(result: GapResult) -> GapSettings:
    """Return the settings of the search that found a result; GapFileError if this version does not know them."""
    try:
        kept = TypeAdapter(GapSettings).validate_json(json.dumps(result.provenance["settings"]))
    except (KeyError, ValidationError) as error:
        why = "does not say them" if isinstance(error, KeyError) else str(error).splitlines()[0]
        raise GapFileError(f"{RESULT}: settings of its search: {why}; run go1exp gap explain again") from None
    return kept


NOT_IN_OLDER = ("errors", "tolerances", "contact", "clock", "share", "within")
"""Fields that results of older versions do not have."""


def _read(kind: Any, value: Any, path: str) -> Any:
    """Return plain values as what a type hint of ``gap/result.py`` says; ``path`` names them in messages."""
    origin, args = get_origin(kind), get_args(kind)
    if kind is float:
        return math.nan if value is None else float(value)
    if kind is np.ndarray:
        array = np.array(value)
        return array.astype(float) if array.dtype == object else array  # None among numbers is NaN
    if kind is ContactConfig:
        if (contact := read_contact(value)) is None:
            raise ValueError(f"{path} {value!r}")
        return contact
    if is_dataclass(kind) and isinstance(kind, type):
        hints, given = get_type_hints(kind), [f.name for f in fields(kind)]
        known = [name for name in given if name in value or name not in NOT_IN_OLDER]
        return kind(**{name: _read(hints[name], value[name], f"{path}.{name}".lstrip(".")) for name in known})
    if origin is Literal and value not in args:
        raise ValueError(f"{path} {value!r}")
    if origin in (Union, UnionType):
        arms = [arm for arm in args if arm is not type(None)]
        if value is None and len(arms) < len(args):
            return None
        alike = [arm for arm in arms if (get_origin(arm) is list) == isinstance(value, list)]
        return _read((alike if len(arms) > 1 else arms)[0], value, path)
    if origin is dict:
        return {key: _read(args[1], item, f"{path}.{key}") for key, item in value.items()}
    if origin is list or (origin is tuple and args[-1] is Ellipsis):
        return origin(_read(args[0], item, path) for item in value)
    if origin is tuple:
        return tuple(_read(arm, item, path) for arm, item in zip(args, value, strict=True))
    return value
