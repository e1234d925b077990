"""Intervals: of a mean over robots, and of a share of falls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

LEVEL = 0.95


@dataclass(frozen=True)
class Interval:
    """An estimate with its confidence interval, and the number of robots that it stands on."""

    estimate: float
    low: float
    high: float
    n: int


def mean_interval(values: ArrayLike, level: float = LEVEL) -> Interval:
    """Return the mean of one value per robot with Student's t interval; NaNs (undefined) are left out.

    The interval is of the mean over robots like these; it is NaN with fewer than two.
    """
    from scipy import stats  # takes a moment to load

    each = np.asarray(values, dtype=np.float64).ravel()
    each = each[np.isfinite(each)]
    if not len(each):
        return Interval(np.nan, np.nan, np.nan, 0)
    mean = float(each.mean())
    if len(each) < 2:
        return Interval(mean, np.nan, np.nan, 1)
    half = float(stats.t.ppf(0.5 + 0.5 * level, len(each) - 1) * each.std(ddof=1) / np.sqrt(len(each)))
    return Interval(mean, mean - half, mean + half, len(each))


def phase_interval(phases: ArrayLike, level: float = LEVEL) -> Interval:
    """Return the circular mean of one phase per robot, cycles in 0 to 1, and the interval of the deviations from it.

    The bounds may lie beyond 0 and 1, so that low <= mean <= high.
    """
    each = np.asarray(phases, dtype=np.float64).ravel()
    each = each[np.isfinite(each)]
    mean = float(np.angle(np.exp(2j * np.pi * each).sum()) / (2.0 * np.pi) % 1.0) if len(each) else np.nan
    around = mean_interval((each - mean + 0.5) % 1.0 - 0.5, level)
    return Interval(mean, mean + around.low - around.estimate, mean + around.high - around.estimate, len(each))


def share_interval(count: int, n: int, level: float = LEVEL) -> Interval:
    """Return the share ``count`` / ``n`` with Wilson's interval, which is sound for few and for none."""
    from scipy import stats

    if n < 1:
        return Interval(np.nan, np.nan, np.nan, 0)
    bounds = stats.binomtest(count, n).proportion_ci(level, method="wilson")
    return Interval(count / n, float(bounds.low), float(bounds.high), n)
