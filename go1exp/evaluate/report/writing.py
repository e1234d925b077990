"""Drawings and files of a report: one page, one JSON file, and a CSV file for each table."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np

from go1exp.base.files import write_json, write_text
from go1exp.base.report import plots
from go1exp.base.report.page import Page, provenance, render, sections
from go1exp.base.report.plots import COLOURS, WIDE, Drawing, band, legend, listing, panels
from go1exp.base.wording import counted
from go1exp.evaluate.protocol.pages import by_word, named
from go1exp.evaluate.quantities import finite
from go1exp.evaluate.report.curves import AXES, Curve, Floats
from go1exp.evaluate.report.results import Figure, Report, Sensitivity
from go1exp.evaluate.report.tables import SOURCES, PlainRow, about_baseline, plain_rows, tables

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
            verdicts=by_word([(v.word, f"{v.group}: {v.column.name}") for o in made.outcomes for v in o.verdicts]),
            facts=[*([f"{counted(excluded, 'run')} excluded, listed below."] * bool(excluded)), *made.study.notes],
            sections=[
                *sections(tables(made), drawings),
                provenance(NOTES, {**made.settings, "evaluations": evaluated}),
            ],
        )
    )


def csv_text(rows: Sequence[PlainRow]) -> str:
    """Return rows as CSV with a header; undefined numbers are empty."""
    text = io.StringIO(newline="")
    names = list(dict.fromkeys(name for row in rows for name in row))
    writer = csv.DictWriter(text, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()


def _cell(value: object) -> object:
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


FEW = 6  # largest number of groups that are all drawn with bands; of more, only the baseline's band is drawn
STYLES = ("-", "--", ":", "-.")
MOST = 12  # quantities of a sensitivity that are drawn


def short(name: str, letters: int) -> str:
    """Return a name cut to a number of letters."""
    return name if len(name) <= letters else f"{name[: letters - 1]}…"


Looks = Mapping[str, tuple[str, str]]  # group -> colour and line style, the same in all figures of a report


def looks(groups: Sequence[str]) -> Looks:
    """Return colour and line style of each group."""
    return dict(zip(groups, cycle([(c, s) for s in STYLES for c in COLOURS]), strict=False))


def learning(curves: Sequence[Curve], baseline: str, of_groups: Looks) -> list[Drawing]:
    """Return one drawing for each metric, over steps and over time."""
    drawings = []
    for number, metric in enumerate(dict.fromkeys(c.metric for c in curves)):
        of_metric = [c for c in curves if c.metric == metric]
        caption = (
            "Interquartile mean over runs; band: 95 % interval over runs. Curves end at the shortest run of a group."
        )
        if len({c.group for c in of_metric}) > FEW:
            caption += f" With so many groups, only the band of the baseline ({baseline}) is drawn."
        paint = partial(_learning, of_metric, baseline, of_groups)
        drawings.append(Drawing(f"curve{number}", metric, caption, paint, wide=True))
    return drawings


def _learning(curves: Sequence[Curve], baseline: str, of_groups: Looks) -> plots.Figure:
    axes_drawn = [axis for axis in AXES if any(c.axis == axis for c in curves)]
    names = list(dict.fromkeys(c.group for c in curves))
    figure, axes = panels(1, len(axes_drawn), height=2.9, width=WIDE, sharey=True)
    for panel, axis in zip(axes[0], axes_drawn, strict=True):
        of_axis = [c for c in curves if c.axis == axis]
        banded = [c for c in of_axis if len(names) <= FEW or c.group == baseline]
        for curve in of_axis:
            colour, style = of_groups[curve.group]
            if curve in banded:
                band(panel, curve.x, curve.low, curve.high, colour)
            width = 1.8 if curve.group == baseline else 1.1
            name = f"{short(curve.group, 42)} (n {curve.runs})"
            panel.plot(curve.x, curve.middle, style, color=colour, lw=width, label=name)
        panel.set_xlabel(AXES[axis])
        panel.set_ylim(*_limits([c.middle for c in of_axis], [v for c in banded for v in (c.low, c.high)]))
    axes[0][0].set_ylabel(curves[0].metric)
    legend(figure, axes[0][0], columns=2)
    return figure


def _limits(middles: Sequence[Floats], bounds: Sequence[Floats]) -> tuple[float, float]:
    """Return limits of the y axis that are filled by the means: bands of two or three runs are far wider."""
    means, every = np.concatenate(middles), np.concatenate([*middles, *bounds])
    low, high = float(means.min()), float(means.max())
    room = 0.75 * (high - low) or 1.0
    every = every[np.isfinite(every)]
    return max(low - room, float(every.min()) - 0.05 * room), min(high + room, float(every.max()) + 0.05 * room)


def forests(figures: Sequence[Figure], main: Sequence[str], baseline: str, key: str, of_groups: Looks) -> list[Drawing]:
    """Return one drawing for each main quantity: groups from top to bottom with their intervals."""
    drawings = []
    for name in main:
        those = [f for f in figures if f.column.name == name]
        if those:
            caption = (
                f"{those[0].column.meaning}. Dots: runs; bar: interquartile mean with its 95 % interval over runs. "
                f"Dashed: {baseline}."
            )
            paint = partial(_forest, those, baseline, of_groups)
            title = f"{key}: {named(those[0].column.name, those[0].column.unit)}"
            drawings.append(Drawing(f"forest{key}{name}".replace("_", ""), title, caption, paint))
    return drawings


def _forest(figures: Sequence[Figure], baseline: str, of_groups: Looks) -> plots.Figure:
    figure, panel = listing(
        [short(f.group, 34) for f in figures], row=0.27, label=named(figures[0].column.name, figures[0].column.unit)
    )
    for place, f in enumerate(figures):
        colour, _ = of_groups[f.group]
        panel.plot(f.values, np.full(len(f.values), place), ".", color=colour, alpha=0.45, ms=5, mec="none")
        if np.isfinite(f.runs.low):
            panel.plot([f.runs.low, f.runs.high], [place, place], color=colour, lw=1.6)
        panel.plot([f.runs.estimate], [place], "|", color=colour, ms=9, mew=2)
        if f.group == baseline:
            panel.axvline(f.runs.estimate, color="#777777", lw=0.8, ls="--")
    values = np.concatenate([f.values for f in figures])
    values = values[np.isfinite(values)]
    if len(values):
        room = 0.6 * float(np.ptp(values)) or 0.1 * abs(float(values[0])) or 0.1
        panel.set_xlim(values.min() - room, values.max() + room)
    return figure


def importances(entries: Sequence[Sensitivity], key: str) -> list[Drawing]:
    """Return one drawing for each result: its correlates by importance."""
    drawings = []
    for name in dict.fromkeys(e.column.name for e in entries):
        those = [e for e in entries if e.column.name == name and np.isfinite(e.association.importance)]
        those = sorted(those, key=lambda e: -e.association.importance)[:MOST]
        if those:
            caption = (
                "Permutation importance: share of the rank variance that the quantity explains in a linear model; dark:"
                " significant (p after Holm at most 0.05). Swept settings are compared across runs, randomised"
                " quantities across robots."
            )
            title = f"{key}: correlates of {name}"
            drawings.append(Drawing(f"goes{key}{name}".replace("_", ""), title, caption, partial(_bars, those)))
    return drawings


def _bars(entries: Sequence[Sensitivity]) -> plots.Figure:
    names = [f"{short(e.association.name, 34)}, {SOURCES[e.source]}" for e in entries]
    figure, panel = listing(names, label="importance")
    colours = [COLOURS[0] if e.adjusted_p <= 0.05 else "#b9c6d0" for e in entries]
    panel.barh(range(len(entries)), [max(e.association.importance, 0.0) for e in entries], color=colours)
    return figure
