"""Tables of a report: as cells of the page, and as rows of plain data for CSV files and Weights & Biases."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from go1exp.evaluate.protocol.report.tables import Table, spread
from go1exp.evaluate.protocol.report.words import condition_text, number
from go1exp.evaluate.report.drawings import label
from go1exp.evaluate.report.figures import Figure, Verdict
from go1exp.evaluate.report.made import Outcome, Report
from go1exp.evaluate.statistics.compare import RESAMPLES
from go1exp.evaluate.statistics.intervals import Interval

ORDER = ("better", "worse", "no significant difference")

PlainRow = dict[str, Any]


def tables(made: Report) -> list[Table]:
    """Return the tables of the page."""
    shown = []
    for outcome in made.outcomes:
        if outcome.verdicts:
            shown.append(_verdicts(outcome, made.baseline.name))
        shown.append(_figures(outcome, made))
        if outcome.sensitivities:
            shown.append(_sensitivities(outcome))
    shown.append(_groups(made))
    if made.study.absent:
        rows = [[a.label, a.state, a.cause] for a in made.study.absent]
        note = "Nothing of these is in the figures above."
        shown.append({"title": "Runs that do not count", "note": note, "header": ["run", "state", "why"], "rows": rows})
    return shown


def _cell(interval: Interval, note: str = "") -> Any:
    return spread(interval.estimate, interval.low, interval.high, note) if math.isfinite(interval.estimate) else ""


def _verdicts(outcome: Outcome, baseline: str) -> Table:
    """Return what is told apart first."""
    rows = []
    for v in sorted(outcome.verdicts, key=lambda v: ORDER.index(v.word)):
        d = v.difference
        p = f"{number(v.adjusted_p)} ({number(d.p)})" if math.isfinite(d.p) else ""
        effect = number(d.effect) if math.isfinite(d.effect) else ""
        needed = "" if v.needed is None else f"{v.needed}"
        better = v.column.better
        gain = d.improvement if better == "higher" else 1.0 - d.improvement
        chance = number(gain) if math.isfinite(gain) else ""
        between = _cell(d.estimate, f"n {d.estimate.n}")
        robots = "" if v.robots is None else _cell(v.robots, f"n {v.robots.n}")
        pair = [number(x) if math.isfinite(x) else "" for x in (v.first, v.other)]
        rows.append(
            [
                {"name": v.group, "note": label(v.column)},
                {"word": v.word},
                *pair,
                between,
                robots,
                p,
                effect,
                chance,
                needed,
            ]
        )
    header = [
        "group",
        "verdict",
        "baseline",
        "group's",
        "difference [95 %] n",
        "on the same robots",
        "p after Holm (alone)",
    ]
    header += ["effect size g", "better with probability", "runs that would tell"]
    note = (
        f"Against {baseline}. better, worse: the permutation test over runs (mean ranks) tells them apart at 5 % after"
        " the correction; not told apart: it does not. Differences of interquartile means, with Yuen's interval over"
        " runs. On the same robots: the difference of these policies robot by robot, mean and interval over the robots."
    )
    hopeless = [v for v in outcome.verdicts if v.hopeless]
    if hopeless:
        note += f" {len(hopeless)} of {len(outcome.verdicts)} comparisons could not have been told whatever came out:"
        if outcome.can_tell is None:
            note += f" too many comparisons for {RESAMPLES:,} permutations; name fewer with figures=."
        else:
            note += f" too few runs; {outcome.can_tell} runs in each group could tell, or more of the baseline."
    return {"title": f"{outcome.judged.name}: against the baseline", "note": note, "header": header, "rows": rows}


def _figures(outcome: Outcome, made: Report) -> Table:
    """Return the main figures of each group."""
    judged = outcome.judged
    columns = [c for c in judged.columns if c.name in judged.main]
    columns += [c for c in judged.columns if c.better and c.name not in judged.main][: 6 - len(columns)]
    rows = []
    for group in made.groups:
        cells = []
        for column in columns:
            f = next(f for f in outcome.figures if f.group == group.name and f.column is column)
            robots = "" if f.robots is None else f"robots: {_bounds(f.robots)}"
            cells.append(_cell(f.runs, f"n {f.runs.n}{', ' if robots else ''}{robots}"))
        rows.append([group.name, *cells])
    note = (
        "Interquartile mean over runs [95 % interval over runs] n runs; of shares the share of all robots, its interval"
        " over runs, and that of Wilson over the robots of these policies alone. Mean over all conditions; each"
        " condition and all other figures are in the CSV files."
    )
    return {"title": f"{judged.name}: figures", "note": note, "header": ["group", *map(label, columns)], "rows": rows}


def _bounds(interval: Interval) -> str:
    return f"[{number(interval.low)}, {number(interval.high)}]" if math.isfinite(interval.low) else ""


def _sensitivities(outcome: Outcome) -> Table:
    rows = []
    for e in outcome.sensitivities:
        a = e.association
        rho = number(a.spearman) if math.isfinite(a.spearman) else "names"
        p = number(e.adjusted_p) if math.isfinite(e.adjusted_p) else ""
        importance = number(max(a.importance, 0.0)) if math.isfinite(a.importance) else ""
        source = "swept, over runs" if e.source == "setting" else "drawn, over robots"
        rows.append([{"name": a.name, "note": source}, e.column.name, rho, p, importance, a.n])
    header = ["quantity", "figure", "Spearman", "p after Holm", "importance", "n"]
    note = (
        "What goes with error and falls; it need not be the cause. Spearman: rank correlation, p by permutation, with"
        " Holm's correction over the quantities of a figure; importance: share of the figure's rank variance that"
        " it explains in a linear model, by shuffling it."
    )
    return {"title": f"{outcome.judged.name}: sensitivity", "note": note, "header": header, "rows": rows}


def _groups(made: Report) -> Table:
    keys = list(made.groups[0].settings)
    shown = keys if len(keys) <= 5 else []
    rows = []
    for group in made.groups:
        name = f"{group.name} (baseline)" if group is made.baseline and len(made.groups) > 1 else group.name
        seeds = ", ".join(str(run.seed) for run in group.runs)
        labels = ", ".join(run.label for run in group.runs[:6]) + (", ..." if len(group.runs) > 6 else "")
        rows.append([name, *(str(group.settings[k]) for k in shown), len(group.runs), seeds, labels])
    note = "Runs of one configuration but for the seed, and for paths and what only changes speed and logs."
    return {"title": "Groups", "note": note, "header": ["group", *shown, "runs", "seeds", "folders"], "rows": rows}


# ---------------------------------------------------------------------- plain rows


def plain_rows(made: Report) -> dict[str, list[PlainRow]]:
    """Return every table of the report as rows of plain data, by the name of its CSV file."""
    files: dict[str, list[PlainRow]] = {"runs": _run_rows(made), "curves": _curve_rows(made)}
    for outcome in made.outcomes:
        name = outcome.judged.name
        files[f"{name}_figures"] = [_figure_row(f) for f in (*outcome.figures, *outcome.by_condition)]
        files[f"{name}_runs"] = _value_rows(outcome, made)
        if outcome.verdicts:
            files[f"{name}_comparison"] = [_verdict_row(v, made.baseline.name) for v in outcome.verdicts]
        if outcome.sensitivities:
            files[f"{name}_sensitivity"] = [
                {
                    "figure": e.column.name,
                    "quantity": e.association.name,
                    "source": e.source,
                    "spearman": e.association.spearman,
                    "p": e.association.p,
                    "p_adjusted": e.adjusted_p,
                    "importance": e.association.importance,
                    "n": e.association.n,
                }
                for e in outcome.sensitivities
            ]
    return {name: rows for name, rows in files.items() if rows}


def _run_rows(made: Report) -> list[PlainRow]:
    rows: list[PlainRow] = [
        {
            "run": run.label,
            "group": group.name,
            "seed": run.seed,
            "state": run.state,
            "cause": run.cause,
            **group.settings,
        }
        for group in made.groups
        for run in group.runs
    ]
    return rows + [
        {"run": a.label, "group": "", "seed": "", "state": a.state, "cause": a.cause} for a in made.study.absent
    ]


def _curve_rows(made: Report) -> list[PlainRow]:
    unit = {"steps": "steps_million", "hours": "hours"}
    return [
        {
            "group": c.group,
            "metric": c.metric,
            "axis": unit[c.axis],
            "x": x,
            "iqm": m,
            "low": low,
            "high": high,
            "runs": c.runs,
        }
        for c in made.curves
        for x, m, low, high in zip(c.x, c.middle, c.low, c.high, strict=True)
    ]


def _figure_row(f: Figure) -> PlainRow:
    row: PlainRow = {"group": f.group, "condition": condition_text(dict(f.condition)), "figure": f.column.name}
    row |= {
        "unit": f.column.unit,
        "estimate": f.runs.estimate,
        "low": f.runs.low,
        "high": f.runs.high,
        "runs": f.runs.n,
    }
    for name, interval in (("wilson", f.robots), ("bootstrap", f.bootstrap)):
        row |= {f"{name}_low": "" if interval is None else interval.low}
        row |= {f"{name}_high": "" if interval is None else interval.high}
    return row


def _value_rows(outcome: Outcome, made: Report) -> list[PlainRow]:
    """Return the figures of each run, all conditions together."""
    rows = []
    for group in made.groups:
        figures = [f for f in outcome.figures if f.group == group.name]
        for k, run in enumerate(group.runs):
            values = {f.column.name: float(f.values[k]) for f in figures}
            rows.append({"run": run.label, "group": group.name, "seed": run.seed, **values})
    return rows


def _verdict_row(v: Verdict, baseline: str) -> PlainRow:
    d = v.difference
    return {
        "group": v.group,
        "baseline": baseline,
        "figure": v.column.name,
        "unit": v.column.unit,
        "verdict": v.word,
        "of_baseline": v.first,
        "of_group": v.other,
        "difference": d.estimate.estimate,
        "low": d.estimate.low,
        "high": d.estimate.high,
        "runs": d.estimate.n,
        "p": d.p,
        "p_adjusted": v.adjusted_p,
        "hedges_g": d.effect,
        "probability_of_more": d.improvement,
        **_robots_cells(v.robots),
        "runs_needed": "" if v.needed is None else v.needed,
    }


def _robots_cells(robots: Interval | None) -> PlainRow:
    """Return the difference on the same robots with its interval; empty where there is none."""
    if robots is None:
        return dict.fromkeys(("same_robots", "same_robots_low", "same_robots_high"), "")
    return {"same_robots": robots.estimate, "same_robots_low": robots.low, "same_robots_high": robots.high}


def counts(verdicts: Sequence[Verdict]) -> dict[str, int]:
    """Return how many verdicts have each word."""
    return {word: sum(v.word == word for v in verdicts) for word in ORDER}
