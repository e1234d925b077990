"""Tables of a report: as cells of the page, and as rows of plain data for CSV files and Weights & Biases."""

from __future__ import annotations

import math
from typing import Any

from go1exp.base.report.table import NOTHING, Cell, Table, interval_text, number, spread, verdict
from go1exp.evaluate.protocol.pages import condition_text, named
from go1exp.evaluate.report.results import Figure, Outcome, Report, Verdict
from go1exp.evaluate.statistics.intervals import Interval
from go1exp.evaluate.statistics.runs import ORDER, RESAMPLES

PlainRow = dict[str, Any]

FIGURES = (
    "Interquartile mean over runs [95 % interval over runs] n runs. Of shares: the share of all robots, its interval"
    " over runs, and Wilson's over the robots of these policies alone. Mean over all conditions; each condition and all"
    " other quantities are in the CSV files."
)

SENSITIVITY = (
    "Correlates of error and falls, which need not be causes. Spearman: rank correlation, p by permutation with Holm's"
    " correction over the quantities of a result; importance: permutation importance, the share of the rank variance"
    " that the quantity explains in a linear model."
)

COMPARED = (
    "better, worse: the permutation test over runs (mean ranks) is significant at 5 % after the correction; no"
    " significant difference: it is not. Differences of interquartile means, with Yuen's interval over runs. On the"
    " same robots: difference of these policies robot by robot, mean and interval over robots."
)

MOST_KEYS = 5  # settings of groups that have columns of their own; more are in the CSV file
MOST_COLUMNS = 6  # columns of the table of quantities
SOURCES = {"setting": "swept", "drawn": "randomised"}  # source of a sensitivity -> its word


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
        shown.append(Table("Excluded runs", ["run", "state", "reason"], rows, "Not in any result above."))
    return shown


def about_baseline(made: Report) -> str:
    """Return which group is the baseline, and how it was chosen."""
    name, most = made.baseline.name, max(len(g.runs) for g in made.groups)
    if made.settings.get("baseline") is not None or len(made.groups) == 1:
        return f"baseline: {name}"
    equal = sum(len(g.runs) == most for g in made.groups)
    rule = "the group with most runs" if equal == 1 else f"the first of {equal} groups with most runs"
    return f"baseline: {name} ({rule}; baseline= names another)"


def _defined(value: float) -> str:
    return number(value) if math.isfinite(value) else ""


def _interval(interval: Interval | None, note: str = "") -> Cell | str:
    if interval is None or not math.isfinite(interval.estimate):
        return ""
    return spread(interval.estimate, interval.low, interval.high, note or f"n {interval.n}")


def _verdicts(outcome: Outcome, baseline: str) -> Table:
    rows = []
    for v in sorted(outcome.verdicts, key=lambda v: ORDER.index(v.word)):
        d = v.difference
        rows.append(
            [
                Cell(v.group, named(v.column.name, v.column.unit), "name"),
                verdict(v.word),
                *map(_defined, (v.first, v.other)),
                _interval(d.estimate),
                _interval(v.robots),
                f"{number(v.adjusted_p)} ({number(d.p)})" if math.isfinite(d.p) else "",
                _defined(d.effect),
                _defined(d.improvement if v.column.better == "higher" else 1.0 - d.improvement),
                "" if v.needed is None else v.needed,
            ]
        )
    header = ["group", "verdict", "baseline", "group's", "difference [95 %] n", "on the same robots"]
    header += ["p after Holm (uncorrected)", "effect size g", "probability of improvement", "runs needed (80 % power)"]
    note = f"Compared with {baseline}. {COMPARED}"
    if hopeless := sum(v.hopeless for v in outcome.verdicts):
        note += f" {hopeless} of {len(outcome.verdicts)} comparisons could not be significant whatever the values:"
        if outcome.runs_required is None:
            note += f" too many comparisons for {RESAMPLES:,} permutations; name fewer with figures=."
        else:
            note += f" too few runs; use at least {outcome.runs_required} runs per group, or more of the baseline."
    return Table(f"{outcome.evaluation.name}: comparison with the baseline", header, rows, note)


def _figures(outcome: Outcome, made: Report) -> Table:
    evaluation = outcome.evaluation
    columns = [c for c in evaluation.columns if c.name in evaluation.main]
    others = [c for c in evaluation.columns if c.better and c.name not in evaluation.main]
    columns += others[: max(MOST_COLUMNS - len(columns), 0)]
    rows = []
    for group in made.groups:
        cells: list[Cell | str] = []
        for column in columns:
            f = next(f for f in outcome.figures if f.group == group.name and f.column is column)
            robots = interval_text(f.robots.estimate, f.robots.low, f.robots.high).partition(" ")[2] if f.robots else ""
            cells.append(_interval(f.runs, f"n {f.runs.n}" + (f", robots: {robots}" if f.robots else "")))
        rows.append([group.name, *cells])
    return Table(f"{evaluation.name}: results", ["group", *(named(c.name, c.unit) for c in columns)], rows, FIGURES)


def _sensitivities(outcome: Outcome) -> Table:
    rows = []
    for e in outcome.sensitivities:
        a = e.association
        rho = number(a.spearman) if math.isfinite(a.spearman) else NOTHING
        importance = number(max(a.importance, 0.0)) if math.isfinite(a.importance) else ""
        source = f"{SOURCES[e.source]}, across {'runs' if e.source == 'setting' else 'robots'}"
        rows.append([Cell(a.name, source, "name"), e.column.name, rho, _defined(e.adjusted_p), importance, a.n])
    header = ["quantity", "result", "Spearman", "p after Holm", "importance", "n"]
    return Table(f"{outcome.evaluation.name}: sensitivity", header, rows, SENSITIVITY)


def _groups(made: Report) -> Table:
    keys = list(made.groups[0].settings)
    shown = keys if len(keys) <= MOST_KEYS else []
    rows = []
    for group in made.groups:
        name = f"{group.name} (baseline)" if group is made.baseline and len(made.groups) > 1 else group.name
        seeds = ", ".join(str(run.seed) for run in group.runs)
        labels = ", ".join(run.label for run in group.runs[:6]) + (", ..." if len(group.runs) > 6 else "")
        rows.append([name, *(str(group.settings[k]) for k in shown), len(group.runs), seeds, labels])
    note = (
        "Runs of a group share their configuration but for the seed, paths, and keys that change speed and logs only."
    )
    return Table("Groups", ["group", *shown, "runs", "seeds", "folders"], rows, note)


def plain_rows(made: Report) -> dict[str, list[PlainRow]]:
    """Return every table of the report as rows of plain data, by the name of its CSV file."""
    files: dict[str, list[PlainRow]] = {"runs": _run_rows(made), "curves": _curve_rows(made)}
    for outcome in made.outcomes:
        name = outcome.evaluation.name
        files[f"{name}_figures"] = [_figure_row(f) for f in (*outcome.figures, *outcome.by_condition)]
        files[f"{name}_runs"] = _value_rows(outcome, made)
        files[f"{name}_comparison"] = [_verdict_row(v, made.baseline.name) for v in outcome.verdicts]
        files[f"{name}_sensitivity"] = _sensitivity_rows(outcome)
    return {name: rows for name, rows in files.items() if rows}


def _run_rows(made: Report) -> list[PlainRow]:
    rows: list[PlainRow] = [
        {"run": r.label, "group": g.name, "seed": r.seed, "state": r.state, "cause": r.cause, **g.settings}
        for g in made.groups
        for r in g.runs
    ]
    absent = made.study.absent
    return rows + [{"run": a.label, "group": "", "seed": "", "state": a.state, "cause": a.cause} for a in absent]


def _curve_rows(made: Report) -> list[PlainRow]:
    unit = {"steps": "steps_million", "hours": "hours"}
    return [
        {"group": c.group, "metric": c.metric, "axis": unit[c.axis]}
        | {"x": x, "iqm": m, "low": low, "high": high, "runs": c.runs}
        for c in made.curves
        for x, m, low, high in zip(c.x, c.middle, c.low, c.high, strict=True)
    ]


def _figure_row(f: Figure) -> PlainRow:
    row: PlainRow = {"group": f.group, "condition": condition_text(dict(f.condition)), "figure": f.column.name}
    row |= {"unit": f.column.unit, "estimate": f.runs.estimate}
    row |= {"low": f.runs.low, "high": f.runs.high, "runs": f.runs.n}
    for name, interval in (("wilson", f.robots), ("bootstrap", f.bootstrap)):
        row |= {f"{name}_{bound}": getattr(interval, bound, "") for bound in ("low", "high")}
    return row


def _value_rows(outcome: Outcome, made: Report) -> list[PlainRow]:
    rows = []
    for group in made.groups:
        figures = [f for f in outcome.figures if f.group == group.name]
        for k, run in enumerate(group.runs):
            values = {f.column.name: float(f.values[k]) for f in figures}
            rows.append({"run": run.label, "group": group.name, "seed": run.seed, **values})
    return rows


def _verdict_row(v: Verdict, baseline: str) -> PlainRow:
    d, over_runs, of_robots = v.difference, v.difference.estimate, v.robots
    row: PlainRow = {"group": v.group, "baseline": baseline, "figure": v.column.name, "unit": v.column.unit}
    row |= {"verdict": v.word, "of_baseline": v.first, "of_group": v.other}
    row |= {"difference": over_runs.estimate, "low": over_runs.low, "high": over_runs.high, "runs": over_runs.n}
    row |= {"p": d.p, "p_adjusted": v.adjusted_p, "hedges_g": d.effect, "probability_of_more": d.improvement}
    for name, bound in (("same_robots", "estimate"), ("same_robots_low", "low"), ("same_robots_high", "high")):
        row[name] = getattr(of_robots, bound, "")
    return row | {"runs_needed": "" if v.needed is None else v.needed}


def _sensitivity_rows(outcome: Outcome) -> list[PlainRow]:
    return [
        {"figure": e.column.name, "quantity": e.association.name, "source": e.source}
        | {"spearman": e.association.spearman, "p": e.association.p, "p_adjusted": e.adjusted_p}
        | {"importance": e.association.importance, "n": e.association.n}
        for e in outcome.sensitivities
    ]
