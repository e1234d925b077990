"""The tables of the page, as plain values for the template."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

import go1exp.gap.report.words as words
from go1exp.config.schema.contact import contact_text
from go1exp.gap.data.contact import tolerances_of
from go1exp.gap.result import Candidate, GapResult, Localisation

SMALLEST = 0.1
"""Excess below which the heat map's colour is that of none."""

PAINT = {"excess": "YlOrBr", "fall": "PuOr"}
"""Colour maps: brightness falls throughout the first, the second is fit for the colour-blind."""

STATUS = {"accepted": "✓", "alias": "≈", "rejected": "✗", "not excited": "○"}
"""Status of a candidate -> its sign."""

LONGEST = 4
"""Values up to which a row of the evidence lists them; the rest is in the file of the numbers."""


@dataclass(frozen=True)
class Cell:
    """One cell of a heat map: its text, colours, whether it is marked, and what it says when pointed at."""

    text: str
    fill: str
    ink: str
    flagged: bool
    title: str


@dataclass(frozen=True)
class Heat:
    """One heat map, rows in the order of ``joints``."""

    title: str
    note: str
    regimes: tuple[str, ...]
    rows: list[tuple[str, list[Cell]]]


def short(value: float) -> str:
    """Return a number that fits a narrow cell: two digits, thousands as k, millions as M."""
    for factor, letter in ((1e6, "M"), (1e3, "k")):
        if math.isfinite(value) and abs(value) >= 0.995 * factor:
            return words.number(value / factor, 2) + letter
    return words.number(round(value, 2) + 0.0 if math.isfinite(value) else value, 2)


@cache
def colours(kind: str, level: int) -> tuple[str, str]:
    """Return fill and ink for a level of 0 to 100 on a colour map."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    red, green, blue, _ = colormaps[PAINT[kind]](0.04 + 0.0085 * level if kind == "excess" else 0.12 + 0.0076 * level)
    bright = 0.299 * red + 0.587 * green + 0.114 * blue
    return to_hex((red, green, blue)), "#111111" if bright > 0.55 else "#ffffff"


def _level(value: float, top: float) -> float:
    """Return where |value| lies between the smallest excess and ``top``, from 0 to 1, logarithmically."""
    return min(math.log1p(abs(value) / SMALLEST) / math.log1p(max(top, 1.0) / SMALLEST), 1.0)


def _cell(value: float, kind: str, top: float, flagged: bool, title: str) -> Cell:
    if not math.isfinite(value):
        return Cell(words.NOTHING, "#f4f4f4", "#888888", False, title)
    level = _level(value, top) if kind == "fall" or value > 0 else 0.0
    where = round(50 + math.copysign(50 * level, value)) if kind == "fall" else round(100 * level)
    return Cell(short(value), *colours(kind, where), flagged, title)


def heat_maps(result: GapResult) -> list[Heat]:
    """Return the heat maps that there are: before, after, what fell, and the numbers of samples."""
    before, after = result.before, result.after
    if before is None or not before.excess.size:
        return []
    both = [m for m in (before, after) if m is not None]
    top = max((float(np.nanmax(m.excess)) for m in both if np.isfinite(m.excess).any()), default=1.0)
    maps = [_excess("Before: the plain model", before, top)]
    if after is None:
        return [*maps, _samples(before)]
    maps.append(_excess("After: with what is named, and the tolerances used", after, top))
    if after.excess.shape == before.excess.shape:
        maps.append(_fall(before, after, top))
    return [*maps, _samples(before)]


def _title(m: Localisation, j: int, r: int) -> str:
    p = f", p = {words.number(float(m.p[j, r]), 2)}" if np.isfinite(m.p[j, r]) else ""
    return f"{m.joints[j]}, {m.regimes[r]}: {int(m.samples[j, r])} samples{p}"


def _grid(m: Localisation, cell: Any) -> list[tuple[str, list[Cell]]]:
    return [(joint, [cell(j, r) for r in range(len(m.regimes))]) for j, joint in enumerate(m.joints)]


def _excess(title: str, m: Localisation, top: float) -> Heat:
    def cell(j: int, r: int) -> Cell:
        value = float(m.excess[j, r])
        text = f"{_title(m, j, r)}; excess {words.number(value)}"
        return _cell(value, "excess", top, bool(m.flagged[j, r]), text)

    return Heat(title, "excess over the floor; 0 is right", m.regimes, _grid(m, cell))


def _fall(before: Localisation, after: Localisation, top: float) -> Heat:
    def cell(j: int, r: int) -> Cell:
        value = float(before.excess[j, r] - after.excess[j, r])
        text = f"{_title(before, j, r)}; excess falls by {words.number(value)}"
        return _cell(value, "fall", top, False, text)

    return Heat("Difference: before minus after", "purple: better, orange: worse", before.regimes, _grid(before, cell))


def _samples(m: Localisation) -> Heat:
    def cell(j: int, r: int) -> Cell:
        return Cell(short(float(m.samples[j, r])), "#ffffff", "#444444", False, _title(m, j, r))

    return Heat("Samples behind each cell", "held-out samples; k: thousand", m.regimes, _grid(m, cell))


def scale(result: GapResult) -> list[tuple[str, str, str]]:
    """Return the key of the heat maps' colours: (label, fill, ink) from none to the largest excess."""
    both = [m for m in (result.before, result.after) if m is not None and np.isfinite(m.excess).any()]
    if not both:
        return []
    top = max(float(np.nanmax(m.excess)) for m in both)
    marks = [0.0, *(10.0**k for k in range(7) if 10.0**k < 0.7 * top), top]
    return [(short(v), *colours("excess", round(100 * _level(v, top) if v > 0 else 0))) for v in marks]


def size(candidate: Candidate) -> list[str]:
    """Return the values that a candidate was fitted with, a line per parameter."""
    lines = []
    for name, value in candidate.params.items():
        values = value if isinstance(value, list) else [value]
        if not values:
            continue
        if len(values) <= LONGEST:
            text = ", ".join(words.number(v) for v in values)
        else:
            text = f"{words.number(min(values))} to {words.number(max(values))}"
        lines.append(f"{name} {text} {words.unit(candidate.effect, name)}".strip())
    return lines


@dataclass(frozen=True)
class Evidence:
    """One row of the evidence, in words."""

    effect: str
    meaning: str
    sign: str
    status: str
    where: str
    size: list[str]
    after: str
    gain: str
    p: str
    over: str
    aliases: str
    reason: str


def evidence(result: GapResult) -> list[tuple[str, list[Evidence]]]:
    """Return the candidates in the order given, under a heading for each term of the search."""
    everyone = words.everyone(result)
    tables: dict[str, list[Evidence]] = {}
    for c in result.candidates:
        silent = c.status == "not excited"
        row = Evidence(
            effect=c.effect,
            meaning=words.meaning(c.effect),
            sign=STATUS[c.status],
            status=c.status,
            where=words.NOTHING if silent else words.place(c.effect, c.joints, everyone),
            size=size(c) or [words.NOTHING],
            after=words.number(c.excess_after),
            gain=words.NOTHING if silent else words.number(c.log_gain),
            p=words.NOTHING if silent else words.number(c.p, 2),
            over=words.NOTHING if silent else words.number(c.size_over_tolerance),
            aliases=", ".join(c.alias_class) if len(c.alias_class) > 1 else words.NOTHING,
            reason=c.reason,
        )
        heading = "Not excited by these logs" if silent else f"Term {c.stage} of the search"
        tables.setdefault(heading, []).append(row)
    return list(tables.items())


@dataclass(frozen=True)
class Value:
    """One value of a named effect, in words."""

    effect: str
    name: str
    joint: str
    value: str
    interval: str
    unit: str
    over: str
    status: str


def values(result: GapResult) -> list[Value]:
    """Return every value of the named effects, with its 95 % interval and its size in tolerances."""
    rows = []
    for named in result.named:
        for name, by_joint in named.params.items():
            p = words.param(named.effect, name, tolerances_of(result))
            for joint, value in by_joint.items():
                pair = named.interval.get(name, {}).get(joint)
                interval = f"{words.number(pair[0])} to {words.number(pair[1])}" if pair else words.NOTHING
                graded = p is not None and math.isfinite(p.tolerance)
                over = words.number(abs(value - p.null) / p.tolerance, 2) if p and graded else words.NOTHING
                unit = words.unit(named.effect, name) or words.NOTHING
                rows.append(Value(named.effect, name, joint, words.number(value), interval, unit, over, named.status))
    return rows


def floors(result: GapResult) -> list[tuple[str, str, str, str, str]]:
    """Return (quantity, unit, noise, numerical, repeatability) of each quantity."""
    if result.floors is None:
        return []
    f = result.floors
    tables: Sequence[Mapping[str, float]] = (f.noise, f.numerical, f.repeatability or {})
    names = dict.fromkeys(name for table in tables for name in table)
    rows = []
    for name in names:
        noise, numerical, repeated = (words.number(table.get(name)) for table in tables)
        rows.append((name, words.ALL_UNITS.get(name, ""), noise, numerical, repeated))
    return rows


def provenance(result: GapResult) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return where the result is from: (what, entries), what is not a mapping of names under ``Run``."""
    plain = result.as_dict()["provenance"]
    single = [(name, _value_text(value)) for name, value in plain.items() if not isinstance(value, dict)]
    if result.contact:
        single.append(("contact of the feet", contact_text(result.contact)))
    if math.isfinite(result.seconds):
        single.append(("seconds", f"{words.number(result.seconds)} s"))
    tables = [
        (name, [(k, _value_text(v)) for k, v in value.items()])
        for name, value in plain.items()
        if isinstance(value, dict)
    ]
    return [(name, rows) for name, rows in [("Run", single), *tables] if rows]


def _value_text(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, list) and all(isinstance(v, str) for v in value):
        return ", ".join(value) or words.NOTHING
    return json.dumps(value, ensure_ascii=False, default=str)
