"""Tables of the pages: claims with their verdicts, and figures with n and interval by condition."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from go1exp.evaluate.protocol.claims import limits
from go1exp.evaluate.protocol.playing import Result
from go1exp.evaluate.protocol.report.words import condition_text, interval_text, keys_text

Table = dict[str, Any]
Entry = Mapping[str, Any]
Meanings = Mapping[str, tuple[str, str]]

ACROSS = 5
"""Most columns of figures in a table, so that it fits on paper."""

MANY = 8
"""More conditions than these are rows."""

UNTOLD = ("moving_s",)
"""Figures of the rows that a page sums up in its head."""

VERDICTS = (
    "Judged is the whole 95 % interval, in brackets, not the value alone. reached: all of it keeps the limit; close: it"
    " misses, or may miss, by no more than the claim's tolerance; not reached: all of it misses, the value by more than"
    " that; not told: it is too wide to say, play more robots. n: robots that the value is from."
)


def meanings(result: Result) -> dict[str, tuple[str, str]]:
    """Return the unit and the meaning of each figure by its name."""
    protocol = result.chosen.protocol
    units = {c.name: (c.unit, _plain(c.meaning)) for c in protocol.columns()}
    derived = {d.name: (d.unit, d.meaning) for d in protocol.derived(result.played.rows)}
    return {**units, "falls_per_minute": ("1/min", "falls per moving robot-minute"), **derived}


def _plain(docstring: str) -> str:
    """Return the words of a measure's docstring without the shape of its values and without markup."""
    return re.sub(r" \((?:N|S|4|,| )+\)", "", docstring).replace("`", "")


def claims_table(result: Result, means: Meanings) -> Table:
    """Return the verdicts as a table."""
    rows = []
    for v in result.verdicts:
        where = condition_text(v.condition) + (f" (worst of {v.conditions})" if v.conditions > 1 else "")
        limit = f"{limits(v.claim)} {_unit(v.claim.quantity, _about(result.summary, v.condition))}".rstrip()
        meaning = means.get(v.claim.quantity, ("", ""))[1]
        value = spread(v.figure.estimate, v.figure.low, v.figure.high, f"n {v.figure.n}")
        name = v.name.replace("_", " ")
        figure = {"name": v.claim.quantity, "note": meaning}
        rows.append([name, {"word": v.word}, value, limit, figure, where, v.claim.source])
    header = ["claim", "verdict", "value [95 %] n", "limit", "figure", "where", "limit's source"]
    return {"title": "Claims", "note": VERDICTS if rows else "None.", "header": header, "rows": rows}


def _about(entries: Sequence[Entry], condition: Mapping[str, Any]) -> list[Entry]:
    return [e for e in entries if e["condition"] == condition]


def _unit(name: str, entries: Sequence[Entry]) -> str:
    """Return the unit of a figure in some entries; none where they differ, as difficulties of grounds do."""
    units = {e["figures"][name]["unit"] for e in entries if name in e["figures"]}
    return units.pop() if len(units) == 1 else ""


def spread(estimate: float | None, low: float | None, high: float | None, count: str) -> dict[str, str]:
    """Return a cell: a figure, and below it its interval and what it is from."""
    value, _, interval = interval_text(estimate, low, high).partition(" ")
    return {"value": value, "interval": f"{interval} {count}".strip()}


def figure_tables(entries: Sequence[Entry], means: Meanings) -> list[Table]:
    """Return the figures in tables, by what their conditions are made of.

    A row is a figure and a column a condition; where conditions are many, the other way round.
    """
    groups: dict[tuple[str, ...], list[Entry]] = {}
    for entry in _merged(entries):
        groups.setdefault(tuple(entry["condition"]), []).append(entry)
    tables = []
    for keys, those in groups.items():
        names = _names(those)
        where = [condition_text(e["condition"]) for e in those]
        heads = {name: _unit(name, those) for name in names}
        cells = [[_cell(name, e["figures"].get(name), heads[name]) for e in those] for name in names]
        title = f"Numbers by {keys_text(keys)}" if keys else "Numbers of all robots together"
        if len(those) <= MANY:
            labels = _explained(heads, means)
            tables += _split(title, "figure", labels, where if keys else ["value [95 %] n"], cells)
        else:
            across: list[list[Any]] = [list(column) for column in zip(*cells, strict=True)]
            parts = _split(title, "condition", where, [_named(*head) for head in heads.items()], across)
            for part, chosen in zip(parts, _parts(len(names)), strict=True):
                part["note"] = _glossary(names[chosen], means)
            tables += parts
    return tables


def _merged(entries: Sequence[Entry]) -> list[Entry]:
    """Return one entry for each condition, with all its figures."""
    merged: dict[tuple[Any, ...], dict[str, Any]] = {}
    for entry in entries:
        key = tuple(entry["condition"].items())
        one = merged.setdefault(key, {"condition": entry["condition"], "figures": {}})
        one["figures"] |= entry["figures"]
    return list(merged.values())


def _names(entries: Sequence[Entry]) -> list[str]:
    """Return the figures of some entries: falls first, without those that say nothing here."""
    names = list(dict.fromkeys(name for e in entries for name in e["figures"]))
    nobody_left = not any(e["figures"].get("left_map", {}).get("estimate") for e in entries)
    left_out = (*UNTOLD, *(["left_map"] if nobody_left else []))
    first = [name for name in ("fell", "falls_per_minute") if name in names]
    return [*first, *(name for name in names if name not in (*first, *left_out))]


def _parts(count: int) -> list[slice]:
    """Cut ``count`` columns into as few parts of at most ``ACROSS`` as there can be, about equally wide."""
    wide = math.ceil(count / math.ceil(count / ACROSS))
    return [slice(k, k + wide) for k in range(0, count, wide)]


def _split(title: str, corner: str, rows: Sequence[Any], columns: Sequence[str], cells: Any) -> list[Table]:
    """Return tables of at most ``ACROSS`` columns beside the first, without rows that are empty."""
    tables = []
    for part in _parts(len(columns)):
        lines = [[row, *line[part]] for row, line in zip(rows, cells, strict=True) if any(line[part])]
        named = title if not part.start else f"{title}, continued"
        tables.append({"title": named, "note": "", "header": [corner, *columns[part]], "rows": lines})
    return tables


def _named(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _explained(units: Mapping[str, str], means: Meanings) -> list[dict[str, str]]:
    """Return the heads of rows, each with what it means where the row above it does not say so already."""
    heads, above = [], ""
    for name, unit in units.items():
        meaning = means.get(name, ("", ""))[1]
        heads.append({"name": _named(name, unit), "note": "" if meaning == above else meaning})
        above = meaning
    return heads


def _glossary(names: Sequence[str], means: Meanings) -> str:
    return "; ".join(f"{name}: {means[name][1]}" for name in names if name in means) + "."


def _cell(name: str, figure: Mapping[str, Any] | None, unit: str) -> Any:
    """Return a cell, with the figure's unit where the head of its row or column has none."""
    if figure is None:
        return ""
    # A rate of falls has no number of robots: what it is from are the falls.
    count = f"falls {figure['n']}" if name == "falls_per_minute" else f"n {figure['n']}"
    cell = spread(figure["estimate"], figure["low"], figure["high"], count)
    return cell if unit else {**cell, "value": f"{cell['value']} {figure['unit']}".rstrip()}
