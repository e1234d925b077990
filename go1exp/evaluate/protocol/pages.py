"""Reports of protocols and of comparisons: tables, one HTML page each, and the files of a protocol."""

from __future__ import annotations

import dataclasses
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from go1exp.base.files import write_json, write_text
from go1exp.base.report.page import Page, provenance, render, sections
from go1exp.base.report.table import Cell, Table, number, spread, verdict
from go1exp.base.wording import counted
from go1exp.evaluate.protocol.claims import ORDER, limits
from go1exp.evaluate.protocol.comparing import Difference
from go1exp.evaluate.protocol.ground import UNITS
from go1exp.evaluate.protocol.playing import Result, as_json
from go1exp.evaluate.quantities import ROBOT, finite, write_rows
from go1exp.evaluate.statistics.intervals import Estimate, SummaryEntry
from go1exp.evaluate.statistics.runs import ORDER as COMPARED

Cells = Sequence[Cell | str]
Meanings = Mapping[str, str]
ACROSS = 5  # most columns of quantities in a table, so that it fits on paper
MANY = 8  # largest number of conditions that are columns; more are rows
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


def condition_text(condition: Mapping[str, float | str]) -> str:
    """Return a condition as text; of a command, the axes that are not zero."""
    moving = any(condition.get(axis) for axis in COMMAND)
    shown = {k: v for k, v in condition.items() if v or k not in COMMAND or not moving}
    return ", ".join(_value(k, v, condition) for k, v in shown.items()) or "all"


def _value(key: str, value: float | str, condition: Mapping[str, float | str]) -> str:
    word, unit = KEYS.get(key, (key.replace("_", " "), ""))
    if key == "difficulty":
        unit = UNITS.get(str(condition.get("ground")), "")
    text = f"{value:.4g}" if isinstance(value, float) else str(value).replace("_", " ")
    return f"{word} {text} {unit}".rstrip() if key != "amplitude" else f"{word} {text}"


def named(name: str, unit: str) -> str:
    """Return a name with its unit, if it has one."""
    return f"{name} ({unit})" if unit else name


def falls(result: Result) -> str:
    """Return the number of falls in one line."""
    rows = result.played.rows
    minutes = sum(row["moving_s"] for row in rows) / 60.0
    count, left = (sum(bool(row[k]) for row in rows) for k in ("fell", "left_map"))
    text = f"{counted(count, 'fall')}, {left} left the map, in {minutes:.1f} moving robot-minutes ({len(rows)} rows)"
    down = len({row[ROBOT] for row in rows} - {row[ROBOT] for row in rows if row["fell"] is not None})
    return text + (f"; {counted(down, 'robot')} fell before anything counted." if down else ".")


def meanings(result: Result) -> dict[str, str]:
    """Return the meaning of each quantity by its name, without the shape of values and without markup."""
    protocol = result.chosen.protocol
    columns = {c.name: re.sub(r" \((?:N|S|4|,| )+\)", "", c.meaning).replace("`", "") for c in protocol.columns()}
    derived = {d.name: d.meaning for d in protocol.derived(result.played.rows)}
    return {**columns, "falls_per_minute": "falls per moving robot-minute", **derived}


def claims_table(result: Result, means: Meanings) -> Table:
    """Return the verdicts as a table."""
    rows = []
    for v in result.verdicts:
        where = condition_text(v.condition) + (f" (worst of {v.conditions})" if v.conditions > 1 else "")
        unit = _unit(v.claim.quantity, [e for e in result.summary if e["condition"] == v.condition])
        limit = f"{limits(v.claim)} {unit}".rstrip()
        value = spread(v.figure.estimate, v.figure.low, v.figure.high, f"n {v.figure.n}")
        quantity = Cell(v.claim.quantity, means.get(v.claim.quantity, ""), "name")
        rows.append([v.name.replace("_", " "), verdict(v.word), value, limit, quantity, where, v.claim.source])
    header = ["claim", "verdict", "value [95 %] n", "limit", "quantity", "where", "source of the limit"]
    return Table("Claims", header, rows, VERDICTS if rows else "None.")


def figure_tables(entries: Sequence[SummaryEntry], means: Meanings) -> list[Table]:
    """Return the quantities in tables, one for each set of keys of the conditions.

    A row is a quantity and a column a condition; with many conditions, the other way round.
    """
    groups: dict[tuple[str, ...], list[SummaryEntry]] = {}
    for entry in _merged(entries):
        groups.setdefault(tuple(entry["condition"]), []).append(entry)
    tables = []
    for keys, those in groups.items():
        units = {name: _unit(name, those) for name in _names(those)}
        where = [condition_text(e["condition"]) for e in those] if keys else ["value [95 %] n"]
        by = ", ".join(named(*KEYS.get(key, (key.replace("_", " "), ""))) for key in keys)
        title = f"Results by {by}" if keys else "Results of all robots"
        cells = [[_cell(name, e["figures"].get(name), unit) for e in those] for name, unit in units.items()]
        if len(those) <= MANY:
            tables += _split(title, "quantity", _explained(units, means), where, cells)
        else:
            across = list(zip(*cells, strict=True))
            notes = [f"{name}: {means[name]}" if name in means else "" for name in units]
            tables += _split(title, "condition", where, [named(*head) for head in units.items()], across, notes)
    return tables


def _unit(name: str, entries: Sequence[SummaryEntry]) -> str:
    """Return the unit of a quantity in some entries; empty where units differ, as difficulties of grounds do."""
    units = {e["figures"][name]["unit"] for e in entries if name in e["figures"]}
    return units.pop() if len(units) == 1 else ""


def _merged(entries: Sequence[SummaryEntry]) -> list[SummaryEntry]:
    merged: dict[tuple[tuple[str, float | str], ...], SummaryEntry] = {}
    for entry in entries:
        one = merged.setdefault(tuple(entry["condition"].items()), {**entry, "figures": {}})
        one["figures"] |= entry["figures"]
    return list(merged.values())


def _names(entries: Sequence[SummaryEntry]) -> list[str]:
    """Return the quantities of some entries: falls first, without time in motion and without an unused ``left_map``."""
    names = dict.fromkeys(name for e in entries for name in e["figures"])
    names.pop("moving_s", None)
    if not any(e["figures"]["left_map"]["estimate"] for e in entries if "left_map" in e["figures"]):
        names.pop("left_map", None)
    first = [name for name in ("fell", "falls_per_minute") if name in names]
    return [*first, *(name for name in names if name not in first)]


def _split(
    title: str, corner: str, rows: Cells, columns: Sequence[str], cells: Sequence[Cells], notes: Sequence[str] = ()
) -> list[Table]:
    """Return tables of at most ``ACROSS`` equally many columns beside the first, without rows that are empty."""
    wide = math.ceil(len(columns) / math.ceil(len(columns) / ACROSS))
    tables = []
    for start in range(0, len(columns), wide):
        part = slice(start, start + wide)
        lines = [[row, *line[part]] for row, line in zip(rows, cells, strict=True) if any(line[part])]
        note = "; ".join(filter(None, notes[part]))
        whole = f"{title}, continued" if start else title
        tables.append(Table(whole, [corner, *columns[part]], lines, f"{note}." if note else ""))
    return tables


def _explained(units: Mapping[str, str], means: Meanings) -> list[Cell]:
    """Return the heads of rows, each with its meaning unless the row above has the same."""
    heads, above = [], ""
    for name, unit in units.items():
        meaning = means.get(name, "")
        heads.append(Cell(named(name, unit), "" if meaning == above else meaning, "name"))
        above = meaning
    return heads


def _cell(name: str, figure: Estimate | None, unit: str) -> Cell | str:
    """Return a cell, with the unit where the head of its row or column has none."""
    if figure is None:
        return ""
    # A rate of falls is estimated from the falls, not from a number of robots.
    count = f"falls {figure['n']}" if name == "falls_per_minute" else f"n {figure['n']}"
    cell = spread(figure["estimate"], figure["low"], figure["high"], count)
    return cell if unit else Cell(f"{cell.text} {figure['unit']}".rstrip(), cell.detail, cell.look)


INTERVALS = (
    "Mean over robots with Student's 95 % interval; shares with Wilson's; falls per moving robot-minute with Garwood's;"
    " thresholds by the bootstrap over robots. n: number of robots with a value. With few robots, intervals are wide"
    " and may exceed the possible range."
)

DIFFERENCES = (
    "better, worse: the 95 % interval of the difference, in brackets, excludes zero; no significant difference: the"
    " interval includes zero, or there are fewer than three pairs. n: number of pairs, robots with a value for both."
    " Pairs needed: sample size for 80 % power."
)

PAIRING = (
    "All subjects play the same protocol with the same seed and the same randomisation, robot by robot. Difference ="
    " other - first, over robots with a value for both; walking quantities exclude robots that fell with either.",
    "Intervals of 95 %: Student's over robots; shares by Agresti and Min; figures of all robots together by the"
    " bootstrap. One in twenty equal quantities is expected to differ significantly by chance.",
)


def page(result: Result) -> str:
    """Return the page of one protocol, one HTML document."""
    protocol, means = result.chosen.protocol, meanings(result)
    repeats = f"; {result.repeats} bit-identical repeats excluded" if result.repeats else ""
    count = f"{len(result.played.rows)} rows, one per robot and condition{repeats}; {result.seconds:.0f} s."
    of_words = {w: [v.name.replace("_", " ") for v in result.verdicts if v.word == w] for w in reversed(ORDER)}
    settings = {"settings": dataclasses.asdict(protocol), **result.about}
    tables = [claims_table(result, means), *figure_tables(result.summary, means)]
    content = sections(tables, protocol.drawings(result.played, result.summary))
    return render(
        Page(
            title=f"{result.chosen.key}: {result.label}",
            kind=f"go1exp eval · protocol={result.chosen.key}",
            heading=result.label,
            lead=(type(protocol).__doc__ or "").strip().split("\n")[0],
            verdicts=[(f"{word}: {len(names)}", ", ".join(names)) for word, names in of_words.items() if names],
            facts=[falls(result), *result.played.notes],
            sections=[*content, provenance([count, INTERVALS], settings)],
        )
    )


def write(result: Result, folder: Path) -> list[Path]:
    """Write NAME.parquet, NAME.json and NAME.html into ``folder``, which is created if missing; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{result.chosen.key}.{kind}" for kind in ("parquet", "json", "html")]
    write_rows(files[0], result.played.rows, {"protocol": result.chosen.key, "subject": result.label})
    write_json(files[1], finite(as_json(result)), indent=1, allow_nan=False)
    write_text(files[2], page(result))
    return files


def comparison(
    plays: Mapping[str, Sequence[Result]], differences: Mapping[str, Sequence[Difference]], about: Mapping[str, object]
) -> str:
    """Return the page of a comparison."""
    tables, drawings = [_counts(differences)], []
    for key, results in plays.items():
        tables.append(_differences(key, differences[key], results[0].label, meanings(results[0])))
        played, summaries = {r.label: r.played for r in results}, {r.label: r.summary for r in results}
        drawings += [
            dataclasses.replace(d, name=f"{key}-{d.name}", title=f"{key}: {d.title}")
            for d in results[0].chosen.protocol.compared(played, summaries)
        ]
    labels = [r.label for r in next(iter(plays.values()))]
    words = [(d.verdict, f"{key}, {d.subject}: {d.figure}") for key, those in differences.items() for d in those]
    return render(
        Page(
            title=" vs. ".join(labels),
            kind="go1exp compare",
            heading=" · ".join(labels),
            lead=f"Comparison with {labels[0]}, paired by robot.",
            verdicts=by_word(words),
            facts=[f"{r.chosen.key}, {r.label}: {falls(r)}" for results in plays.values() for r in results],
            sections=[*sections(tables, drawings), provenance(PAIRING, about)],
        )
    )


def by_word(named_verdicts: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return each word of comparisons with the names that have it, for the page's head; of pairs (word, name)."""
    lines = []
    for word in COMPARED:
        counts = Counter(name for of_name, name in named_verdicts if of_name == word)
        text = "; ".join(f"{name} (in {n} conditions)" if n > 1 else name for name, n in counts.items())
        if counts:
            lines.append((f"{word}: {counts.total()}", text if word != COMPARED[-1] else "listed below"))
    return lines


def _counts(differences: Mapping[str, Sequence[Difference]]) -> Table:
    rows = []
    for key, those in differences.items():
        for subject in dict.fromkeys(d.subject for d in those):
            words = [d.verdict for d in those if d.subject == subject]
            rows.append([key, subject, *(words.count(w) for w in COMPARED)])
    return Table("Verdicts", ["protocol", "subject", *COMPARED], rows, DIFFERENCES)


def _differences(key: str, differences: Sequence[Difference], first: str, means: Meanings) -> Table:
    """Return the significant differences, then the others; quantities that are 0 for all subjects stand in the note."""
    quantities = list(dict.fromkeys(d.figure for d in differences))
    not_zero = {d.figure for d in differences if d.first != 0.0 or d.other != 0.0}
    zero = [name for name in quantities if name not in not_zero]
    subjects = list(dict.fromkeys(d.subject for d in differences))
    rows, above = [], ""
    for d in sorted(differences, key=lambda d: (COMPARED.index(d.verdict), quantities.index(d.figure))):
        if d.figure in zero:
            continue
        meaning = "" if d.figure == above else means.get(d.figure, "")
        head, above = Cell(named(d.figure, d.unit), meaning, "name"), d.figure
        between = spread(d.difference.estimate, d.difference.low, d.difference.high, f"n {d.difference.n}")
        who = [d.subject] if len(subjects) > 1 else []
        where, needed = condition_text(d.condition), "" if d.pairs_needed is None else d.pairs_needed
        rows.append([head, verdict(d.verdict), *who, where, number(d.first), number(d.other), between, needed])
    other = ["subject", "where", first, "subject's"] if len(subjects) > 1 else ["where", first, *subjects]
    header = ["quantity", "verdict", *other, "difference [95 %] n", "pairs needed"]
    return Table(key, header, rows, f"Omitted, 0 for all subjects: {', '.join(zero)}." if zero else "")
