"""The files of a report: one page, one JSON file, and a CSV file for each table."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from go1exp.base.files import write_json, write_text
from go1exp.evaluate.protocol.report.html import rendered, settings_text
from go1exp.evaluate.report.drawings import forests, importances, learning
from go1exp.evaluate.report.made import Report
from go1exp.evaluate.report.tables import ORDER, PlainRow, plain_rows, tables
from go1exp.evaluate.rows import finite

NOTES = (
    "A run is one training seed, and figures are over runs: robots that one policy moved are not independent tries of a"
    " configuration. Intervals of 95 % are studentised, their critical values simulated for each number of runs"
    " (docs/studies.md has their measured coverage); of shares: Wilson's with the design effect of the runs.",
    "Comparisons: permutation test of mean ranks over runs, two-sided, Holm's correction over all comparisons of an"
    " evaluation. Evaluations count where their settings, commands and seed are the same for all.",
)


def page(made: Report) -> str:
    """Return the page, one HTML document that needs no other file."""
    count = sum(len(g.runs) for g in made.groups)
    drawings = learning(made.curves, made.baseline.name)
    for outcome in made.outcomes:
        key = outcome.judged.name
        drawings += forests(outcome.figures, outcome.judged.main, made.baseline.name, key)
        drawings += importances(outcome.sensitivities, key)
    names = ", ".join(dict.fromkeys(Path(f).resolve().name for f in made.settings["folders"]))
    absent = made.study.absent
    facts = [f"{len(absent)} runs do not count; they are listed below."] if absent else []
    evaluated = {o.judged.name: o.judged.settings for o in made.outcomes}
    return rendered(
        title=f"report: {names}",
        kind="go1exp report",
        heading=names,
        about=f"{count} runs in {len(made.groups)} groups; baseline: {made.baseline.name}.",
        verdicts=_head(made),
        facts=[*facts, *made.study.notes],
        tables=tables(made),
        drawings=drawings,
        notes=NOTES,
        settings=settings_text({**made.settings, "evaluations": evaluated}),
    )


def _head(made: Report) -> list[tuple[str, str]]:
    """Return each word with the groups and figures that have it, for the page's head."""
    lines = []
    for word in ORDER:
        those = [(o.judged.name, v) for o in made.outcomes for v in o.verdicts if v.word == word]
        text = "; ".join(f"{v.group}: {v.column.name}" for _, v in those)
        if those:
            lines.append((f"{word}: {len(those)}", text if word != ORDER[-1] else "comparisons, listed below"))
    return lines


def csv_text(rows: Sequence[PlainRow]) -> str:
    """Return rows as CSV with a header; numbers that are not defined are empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    for row in rows:
        writer.writerow([_cell(row.get(name, "")) for name in names])
    return text.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else ""
    return value


def write(made: Report, folder: Path) -> list[Path]:
    """Write report.html, report.json and the CSV files into ``folder``, which is made if need be; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = plain_rows(made)
    content = {
        **made.settings,
        "groups": [{"name": g.name, "settings": g.settings, "runs": [r.label for r in g.runs]} for g in made.groups],
        "baseline": made.baseline.name,
        "absent": [vars(a) for a in made.study.absent],
        "notes": made.study.notes,
        **{name: those for name, those in rows.items() if name != "curves"},
    }
    files = [folder / "report.html", folder / "report.json"]
    write_text(files[0], page(made))
    write_json(files[1], finite(content), indent=1, allow_nan=False)
    for name, those in rows.items():
        files.append(folder / f"{name}.csv")
        write_text(files[-1], csv_text(those))
    return files
