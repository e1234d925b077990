"""Figures with 95 % intervals: Wilson's for shares, the bootstrap's for medians and means."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats

Figure = tuple[float | None, float, float, int]
"""Value (None if there are no cases), low and high end of its 95 % interval, number of cases."""


def share(outcomes: Sequence[bool]) -> Figure:
    """Return the share of true outcomes with Wilson's interval (0 to 1 if there are none)."""
    if not outcomes:
        return None, 0.0, 1.0, 0
    interval = stats.binomtest(sum(outcomes), len(outcomes)).proportion_ci(method="wilson")
    return sum(outcomes) / len(outcomes), float(interval.low), float(interval.high), len(outcomes)


def median(values: Sequence[float], what: Callable[..., Any] = np.median) -> Figure:
    """Return the median, or another statistic, with a bootstrapped interval (percentiles; fixed seed)."""
    if not values:
        return None, math.nan, math.nan, 0
    middle = float(what(values))
    if len(set(values)) == 1:
        return middle, middle, middle, len(values)
    interval = stats.bootstrap(
        (np.asarray(values, dtype=float),), what, n_resamples=2000, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    return middle, float(interval.low), float(interval.high), len(values)
