"""The page of a protocol and that of a comparison: words, tables and drawings in one file."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from go1exp.gap.report.svg import draw
from go1exp.protocol.base import Drawing, Protocol
from go1exp.protocol.claims import limits
from go1exp.protocol.result import Result

Table = dict[str, Any]


def page(result: Result) -> str:
    """Return the page of one protocol, one HTML document."""
    protocol = result.chosen.protocol
    drawings = protocol.drawings(result.played, result.summary)
    count = len(result.played.rows)
    settings = {"settings": dataclasses.asdict(protocol), **result.about}
    return rendered(
        title=f"{result.chosen.key}: {result.label}",
        kind=f"go1exp eval · protocol={result.chosen.key}",
        heading=result.label,
        about=_sentence(protocol),
        facts=[falls(result), *result.played.notes],
        tables=[claims_table(result), *figure_tables(result.summary, meanings(protocol))],
        drawings=drawings,
        notes=[
            f"{count} rows, one for each robot in each condition"
            + (f"; {result.repeats} repeated another one bit for bit and do not count" if result.repeats else "")
            + f"; {result.seconds:.0f} s.",
            "Figures: mean over robots with Student's 95 % interval; shares with Wilson's; falls per moving robot-"
            "minute with Garwood's; thresholds by the bootstrap over robots. In brackets: interval; n: robots with a"
            " value.",
        ],
        settings=json.dumps(settings, indent=1, default=str),
    )


def rendered(drawings: Sequence[Drawing], **context: Any) -> str:
    """Return the page with these words, tables and drawings."""
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    painted = [(d, draw(d.name, f"{d.title}. {d.caption}", d.paint)) for d in drawings]
    return environment.get_template("template.html.j2").render(drawings=painted, **context)


def _sentence(protocol: Protocol) -> str:
    return (type(protocol).__doc__ or "").strip().split("\n")[0]


def falls(result: Result) -> str:
    """Say in a line how many robots fell."""
    rows = result.played.rows
    minutes = sum(row["moving_s"] for row in rows) / 60.0
    count, left = (sum(bool(row[k]) for row in rows) for k in ("fell", "left_map"))
    return f"{count} falls, {left} left the map, in {len(rows)} episodes and {minutes:.1f} moving robot-minutes."


def meanings(protocol: Protocol) -> dict[str, tuple[str, str]]:
    """Return the unit and the meaning of each figure by its name."""
    units = {c.name: (c.unit, c.meaning) for c in protocol.columns()}
    return {**units, "falls_per_minute": ("1/min", "falls per moving robot-minute")}


def claims_table(result: Result) -> Table:
    """Return the verdicts as a table."""
    rows = []
    for v in result.verdicts:
        where = condition_text(v.condition) + (f" (worst of {v.conditions})" if v.conditions > 1 else "")
        value = interval_text(v.figure.estimate, v.figure.low, v.figure.high)
        name = v.name.replace("_", " ")
        rows.append(
            [name, {"word": v.word}, v.claim.quantity, limits(v.claim), value, v.figure.n, where, v.claim.source]
        )
    header = ["claim", "verdict", "figure", "limit", "value [95 %]", "n", "where", "limit's source"]
    note = "reached: the whole interval keeps the limit; not told: n is too small to say." if rows else "None."
    return {"title": "Claims", "note": note, "header": header, "rows": rows}


ACROSS = 4
"""Most columns of figures in a table, so that it fits on paper."""


def figure_tables(entries: Sequence[Mapping[str, Any]], units: Mapping[str, tuple[str, str]]) -> list[Table]:
    """Return the figures in tables, by what their conditions are made of.

    A row is a figure and a column a condition; where conditions are many, the other way round.
    """
    groups: dict[tuple[str, ...], list[Mapping[str, Any]]] = {}
    for entry in entries:
        groups.setdefault((*entry["condition"], *([] if len(entry["figures"]) > 1 else ["*"])), []).append(entry)
    tables = []
    for keys, those in groups.items():
        names = list(dict.fromkeys(name for e in those for name in e["figures"]))
        labels = [_named(name, units, those) for name in names]
        where = [condition_text(e["condition"]) for e in those]
        cells = [[_cell(e["figures"].get(name)) for e in those] for name in names]
        title = "Figures by " + ", ".join(k for k in keys if k != "*") if keys != ("*",) else "Figures of all"
        if len(those) <= MANY and len(names) > 1:
            tables += _split(title, "figure", labels, where, cells)
        else:
            tables += _split(title, "condition", where, labels, [list(column) for column in zip(*cells, strict=True)])
    return tables


MANY = 8
"""More conditions than these are rows."""


def _split(title: str, corner: str, rows: Sequence[str], columns: Sequence[str], cells: Any) -> list[Table]:
    """Return tables of at most ``ACROSS`` columns beside the first."""
    tables = []
    for k in range(0, len(columns), ACROSS):
        part = slice(k, k + ACROSS)
        lines = [[row, *line[part]] for row, line in zip(rows, cells, strict=True)]
        header = [corner, *columns[part]]
        tables.append({"title": title if not k else f"{title}, continued", "note": "", "header": header, "rows": lines})
    return tables


def _named(name: str, units: Mapping[str, tuple[str, str]], entries: Sequence[Mapping[str, Any]]) -> str:
    unit = (
        units[name][0] if name in units else next(e["figures"][name]["unit"] for e in entries if name in e["figures"])
    )
    return f"{name} ({unit})" if unit else name


def condition_text(condition: Mapping[str, Any]) -> str:
    """Write a condition."""
    return (
        ", ".join(
            f"{k.replace('_', ' ')} {v:g}" if isinstance(v, float) else f"{k.replace('_', ' ')} {v}"
            for k, v in condition.items()
        )
        or "all"
    )


def _cell(figure: Mapping[str, Any] | None) -> str:
    if figure is None:
        return ""
    return f"{interval_text(figure['estimate'], figure['low'], figure['high'])} n {figure['n']}"


def interval_text(estimate: float | None, low: float | None, high: float | None) -> str:
    """Write a figure with its interval."""
    if estimate is None or estimate != estimate:
        return "–"
    if low is None or high is None or low != low:
        return f"{estimate:.3g}"
    return f"{estimate:.3g} [{low:.3g}, {high:.3g}]"
