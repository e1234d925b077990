"""The files of a report: one page, one JSON file, and a CSV file for each table."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from go1exp.base.files import write_json, write_text
from go1exp.base.report.page import Page, provenance, render, sections
from go1exp.base.wording import counted
from go1exp.evaluate.report.drawings import forests, importances, learning, looks
from go1exp.evaluate.report.made import Report
from go1exp.evaluate.report.tables import PlainRow, about_baseline, plain_rows, tables
from go1exp.evaluate.rows import finite
from go1exp.evaluate.statistics.compare import ORDER

NOTES = (
    "A run is one training seed, and intervals are over runs: robots moved by one policy are no independent samples of"
    " a configuration. Intervals of 95 % are studentised, with critical values simulated for each number of runs"
    " (docs/notebook/studies.md has their measured coverage); of shares: Wilson's with the design effect of the runs.",
    "Comparisons: permutation test of mean ranks over runs, two-sided, with Holm's correction over all comparisons of"
    " an evaluation. Evaluations are included if their settings, commands and seed are the same for all.",
)


def page(made: Report) -> str:
    """Return the page, one HTML document that needs no other file."""
    count = sum(len(g.runs) for g in made.groups)
    of_groups = looks([g.name for g in made.groups])
    drawings = learning(made.curves, made.baseline.name, of_groups)
    for outcome in made.outcomes:
        key = outcome.evaluation.name
        drawings += forests(outcome.figures, outcome.evaluation.main, made.baseline.name, key, of_groups)
        drawings += importances(outcome.sensitivities, key)
    names = ", ".join(dict.fromkeys(Path(f).resolve().name for f in made.settings["folders"]))
    excluded = len(made.study.absent)
    evaluated = {o.evaluation.name: o.evaluation.settings for o in made.outcomes}
    return render(
        Page(
            title=f"report: {names}",
            kind="go1exp report",
            heading=names,
            lead=f"{counted(count, 'run')} in {counted(len(made.groups), 'group')}; {about_baseline(made)}.",
            verdicts=_head(made),
            facts=[*([f"{counted(excluded, 'run')} excluded, listed below."] * bool(excluded)), *made.study.notes],
            sections=[
                *sections(tables(made), drawings),
                provenance(NOTES, {**made.settings, "evaluations": evaluated}),
            ],
        )
    )


def _head(made: Report) -> list[tuple[str, str]]:
    """Return each word with the groups and quantities that have it, for the page's head."""
    lines = []
    for word in ORDER:
        those = [f"{v.group}: {v.column.name}" for o in made.outcomes for v in o.verdicts if v.word == word]
        if those:
            lines.append((f"{word}: {len(those)}", "; ".join(those) if word != ORDER[-1] else "listed below"))
    return lines


def csv_text(rows: Sequence[PlainRow]) -> str:
    """Return rows as CSV with a header; undefined numbers are empty."""
    text = io.StringIO(newline="")
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else ""
    return value


def write(made: Report, folder: Path) -> list[Path]:
    """Write report.html, report.json and the CSV files into ``folder``, created if missing; return the files."""
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
