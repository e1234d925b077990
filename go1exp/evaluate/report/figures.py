"""Figures of groups with intervals over runs, and each group against the baseline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from go1exp.evaluate.quantities import ROBOT, Column
from go1exp.evaluate.report.evaluations import Judged
from go1exp.evaluate.report.groups import Group
from go1exp.evaluate.statistics import compare
from go1exp.evaluate.statistics.compare import Word
from go1exp.evaluate.statistics.intervals import Interval, stratified_mean_interval
from go1exp.evaluate.statistics.runs import clustered_share, iqm_interval, pooled_share, share_bootstrap

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Figure:
    """One figure of one group.

    Attributes:
        group: its name.
        column: the figure.
        runs: with its interval over runs; n is that of the runs.
        robots: of a share, Wilson's interval over all robots of these runs; else None.
        bootstrap: of a share, the percentile interval over runs; else None.
        values: of each run, NaN where it has none.
        condition: what it is about; empty for all conditions together.
    """

    group: str
    column: Column
    runs: Interval
    robots: Interval | None
    bootstrap: Interval | None
    values: Floats
    condition: tuple[tuple[str, Any], ...] = ()


@dataclass(frozen=True)
class Verdict:
    """One figure of one group against the baseline.

    Attributes:
        group: its name.
        column: the figure.
        first: interquartile mean of the baseline.
        other: of the group.
        difference: with its p and effect sizes.
        adjusted_p: after Holm's correction; the p itself without one.
        word: better, worse or not told apart.
        needed: runs in each group that would tell a difference like the one seen; None if it is told, or none was seen.
        hopeless: whether even a clear difference could not have been told with so few runs among so many comparisons.
        robots: the difference robot by robot, of these policies; None where no two robots of a condition differ.
    """

    group: str
    column: Column
    first: float
    other: float
    difference: compare.Difference
    adjusted_p: float
    word: Word
    needed: int | None
    hopeless: bool
    robots: Interval | None


def means(judged: Judged, group: Group, column: Column, rows: dict[Path, NDArray[np.bool_]] | None = None) -> Floats:
    """Return the mean over rows of each run of a group (runs,), NaN of a run without a value."""
    each = []
    for run in group.runs:
        known = _values(judged, run.folder, column, rows)
        each.append(float(known.mean()) if len(known) else math.nan)
    return np.array(each)


def _values(judged: Judged, folder: Path, column: Column, rows: dict[Path, NDArray[np.bool_]] | None) -> Floats:
    evaluated = judged.runs.get(folder)
    if evaluated is None or column.name not in evaluated.table:
        return np.empty(0)
    values = evaluated.table[column.name]
    if rows is not None:
        values = values[rows[folder]]
    return values[np.isfinite(values)]


def figure(
    judged: Judged,
    group: Group,
    column: Column,
    rows: dict[Path, NDArray[np.bool_]] | None = None,
    condition: tuple[tuple[str, Any], ...] = (),
) -> Figure:
    """Return a figure of a group; ``rows`` are those that count, of each run."""
    values = means(judged, group, column, rows)
    if column.how != "share":
        return Figure(group.name, column, iqm_interval(values), None, None, values, condition)
    of_runs = [_values(judged, run.folder, column, rows) for run in group.runs]
    counts, totals = [int(v.sum()) for v in of_runs], [len(v) for v in of_runs]
    over_runs, robots = clustered_share(counts, totals), pooled_share(counts, totals)
    return Figure(group.name, column, over_runs, robots, share_bootstrap(counts, totals), values, condition)


def table(judged: Judged, made: Sequence[Group]) -> list[Figure]:
    """Return every figure of every group, over all conditions."""
    return [figure(judged, group, column) for column in judged.columns for group in made]


def by_condition(judged: Judged, made: Sequence[Group]) -> list[Figure]:
    """Return the figures that have a better direction, of every group in every condition."""
    columns = [c for c in judged.columns if c.better]
    first = next(iter(judged.runs.values())).table
    keys = [key for key in judged.keys if key in first]
    conditions = list(dict.fromkeys(zip(*(first[key].tolist() for key in keys), strict=True)))
    entries = []
    for condition in conditions:
        rows = {
            folder: np.all([e.table[k] == v for k, v in zip(keys, condition, strict=True)], axis=0)
            for folder, e in judged.runs.items()
        }
        named = tuple(zip(keys, condition, strict=True))
        entries += [figure(judged, group, column, rows, named) for column in columns for group in made]
    return entries


def compared(
    judged: Judged,
    made: Sequence[Group],
    baseline: Group,
    wanted: Sequence[str] | None,
    correction: Literal["holm", "none"],
    paired: bool,
) -> list[Verdict]:
    """Return each group against the baseline, figure by figure; nothing of groups without this evaluation.

    Args:
        judged: an evaluation.
        made: all groups.
        baseline: one of them.
        wanted: names of figures, of which those count that the evaluation has; None takes its main ones.
        correction: over all figures of all groups here, or none.
        paired: pair runs by their seed.
    """
    known = {c.name: c for c in judged.columns if c.better}
    columns = [known[name] for name in (wanted or judged.main) if name in known]
    evaluated = [g for g in made if any(run.folder in judged.runs for run in g.runs)]
    if baseline not in evaluated:
        return []
    subjects = [(g, c) for c in columns for g in evaluated if g is not baseline]
    samples = [_samples(judged, group, baseline, column, paired) for group, column in subjects]
    differences = [compare.difference(a, b, paired) for a, b in samples]
    p_values = [d.p for d in differences]
    adjusted = compare.holm(p_values) if correction == "holm" else p_values
    family = sum(math.isfinite(p) for p in p_values) if correction == "holm" else 1
    entries = []
    for (group, column), (a, b), d, p in zip(subjects, samples, differences, adjusted, strict=True):
        assert column.better is not None
        said_word = compare.worded(d.estimate.estimate, p, column.better)
        needed = None
        if said_word == "no significant difference":
            level = compare.ALPHA / max(family, 1)
            needed = compare.runs_needed(a[np.isfinite(a)], b[np.isfinite(b)], alpha=level)
        first, other = (float(iqm_interval(v).estimate) for v in (b, a))
        hopeless = not d.least_p * family <= compare.ALPHA
        robots = by_robot(judged, group, baseline, column)
        entries.append(Verdict(group.name, column, first, other, d, p, said_word, needed, hopeless, robots))
    return entries


def by_robot(judged: Judged, group: Group, baseline: Group, column: Column) -> Interval | None:
    """Return how a group's policies differ from the baseline's on the same robots; None without such pairs.

    All evaluations have one seed: the k-th robot of a condition is the same for every policy. Of each robot it is the
    mean over the group's runs less that over the baseline's, with the interval over robots, condition by condition. It
    says how certain the difference of these policies is, and nothing of other training seeds.
    """
    sides = [
        [judged.runs[run.folder].table for run in side.runs if run.folder in judged.runs] for side in (group, baseline)
    ]
    tables = [table for side in sides for table in side]
    keys = [key for key in (*judged.keys, ROBOT) if key in tables[0]] if tables else []
    if not all(sides) or ROBOT not in keys or any(column.name not in table for table in tables):
        return None
    rows = [list(zip(*(table[key].tolist() for key in keys), strict=True)) for table in tables]
    if any(sorted(each) != sorted(rows[0]) for each in rows) or len(set(rows[0])) < len(rows[0]):
        return None
    places = [sorted(range(len(each)), key=each.__getitem__) for each in rows]
    values = np.array(
        [table[column.name][place] for table, place in zip(tables, places, strict=True)], dtype=np.float64
    )
    of_group, of_baseline = np.split(values, [len(sides[0])])
    conditions = {row[:-1]: k for k, row in enumerate(sorted(rows[0]))}
    strata = [conditions[row[:-1]] for row in sorted(rows[0])]
    return stratified_mean_interval(_mean(of_group) - _mean(of_baseline), strata)


def _mean(values: Floats) -> Floats:
    """Return the mean over the first axis of what is defined; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    return np.asarray(np.where(known, values, 0.0).sum(axis=0) / np.where(count > 0, count, np.nan))


def _samples(judged: Judged, group: Group, baseline: Group, column: Column, paired: bool) -> tuple[Floats, Floats]:
    """Return one value per run of both, of seeds that both have if they are to be pairs."""
    a, b = means(judged, group, column), means(judged, baseline, column)
    if not paired:
        return a[np.isfinite(a)], b[np.isfinite(b)]
    theirs = {run.seed: value for run, value in zip(baseline.runs, b, strict=True)}
    both = [(value, theirs[run.seed]) for run, value in zip(group.runs, a, strict=True) if run.seed in theirs]
    pairs = np.array(both, dtype=np.float64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]
