"""Differences of subjects from the first one, paired by robot and condition, with intervals and verdicts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from go1exp.evaluate.protocol.playing import Result
from go1exp.evaluate.quantities import ROBOT, Column, Derived, Row, about, by_condition, plain, values
from go1exp.evaluate.statistics import intervals
from go1exp.evaluate.statistics.intervals import Interval
from go1exp.evaluate.statistics.runs import Word, verdict_by_interval

DRAWS = 200  # bootstrap samples of the difference of a figure of all robots


@dataclass(frozen=True)
class Difference:
    """Difference of one figure between a subject and the first one."""

    subject: str
    figure: str  # its name
    unit: str
    condition: Mapping[str, float | str]
    first: float  # figure of the first subject over the pairs
    other: float  # figure of the other subject
    difference: Interval  # other - first with its interval; n is the number of pairs
    verdict: Word  # whether the other subject is better
    # sample size for 80 % power at this difference, in pairs (robots, for a figure of all robots); None if it is
    # significant or zero
    pairs_needed: int | None


def compared(first: Result, other: Result) -> list[Difference]:
    """Return every figure with a better direction of ``other`` against ``first``, of the same protocol."""
    protocol = first.chosen.protocol
    columns = [c for c in protocol.columns() if c.better is not None and c.how != "phase"]
    differences = []
    of_first, of_other = (by_condition(r.played.rows, protocol.keys) for r in (first, other))
    for condition in [c for c in of_first if c in of_other]:
        pairs = _pairs(of_first[condition], of_other[condition])
        named = dict(zip(protocol.keys, condition, strict=True))
        for column in columns:
            if pairs[0] and any(column.name in row for row in pairs[0]):
                differences.append(_difference(other.label, column, named, *pairs))
    for a, b in zip(protocol.derived(first.played.rows), protocol.derived(other.played.rows), strict=True):
        if a.better is not None:
            differences.append(_of_all(other.label, a, b, first.played.rows, other.played.rows))
    return differences


def _pairs(first: Sequence[Row], other: Sequence[Row]) -> tuple[list[Row], list[Row]]:
    by_robot = {row[ROBOT]: row for row in other}
    kept = [row for row in first if row[ROBOT] in by_robot]
    return kept, [by_robot[row[ROBOT]] for row in kept]


def _difference(
    subject: str, column: Column, condition: Mapping[str, float | str], first: Sequence[Row], other: Sequence[Row]
) -> Difference:
    a, b = values(first, column.name), values(other, column.name)
    both = np.isfinite(a) & np.isfinite(b)
    a, b = a[both], b[both]
    shares = column.how == "share"
    between = intervals.paired_share_interval(a, b) if shares else intervals.paired_mean_interval(b - a)
    assert column.better is not None
    verdict = verdict_by_interval(between, column.better)
    needed = intervals.pairs_needed(b - a) if verdict == "no significant difference" else None
    means = (float(a.mean()), float(b.mean())) if len(a) else (math.nan, math.nan)
    return Difference(subject, column.name, column.unit, condition, *means, between, verdict, needed)


def _of_all(subject: str, a: Derived, b: Derived, first: Sequence[Row], other: Sequence[Row]) -> Difference:
    """Return the difference of a figure of all robots together, with a bootstrap over the robots of both subjects."""
    groups = [by_condition(about(rows, a.condition), (ROBOT,)) for rows in (first, other)]
    robots = [key for key in groups[0] if key in groups[1]]

    def drawn(which: int, sample: NDArray[np.intp]) -> list[Row]:
        return [row for k in sample for row in groups[which][robots[k]]]

    everyone = np.arange(len(robots))

    def gain(sample: NDArray[np.intp]) -> float:
        return b.function(drawn(1, sample)) - a.function(drawn(0, sample))

    between = intervals.bootstrap_interval(gain, len(robots), DRAWS)
    assert a.better is not None
    verdict, needed = verdict_by_interval(between, a.better), None
    half = 0.5 * (between.high - between.low)
    if verdict == "no significant difference" and math.isfinite(half) and between.estimate:
        needed = max(2, math.ceil(between.n * (half * POWER / between.estimate) ** 2))
    pair = (a.function(drawn(0, everyone)), b.function(drawn(1, everyone))) if robots else (math.nan, math.nan)
    return Difference(subject, a.name, a.unit, dict(a.condition), *pair, between, verdict, needed)


POWER = (1.96 + 0.842) / 1.96  # ratio of a difference to the half-width of its interval at 80 % power


def as_json(difference: Difference) -> dict[str, object]:
    """Return a difference as plain data."""
    fields = {name: value for name, value in vars(difference).items() if name != "unit"}
    return fields | {"difference": plain(difference.difference, difference.unit)}
