"""A report as data: quantities with intervals over runs, comparisons with the baseline, correlates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from go1exp.evaluate.quantities import DRAW, ROBOT, Column
from go1exp.evaluate.report import curves as learning
from go1exp.evaluate.report.curves import Curve
from go1exp.evaluate.report.evaluations import Evaluation, RunRows, check_figures, evaluations
from go1exp.evaluate.report.settings import ReportSettings
from go1exp.evaluate.report.study import Group, Study, baseline, groups
from go1exp.evaluate.statistics import runs as over_runs
from go1exp.evaluate.statistics.association import Association, associations
from go1exp.evaluate.statistics.intervals import Interval, share_interval, stratified_mean_interval
from go1exp.evaluate.statistics.runs import ALPHA, ORDER, Difference, Word, holm, iqm_interval

Floats = NDArray[np.float64]
Condition = tuple[tuple[str, float | str], ...]  # its columns and their values; empty for all conditions together
Source = Literal["setting", "drawn"]  # a swept setting (over runs), or a randomised quantity (over robots)
Rows = Mapping[Path, NDArray[np.bool_]]  # selected rows of each run


@dataclass(frozen=True)
class Figure:
    """One quantity of one group."""

    group: str
    column: Column
    runs: Interval  # estimate with its interval over runs; n is the number of runs
    robots: Interval | None  # of a share, Wilson's interval over all robots of these runs; else None
    bootstrap: Interval | None  # of a share, the percentile interval over runs; else None
    values: Floats  # of each run, NaN where undefined
    condition: Condition = ()


@dataclass(frozen=True)
class Verdict:
    """One quantity of one group compared with the baseline."""

    group: str
    column: Column
    first: float  # interquartile mean of the baseline
    other: float  # interquartile mean of the group
    difference: Difference  # with its p and effect sizes
    adjusted_p: float  # after Holm's correction; the p itself without a correction
    word: Word  # better, worse or no significant difference
    needed: int | None  # runs per group needed for 80 % power; None if significant, or without a difference
    hopeless: bool  # whether no difference could be significant with so few runs among so many comparisons
    # difference of these policies robot by robot; None where no two robots of a condition differ
    robots: Interval | None


@dataclass(frozen=True)
class Sensitivity:
    """Correlation of one quantity with one result."""

    source: Source
    column: Column
    association: Association
    adjusted_p: float  # after Holm's correction over the quantities of the same source and result


def figures(evaluation: Evaluation, made: Sequence[Group]) -> list[Figure]:
    """Return every quantity of every group, over all conditions."""
    return [_figure(evaluation, group, column) for column in evaluation.columns for group in made]


def by_condition(evaluation: Evaluation, made: Sequence[Group]) -> list[Figure]:
    """Return the quantities with a better direction, of every group in every condition."""
    columns = [c for c in evaluation.columns if c.better]
    first = next(iter(evaluation.runs.values())).table
    keys = [key for key in evaluation.keys if key in first]
    entries = []
    for condition in dict.fromkeys(zip(*(first[key].tolist() for key in keys), strict=True)):
        named = tuple(zip(keys, condition, strict=True))
        rows = {f: np.all([e.table[k] == v for k, v in named], axis=0) for f, e in evaluation.runs.items()}
        entries += [_figure(evaluation, group, column, rows, named) for column in columns for group in made]
    return entries


def _figure(
    evaluation: Evaluation, group: Group, column: Column, rows: Rows | None = None, condition: Condition = ()
) -> Figure:
    values = _values(evaluation, group, column, rows)
    means = _means(values)
    if column.how != "share":
        return Figure(group.name, column, iqm_interval(means), None, None, means, condition)
    counts, totals = [int(v.sum()) for v in values], [len(v) for v in values]
    of_runs, robots = over_runs.clustered_share(counts, totals), share_interval(sum(counts), sum(totals))
    return Figure(group.name, column, of_runs, robots, over_runs.share_bootstrap(counts, totals), means, condition)


def _values(evaluation: Evaluation, group: Group, column: Column, rows: Rows | None = None) -> list[Floats]:
    values = []
    for folder in (run.folder for run in group.runs):
        each = evaluation.runs[folder].table.get(column.name) if folder in evaluation.runs else None
        each = np.empty(0) if each is None else each if rows is None else each[rows[folder]]
        values.append(each[np.isfinite(each)])
    return values


def _means(values: Sequence[Floats]) -> Floats:
    return np.array([float(each.mean()) if len(each) else math.nan for each in values])


def compared(evaluation: Evaluation, made: Sequence[Group], baseline: Group, settings: ReportSettings) -> list[Verdict]:
    """Compare each evaluated group with the baseline; the correction is over all quantities of all groups."""
    known = {c.name: c for c in evaluation.columns if c.better}
    columns = [known[name] for name in (settings.figures or evaluation.main) if name in known]
    corrected, paired = settings.correction == "holm", settings.paired
    evaluated = [g for g in made if any(run.folder in evaluation.runs for run in g.runs)]
    if baseline not in evaluated:
        return []
    subjects = [(g, c) for c in columns for g in evaluated if g is not baseline]
    samples = [_samples(evaluation, group, baseline, column, paired) for group, column in subjects]
    differences = [over_runs.difference(a, b, paired) for a, b in samples]
    p_values = [d.p for d in differences]
    adjusted = holm(p_values) if corrected else p_values
    family = sum(math.isfinite(p) for p in p_values) if corrected else 1
    entries = []
    for (group, column), (a, b), d, p in zip(subjects, samples, differences, adjusted, strict=True):
        assert column.better is not None
        word, needed = over_runs.verdict_by_p(d.estimate.estimate, p, column.better), None
        if word == ORDER[-1]:
            needed = over_runs.runs_needed(a[np.isfinite(a)], b[np.isfinite(b)], alpha=ALPHA / max(family, 1))
        first, other = (float(iqm_interval(v).estimate) for v in (b, a))
        hopeless = not d.least_p * family <= ALPHA
        robots = _by_robot(evaluation, group, baseline, column)
        entries.append(Verdict(group.name, column, first, other, d, p, word, needed, hopeless, robots))
    return entries


def _samples(
    evaluation: Evaluation, group: Group, baseline: Group, column: Column, paired: bool
) -> tuple[Floats, Floats]:
    """Return one value per run of both groups; for pairs, of the seeds that both have."""
    a, b = (_means(_values(evaluation, g, column)) for g in (group, baseline))
    if not paired:
        return a[np.isfinite(a)], b[np.isfinite(b)]
    theirs = {run.seed: value for run, value in zip(baseline.runs, b, strict=True)}
    both = [(value, theirs[run.seed]) for run, value in zip(group.runs, a, strict=True) if run.seed in theirs]
    pairs = np.array(both, dtype=np.float64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _by_robot(evaluation: Evaluation, group: Group, baseline: Group, column: Column) -> Interval | None:
    """Return the difference of a group's policies to the baseline's on the same robots; None without such pairs.

    All evaluations share one seed: the k-th robot of a condition is the same for every policy. The difference of a
    robot is the mean over the group's runs minus that over the baseline's; its interval is over robots, stratified by
    condition. It concerns these policies, not other training seeds.
    """
    sides = [
        [evaluation.runs[r.folder].table for r in g.runs if r.folder in evaluation.runs] for g in (group, baseline)
    ]
    tables = [table for side in sides for table in side]
    keys = [key for key in (*evaluation.keys, ROBOT) if key in tables[0]] if tables else []
    if not all(sides) or ROBOT not in keys or any(column.name not in table for table in tables):
        return None
    rows = [list(zip(*(table[key].tolist() for key in keys), strict=True)) for table in tables]
    ordered = sorted(rows[0])
    if any(sorted(each) != ordered for each in rows) or len(set(ordered)) < len(ordered):
        return None
    places = [sorted(range(len(each)), key=each.__getitem__) for each in rows]
    values = np.array([t[column.name][place] for t, place in zip(tables, places, strict=True)], dtype=np.float64)
    of_group, of_baseline = np.split(values, [len(sides[0])])
    conditions = {row[:-1]: k for k, row in enumerate(ordered)}
    return stratified_mean_interval(_mean(of_group) - _mean(of_baseline), [conditions[row[:-1]] for row in ordered])


def _mean(values: Floats) -> Floats:
    """Return the mean over the first axis of defined values; NaN where none is defined."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    return np.asarray(np.where(known, values, 0.0).sum(axis=0) / np.where(count > 0, count, np.nan))


def sensitivities(evaluation: Evaluation, made: Sequence[Group]) -> list[Sensitivity]:
    """Return the correlates of the main quantities of an evaluation."""
    entries: list[Sensitivity] = []
    for column in (c for c in evaluation.columns if c.name in evaluation.main):
        of_sources: dict[Source, list[Association]] = {
            "setting": _of_settings(evaluation, made, column),
            "drawn": _of_draws(evaluation, column),
        }
        for source, those in of_sources.items():
            adjusted = holm([a.p for a in those])
            entries += [Sensitivity(source, column, a, p) for a, p in zip(those, adjusted, strict=True)]
    return entries


def _of_settings(evaluation: Evaluation, made: Sequence[Group], column: Column) -> list[Association]:
    if len(made) < 2:
        return []
    values = np.concatenate([_means(_values(evaluation, group, column)) for group in made])
    swept = {key: [group.settings[key] for group in made for _ in group.runs] for key in made[0].settings}
    return associations({key: _numbers_or_names(each) for key, each in swept.items()}, values)


def _numbers_or_names(values: Sequence[object]) -> np.ndarray:
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    return np.array(values, dtype=np.float64) if numbers else np.array([str(v) for v in values])


def _of_draws(evaluation: Evaluation, column: Column) -> list[Association]:
    """Return the correlation of each randomised quantity with a quantity of robots.

    The policies of one evaluation meet the same robots, each of which is one sample: the mean over runs of the robot's
    deviation from the mean of its run under the same command.
    """
    names: list[str] = []
    robots: dict[tuple[float, ...], list[float]] = {}
    for rows in evaluation.runs.values():
        drawn = {name.removeprefix(DRAW): v for name, v in rows.table.items() if name.startswith(DRAW)}
        names = names or (list(drawn) if column.name in rows.table else [])
        if column.name not in rows.table or not drawn or set(drawn) != set(names):
            continue  # trained, and therefore evaluated, with another randomisation
        deviation = _deviation(rows, evaluation.keys, column)
        keys = [rows.table[k] for k in (*evaluation.keys, ROBOT) if rows.table[k].dtype.kind == "f"]
        table = np.column_stack([*(drawn[name] for name in names), *keys])
        for row, value in zip(table.tolist(), deviation.tolist(), strict=True):
            robots.setdefault(tuple(row), []).append(value)
    if not names:
        return []
    quantities = np.array([row[: len(names)] for row in robots])
    values = _means([np.array([v for v in each if np.isfinite(v)]) for each in robots.values()])
    return associations({name: quantities[:, k] for k, name in enumerate(names)}, values)


def _deviation(rows: RunRows, keys: Sequence[str], column: Column) -> Floats:
    """Return a column (n,) minus its mean over the robots of the same condition."""
    values = rows.table[column.name].astype(np.float64)
    conditions = np.stack([np.unique(rows.table[k], return_inverse=True)[1] for k in keys], axis=1)
    which = np.unique(conditions, axis=0, return_inverse=True)[1].ravel()
    known = np.isfinite(values)
    counts = np.maximum(np.bincount(which[known], minlength=which.max() + 1), 1)
    centres = np.bincount(which[known], values[known], minlength=which.max() + 1) / counts
    return np.asarray(values - centres[which])


@dataclass(frozen=True)
class Outcome:
    """Results of one evaluation of all runs."""

    evaluation: Evaluation
    figures: list[Figure]
    by_condition: list[Figure]
    verdicts: list[Verdict]  # comparisons with the baseline; none for a single group
    # least number of runs per group with which a difference can be significant; None for none
    runs_required: int | None
    sensitivities: list[Sensitivity]


@dataclass(frozen=True)
class Report:
    """Content of a report."""

    study: Study
    groups: list[Group]
    baseline: Group
    curves: list[Curve]
    outcomes: list[Outcome]
    settings: dict[str, Any]


def report(study: Study, settings: ReportSettings, plain: dict[str, Any]) -> Report:
    """Make the report of a study; raise ConfigError if the requested baseline or quantity does not exist."""
    made = groups(study)
    first = baseline(made, settings.baseline)
    metrics = {}
    for run in (run for group in made for run in group.runs):
        metrics[run.folder], remark = learning.read(run.folder, settings.curves)
        study.notes += [remark] if remark else []
    drawn, notes = learning.curves(made, metrics, settings.curves, settings.points)
    study.notes += notes
    outcomes = []
    evaluated = evaluations(study)
    check_figures(settings.figures or (), evaluated)
    for each in evaluated:
        verdicts = compared(each, made, first, settings) if len(made) > 1 else []
        if not any(run.folder in each.runs for run in first.runs):
            study.notes.append(f"{each.name}: the baseline has none, so that nothing is compared with it")
        together = max(len(verdicts), 1) if settings.correction == "holm" else 1
        runs_required = over_runs.runs_for_significance(settings.paired, together)
        conditions, correlates = by_condition(each, made), sensitivities(each, made)
        outcomes.append(Outcome(each, figures(each, made), conditions, verdicts, runs_required, correlates))
    return Report(study, made, first, drawn, outcomes, plain)
