"""Tables of the page of a comparison."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from functools import cache

import numpy as np

import go1exp.gap.report.words as words
from go1exp.base.report.table import NOTHING, Cell, Row, Table, number, verdict
from go1exp.config.schema.physics import contact_text
from go1exp.gap.data.prepare import tolerances_of
from go1exp.gap.result import Candidate, GapResult, Localisation

SMALLEST = 0.1  # normalised chi2 - 1 below which the colour of a heat map is the lightest

PAINT = {"excess": "YlOrBr", "fall": "PuOr"}
"""Colour maps: of falling brightness, and diverging; both are safe for the colour-blind."""

LONGEST = 4  # most values that a row of the evidence lists; the JSON file has all


# ---------------------------------------------------------------------- heat maps


def short(value: float) -> str:
    """Return a number for a narrow cell: two digits, thousands as k, millions as M."""
    for factor, letter in ((1e6, "M"), (1e3, "k")):
        if math.isfinite(value) and abs(value) >= 0.995 * factor:
            return number(value / factor, 2) + letter
    return number(round(value, 2) if math.isfinite(value) else value, 2)


@cache
def colours(kind: str, level: int) -> tuple[str, str]:
    """Return fill and ink for a level of 0 to 100 on a colour map."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    red, green, blue, _ = colormaps[PAINT[kind]](0.04 + 0.0085 * level if kind == "excess" else 0.12 + 0.0076 * level)
    bright = 0.299 * red + 0.587 * green + 0.114 * blue
    return to_hex((red, green, blue)), "#111111" if bright > 0.55 else "#ffffff"


def _level(value: float, top: float) -> float:
    """Return the place of |value| between the smallest value and ``top``, 0 to 1, logarithmically."""
    return min(math.log1p(abs(value) / SMALLEST) / math.log1p(max(top, 1.0) / SMALLEST), 1.0)


def _cell(value: float, kind: str, top: float, marked: bool, title: str) -> Cell:
    if not math.isfinite(value):
        return Cell(NOTHING, title=title, fill="#f4f4f4", ink="#777777")
    level = _level(value, top) if kind == "fall" or value > 0 else 0.0
    place = round(50 + math.copysign(50 * level, value)) if kind == "fall" else round(100 * level)
    fill, ink = colours(kind, place)
    return Cell(short(value), title=title, fill=fill, ink=ink, marked=marked)


def _top(result: GapResult) -> float | None:
    both = [m.excess for m in (result.before, result.after) if m is not None and np.isfinite(m.excess).any()]
    return max((float(np.nanmax(excess)) for excess in both), default=None)


def heat_maps(result: GapResult) -> list[Table]:
    """Return the available heat maps: nominal model, fitted model, their difference, numbers of samples."""
    before, after, top = result.before, result.after, _top(result) or 1.0
    if before is None or not before.excess.size:
        return []

    def excess(m: Localisation) -> Callable[[int, int], Cell]:
        def cell(j: int, r: int) -> Cell:
            value = float(m.excess[j, r])
            title = f"{_title(m, j, r)}; normalised chi2 - 1: {number(value)}"
            return _cell(value, "excess", top, bool(m.flagged[j, r]), title)

        return cell

    def fall(j: int, r: int) -> Cell:
        assert after is not None
        value = float(before.excess[j, r] - after.excess[j, r])
        return _cell(value, "fall", top, False, f"{_title(before, j, r)}; falls by {number(value)}")

    def samples(j: int, r: int) -> Cell:
        return Cell(short(float(before.samples[j, r])), title=_title(before, j, r), fill="#ffffff", ink="#444444")

    level = "normalised chi2 - 1; 0 = noise level"
    maps = [_heat("Nominal model", level, before, excess(before))]
    if after is not None:
        maps.append(_heat("Fitted model: identified effects and tolerances", level, after, excess(after)))
        if after.excess.shape == before.excess.shape:
            maps.append(_heat("Difference: nominal - fitted", "purple: better, orange: worse", before, fall))
    return [*maps, _heat("Samples per cell", "held-out samples; k: thousand", before, samples)]


def _heat(title: str, note: str, m: Localisation, cell: Callable[[int, int], Cell]) -> Table:
    rows = [[joint, *(cell(j, r) for r in range(len(m.regimes)))] for j, joint in enumerate(m.joints)]
    return Table(title, ["", *m.regimes], rows, note, "heat")


def _title(m: Localisation, j: int, r: int) -> str:
    p = f", p = {number(float(m.p[j, r]), 2)}" if np.isfinite(m.p[j, r]) else ""
    return f"{m.joints[j]}, {m.regimes[r]}: {int(m.samples[j, r])} samples{p}"


def scale(result: GapResult) -> list[tuple[str, str, str]]:
    """Return the key of the heat maps' colours: (label, fill, ink) from zero to the largest value."""
    top = _top(result)
    if top is None:
        return []
    marks = [0.0, *(10.0**k for k in range(7) if 10.0**k < 0.7 * top), top]
    return [(short(v), *colours("excess", round(100 * _level(v, top) if v > 0 else 0))) for v in marks]


# ---------------------------------------------------------------------- effects


def size(candidate: Candidate) -> str:
    """Return the fitted values of a candidate."""
    parts = []
    for name, value in candidate.params.items():
        values = value if isinstance(value, list) else [value]
        if values:
            few = len(values) <= LONGEST
            text = ", ".join(map(number, values)) if few else f"{number(min(values))} to {number(max(values))}"
            parts.append(f"{name} {text} {words.unit(candidate.effect, name)}".strip())
    return "; ".join(parts) or NOTHING


def evidence(result: GapResult) -> Table:
    """Return the candidates in the order given, under a heading for each term of the search."""
    everyone = words.everyone(result)
    tables: dict[str, list[Row]] = {}
    for c in result.candidates:
        unexcited = c.status == "not excited"
        tried = (c.log_gain, 3), (c.p, 2), (c.size_over_tolerance, 3)
        row = [
            Cell(c.effect, look="name", title=words.meaning(c.effect)),
            verdict(c.status),
            NOTHING if unexcited else words.place(c.effect, c.joints, everyone),
            size(c),
            *(Cell(number(c.excess_after), look="number"),),
            *(Cell(NOTHING if unexcited else number(value, digits), look="number") for value, digits in tried),
            ", ".join(c.alias_class) if len(c.alias_class) > 1 else NOTHING,
            c.reason,
        ]
        heading = "Not excited by these logs" if unexcited else f"Term {c.stage} of the search"
        tables.setdefault(heading, []).append(row)
    header = ["candidate", "status", "where", "value", "normalised chi2 - 1", "log gain", "p", "tolerances"]
    rows = [line for heading, those in tables.items() for line in (heading, *those)]
    return Table("", [*header, "alias class", "reason"], rows)


def values(result: GapResult) -> Table:
    """Return every value of the identified effects, with its 95 % interval and its size in tolerances."""
    rows = []
    for named in result.named:
        for name, by_joint in named.params.items():
            p = words.param(named.effect, name, tolerances_of(result))
            for joint, value in by_joint.items():
                pair = named.interval.get(name, {}).get(joint)
                interval = f"{number(pair[0])} to {number(pair[1])}" if pair else NOTHING
                over = number(abs(value - p.null) / p.tolerance, 2) if p and math.isfinite(p.tolerance) else NOTHING
                unit = words.unit(named.effect, name) or NOTHING
                cells = Cell(number(value), look="number"), interval, unit, Cell(over, look="number")
                rows.append([named.effect, name, joint, *cells, verdict(named.status)])
    header = ["effect", "parameter", "joint", "value", "95 % interval", "unit", "tolerances from null", "status"]
    return Table("", header, rows)


# ---------------------------------------------------------------------- provenance


def floors(result: GapResult) -> Table | None:
    """Return noise, numerical error and repeatability of each quantity; None if they are unknown."""
    if result.floors is None:
        return None
    f = result.floors
    measured = (f.noise, f.numerical, f.repeatability or {})
    names = dict.fromkeys(name for table in measured for name in table)
    rows = [[n, words.ALL_UNITS.get(n, ""), *(number(table.get(n)) for table in measured)] for n in names]
    header = ["quantity", "unit", "sensor noise, sd", "physics step, rms", "repeated episodes, rms"]
    unknown = "No episode was repeated: the repeatability of the robot is unknown."
    return Table("", header, rows, unknown if f.repeatability is None else "")


def provenance(result: GapResult) -> list[Table]:
    """Return the origin of the result: a table for each mapping, and ``Run`` for single values."""
    plain = result.as_dict()["provenance"]
    run = {name: value for name, value in plain.items() if not isinstance(value, dict)}
    if result.contact:
        run["contact of the feet"] = contact_text(result.contact)
    if math.isfinite(result.seconds):
        run["seconds"] = f"{number(result.seconds)} s"
    tables = {"Run": run, **{name: value for name, value in plain.items() if isinstance(value, dict)}}
    return [
        Table(
            name.capitalize() + (" (SHA-256)" if name == "logs" else ""),
            [],
            [[key, _value_text(value)] for key, value in entries.items()],
            look="hash",
        )
        for name, entries in tables.items()
        if entries
    ]


def _value_text(value: object) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, list) and all(isinstance(v, str) for v in value):
        return ", ".join(value) or NOTHING
    return json.dumps(value, ensure_ascii=False, default=str)
