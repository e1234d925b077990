"""A result as a file, so that every stage of the workflow can be run again by itself."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
from pydantic import TypeAdapter, ValidationError

from go1exp.base.files import write_json
from go1exp.config.schema.physics import ContactConfig, read_contact
from go1exp.config.schema.registry import Expected
from go1exp.gap.result import (
    EXIT_CODES,
    AngleErrors,
    Candidate,
    Clock,
    ClockChoice,
    Floors,
    GapResult,
    GapSettings,
    Localisation,
    NamedEffect,
    Overlay,
)

RESULT = "verdict.json"
"""Name of the file in the output folder."""

EFFECT, CALIBRATION, COMPENSATING = "effect.yaml", "calibration.yaml", "compensating.yaml"
"""What is missing; the nominal parameters within their tolerances; what only makes up for something unknown."""

APPLIED = "applied.json"
"""What the written files do at the step of training."""

MADE_OF_IT = (EFFECT, CALIBRATION, COMPENSATING, APPLIED, "report.html", "report.json")
"""Files that are made of a result, beside it."""


class GapFileError(Expected):
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
    """Read the result in a folder.

    Raises:
        GapFileError: if there is none, or it is not one.
    """
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
    known = {f.name for f in fields(GapResult)}
    values = {key: value for key, value in plain.items() if key in known}
    values["named"] = tuple(_named(item) for item in plain["named"])
    values["candidates"] = tuple(_candidate(item) for item in plain["candidates"])
    if plain["verdict"] not in EXIT_CODES:
        raise ValueError(f"verdict {plain['verdict']!r}")
    values["floors"] = None if plain["floors"] is None else _floors(plain["floors"])
    values["errors"] = _errors(plain.get("errors"))  # older results have none
    values["before"], values["after"] = (_localisation(plain[key]) for key in ("before", "after"))
    values["overlays"] = tuple(_overlay(item) for item in plain["overlays"])
    values["waterfall"] = tuple((str(label), _number(value)) for label, value in plain["waterfall"])
    for name in ("excess", "box"):
        values[name] = _numbers(plain[name])
    # Results of older versions call it bags.
    values["bootstrap_share"] = _numbers(plain["bags"] if "bags" in plain else plain["bootstrap_share"])
    values["tolerances"] = _numbers(plain.get("tolerances", {}))  # of an older version: the declared ones
    values["contact"] = _contact(plain.get("contact"))
    values["clock"] = _clock(plain.get("clock"))  # older results have none
    for name in ("closed", "seconds"):
        values[name] = _number(plain[name])
    for name in ("advice", "warnings"):
        values[name] = tuple(plain[name])
    return GapResult(**values)


def search_of(result: GapResult) -> GapSettings:
    """Return the settings of the search that found a result.

    Raises:
        GapFileError: if it does not say, or says what this version does not know.
    """
    try:
        kept = TypeAdapter(GapSettings).validate_json(json.dumps(result.provenance["settings"]))
    except (KeyError, ValidationError) as error:
        why = "does not say them" if isinstance(error, KeyError) else str(error).splitlines()[0]
        raise GapFileError(f"{RESULT}: settings of its search: {why}; run go1exp gap explain again") from None
    return kept


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _numbers(plain: Any) -> Any:
    """Put NaN for None in nested lists and mappings of numbers."""
    if isinstance(plain, Mapping):
        return {key: _numbers(value) for key, value in plain.items()}
    return [_numbers(value) for value in plain] if isinstance(plain, list) else _number(plain)


def _errors(item: Mapping[str, Any] | None) -> AngleErrors | None:
    if item is None:
        return None
    pairs = {name: {k: _pair(v) for k, v in item[name].items()} for name in ("by_joint", "by_episode")}
    numbers = {name: _number(item[name]) for name in ("removed", "worse")}
    within = _pair(item["within"]) if item.get("within") else None  # older results have none
    return AngleErrors(**{**item, **numbers, **pairs, "median": _pair(item["median"]), "within": within})


def _contact(item: Mapping[str, Any] | None) -> ContactConfig | None:
    """Return the contact of a result; older ones have none."""
    contact = None if item is None else read_contact(item)
    if item is not None and contact is None:
        raise ValueError(f"contact {item!r}")
    return contact


def _clock(item: Mapping[str, Any] | None) -> ClockChoice | None:
    if item is None:
        return None
    if item["taken"] not in get_args(Clock):
        raise ValueError(f"clock.taken {item['taken']!r}")
    numbers = {name: _number(item[name]) for name in ("gain", "p", "nominal_gain", "nominal_p")}
    tables = {name: _numbers(item[name]) for name in ("nominal_errors", "errors")}
    pairs = {name: _pair(item[name]) for name in ("steps", "interval")}
    rates = {name: _pair(value) for name, value in item["rate_hz"].items()}
    terms = {name: tuple(value) for name, value in item["terms"].items()}
    return ClockChoice(**{**item, **numbers, **tables, **pairs, "rate_hz": rates, "terms": terms})


def _pair(item: Sequence[float | None]) -> tuple[float, float]:
    first, second = item
    return _number(first), _number(second)


def _floors(item: Mapping[str, Any]) -> Floors:
    repeated = item["repeatability"]
    noise, numerical = _numbers(item["noise"]), _numbers(item["numerical"])
    return Floors(noise, numerical, None if repeated is None else _numbers(repeated))


def _named(item: Mapping[str, Any]) -> NamedEffect:
    interval = {
        param: {joint: (_number(low), _number(high)) for joint, (low, high) in places.items()}
        for param, places in item["interval"].items()
    }
    tuples = {name: tuple(item[name]) for name in ("joints", "alias_set")}
    share = _number(item.get("share"))  # older results say none
    return NamedEffect(**{**item, **tuples, "params": _numbers(item["params"]), "interval": interval, "share": share})


def _candidate(item: Mapping[str, Any]) -> Candidate:
    numbers = {name: _number(item[name]) for name in ("excess_after", "log_gain", "p", "size_over_tolerance")}
    tuples = {name: tuple(item[name]) for name in ("joints", "alias_class")}
    return Candidate(**{**item, **numbers, **tuples, "params": _numbers(item["params"])})


def _localisation(item: Mapping[str, Any] | None) -> Localisation | None:
    if item is None:
        return None
    excess, p = (np.array(item[name], dtype=float) for name in ("excess", "p"))
    samples, flagged = np.array(item["samples"], dtype=int), np.array(item["flagged"], dtype=bool)
    return Localisation(tuple(item["joints"]), tuple(item["regimes"]), samples, excess, p, flagged)


def _overlay(item: Mapping[str, Any]) -> Overlay:
    curves = {name: {k: np.array(v, dtype=float) for k, v in item[name].items()} for name in _CURVES}
    return Overlay(item["episode"], np.array(item["t"], dtype=float), **curves, noise=_numbers(item["noise"]))


_CURVES = ("measured", "before", "after")
