"""Tables of protocols: claims with their verdicts, and quantities with interval and n by condition."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from go1exp.base.report.table import Cell, Table, spread, verdict
from go1exp.base.wording import counted
from go1exp.evaluate.protocol.claims import limits
from go1exp.evaluate.protocol.ground import UNITS
from go1exp.evaluate.protocol.playing import Result
from go1exp.evaluate.quantities import ROBOT

Entry = Mapping[str, Any]
Meanings = Mapping[str, tuple[str, str]]

ACROSS = 5
"""Most columns of quantities in a table, so that it fits on paper."""

MANY = 8
"""Largest number of conditions that are columns; more are rows."""

COMMAND = ("x", "y", "yaw")

KEYS: dict[str, tuple[str, str]] = {
    "x": ("x", "m/s"),
    "y": ("y", "m/s"),
    "yaw": ("yaw", "rad/s"),
    "amplitude": ("amplitude", "x m/s, y m/s, yaw rad/s"),
    "period": ("period", "s"),
    "impulse": ("impulse", "N s"),
    "direction_deg": ("direction", "deg"),
    "rate_hz": ("rate", "Hz"),
    "delay_ms": ("delay", "ms"),
    "speed": ("speed", "m/s"),
}
"""Key of a condition -> word and unit; other keys stand for themselves, without a unit."""

VERDICTS = (
    "The whole 95 % interval, in brackets, decides. met: it is within the limit; close: it exceeds, or may exceed,"
    " the limit by no more than the claim's tolerance; not met: it is beyond the limit, and the value by more than the"
    " tolerance; inconclusive: it is too wide, play more robots. n: number of robots."
)


# ---------------------------------------------------------------------- conditions


def condition_text(condition: Mapping[str, Any]) -> str:
    """Return a condition as text; of a command, the axes that are not zero."""
    moving = any(condition.get(axis) for axis in COMMAND)
    shown = {k: v for k, v in condition.items() if v or k not in COMMAND or not moving}
    return ", ".join(_value(k, v, condition) for k, v in shown.items()) or "all"


def _value(key: str, value: Any, condition: Mapping[str, Any]) -> str:
    word, unit = KEYS.get(key, (key.replace("_", " "), ""))
    if key == "difficulty":
        unit = UNITS.get(str(condition.get("ground")), "")
    text = f"{value:.4g}" if isinstance(value, float) else str(value).replace("_", " ")
    return f"{word} {text} {unit}".rstrip() if key != "amplitude" else f"{word} {text}"


def falls(result: Result) -> str:
    """Return the number of falls in one line."""
    rows = result.played.rows
    minutes = sum(row["moving_s"] for row in rows) / 60.0
    count, left = (sum(bool(row[k]) for row in rows) for k in ("fell", "left_map"))
    text = f"{counted(count, 'fall')}, {left} left the map, in {minutes:.1f} moving robot-minutes ({len(rows)} rows)"
    down = len({row[ROBOT] for row in rows} - {row[ROBOT] for row in rows if row["fell"] is not None})
    return text + (f"; {counted(down, 'robot')} fell before anything counted." if down else ".")


# ---------------------------------------------------------------------- tables


def meanings(result: Result) -> dict[str, tuple[str, str]]:
    """Return the unit and the meaning of each quantity by its name."""
    protocol = result.chosen.protocol
    columns = {c.name: (c.unit, _plain(c.meaning)) for c in protocol.columns()}
    derived = {d.name: (d.unit, d.meaning) for d in protocol.derived(result.played.rows)}
    return {**columns, "falls_per_minute": ("1/min", "falls per moving robot-minute"), **derived}


def _plain(docstring: str) -> str:
    """Return a docstring without the shape of values and without markup."""
    return re.sub(r" \((?:N|S|4|,| )+\)", "", docstring).replace("`", "")


def claims_table(result: Result, means: Meanings) -> Table:
    """Return the verdicts as a table."""
    rows = []
    for v in result.verdicts:
        where = condition_text(v.condition) + (f" (worst of {v.conditions})" if v.conditions > 1 else "")
        unit = _unit(v.claim.quantity, [e for e in result.summary if e["condition"] == v.condition])
        limit = f"{limits(v.claim)} {unit}".rstrip()
        value = spread(v.figure.estimate, v.figure.low, v.figure.high, f"n {v.figure.n}")
        quantity = Cell(v.claim.quantity, means.get(v.claim.quantity, ("", ""))[1], "name")
        rows.append([v.name.replace("_", " "), verdict(v.word), value, limit, quantity, where, v.claim.source])
    header = ["claim", "verdict", "value [95 %] n", "limit", "quantity", "where", "source of the limit"]
    return Table("Claims", header, rows, VERDICTS if rows else "None.")


def figure_tables(entries: Sequence[Entry], means: Meanings) -> list[Table]:
    """Return the quantities in tables, one for each set of keys of the conditions.

    A row is a quantity and a column a condition; with many conditions, the other way round.
    """
    groups: dict[tuple[str, ...], list[Entry]] = {}
    for entry in _merged(entries):
        groups.setdefault(tuple(entry["condition"]), []).append(entry)
    tables = []
    for keys, those in groups.items():
        units = {name: _unit(name, those) for name in _names(those)}
        where = [condition_text(e["condition"]) for e in those] if keys else ["value [95 %] n"]
        title = f"Results by {', '.join(map(_key_text, keys))}" if keys else "Results of all robots"
        cells = [[_cell(name, e["figures"].get(name), unit) for e in those] for name, unit in units.items()]
        if len(those) <= MANY:
            tables += _split(title, "quantity", _explained(units, means), where, cells)
        else:
            across: list[list[Any]] = [list(column) for column in zip(*cells, strict=True)]
            notes = [f"{name}: {means[name][1]}" if name in means else "" for name in units]
            tables += _split(title, "condition", where, [_named(*head) for head in units.items()], across, notes)
    return tables


def _key_text(key: str) -> str:
    return _named(*KEYS.get(key, (key.replace("_", " "), "")))


def _named(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _unit(name: str, entries: Sequence[Entry]) -> str:
    """Return the unit of a quantity in some entries; empty where units differ, as difficulties of grounds do."""
    units = {e["figures"][name]["unit"] for e in entries if name in e["figures"]}
    return units.pop() if len(units) == 1 else ""


def _merged(entries: Sequence[Entry]) -> list[Entry]:
    """Return one entry for each condition, with all its quantities."""
    merged: dict[tuple[Any, ...], dict[str, Any]] = {}
    for entry in entries:
        one = merged.setdefault(tuple(entry["condition"].items()), {"condition": entry["condition"], "figures": {}})
        one["figures"] |= entry["figures"]
    return list(merged.values())


def _names(entries: Sequence[Entry]) -> list[str]:
    """Return the quantities of some entries: falls first, without time in motion and without an unused ``left_map``."""
    names = dict.fromkeys(name for e in entries for name in e["figures"])
    names.pop("moving_s", None)
    if not any(e["figures"].get("left_map", {}).get("estimate") for e in entries):
        names.pop("left_map", None)
    first = [name for name in ("fell", "falls_per_minute") if name in names]
    return [*first, *(name for name in names if name not in first)]


def _split(
    title: str, corner: str, rows: Sequence[Any], columns: Sequence[str], cells: Any, notes: Sequence[str] = ()
) -> list[Table]:
    """Return tables of at most ``ACROSS`` equally many columns beside the first, without rows that are empty."""
    wide = math.ceil(len(columns) / math.ceil(len(columns) / ACROSS))
    tables = []
    for start in range(0, len(columns), wide):
        part = slice(start, start + wide)
        lines = [[row, *line[part]] for row, line in zip(rows, cells, strict=True) if any(line[part])]
        note = "; ".join(filter(None, notes[part]))
        named = f"{title}, continued" if start else title
        tables.append(Table(named, [corner, *columns[part]], lines, f"{note}." if note else ""))
    return tables


def _explained(units: Mapping[str, str], means: Meanings) -> list[Cell]:
    """Return the heads of rows, each with its meaning unless the row above has the same."""
    heads, above = [], ""
    for name, unit in units.items():
        meaning = means.get(name, ("", ""))[1]
        heads.append(Cell(_named(name, unit), "" if meaning == above else meaning, "name"))
        above = meaning
    return heads


def _cell(name: str, figure: Mapping[str, Any] | None, unit: str) -> Cell | str:
    """Return a cell, with the unit where the head of its row or column has none."""
    if figure is None:
        return ""
    # A rate of falls is estimated from the falls, not from a number of robots.
    count = f"falls {figure['n']}" if name == "falls_per_minute" else f"n {figure['n']}"
    cell = spread(figure["estimate"], figure["low"], figure["high"], count)
    return cell if unit else Cell(f"{cell.text} {figure['unit']}".rstrip(), cell.detail, cell.look)
