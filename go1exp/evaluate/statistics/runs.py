"""Statistics over few training runs: interquartile mean with its interval, clustered shares, bootstrap.

A run is one training seed. Robots of one policy are no independent samples of a configuration, so that intervals are
over runs. Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (NeurIPS
2021), recommend the interquartile mean with a stratified bootstrap; with fewer than ten runs that interval covers the
truth in 77 to 93 % instead of 95 % (docs/notebook/studies.md), so that ``iqm_interval`` is studentised.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from go1exp.evaluate.statistics.intervals import LEVEL, Interval, share_interval

TRIM = 0.25
"""Share of the values that the interquartile mean omits at each end."""

WINSORISED_FROM = 6
"""Least number of runs with a winsorised standard error."""

SIMULATED = 40_000
"""Normal samples for a critical value, which is then accurate to 1 %."""

Floats = NDArray[np.float64]


def iqm(values: ArrayLike, axis: int | None = -1) -> Floats:
    """Return the interquartile mean along an axis, or of all values (None), as rliable does: a trimmed mean."""
    from scipy import stats

    return np.asarray(stats.trim_mean(np.asarray(values, dtype=np.float64), TRIM, axis=axis))


def iqm_interval(values: ArrayLike, level: float = LEVEL) -> Interval:
    """Return the interquartile mean of one value per run with its interval over runs; NaNs are ignored.

    The interval is NaN with fewer than two runs. See ``iqm_band``.
    """
    each = np.asarray(values, dtype=np.float64).ravel()
    each = each[np.isfinite(each)]
    if not len(each):
        return Interval(np.nan, np.nan, np.nan, 0)
    middle, low, high = iqm_band(each[:, None], level)
    return Interval(float(middle[0]), float(low[0]), float(high[0]), len(each))


def iqm_band(values: ArrayLike, level: float = LEVEL) -> tuple[Floats, Floats, Floats]:
    """Return interquartile mean (T,), low and high (T,) at each of T times of n runs' values (n, T).

    The interval is studentised: the mean plus and minus a critical value times its standard error, the critical value
    being that of normal values, simulated once for each n. The standard error is that of the winsorised values (Tukey
    and McLaughlin 1963), with fewer than six runs that of all. Measured coverage: docs/notebook/studies.md.
    """
    each = np.asarray(values, dtype=np.float64)
    middle = iqm(each, axis=0)
    if len(each) < 2:
        return middle, np.full_like(middle, np.nan), np.full_like(middle, np.nan)
    half = _critical(len(each), level) * _standard_error(each.T)
    return middle, middle - half, middle + half


def _standard_error(values: Floats) -> Floats:
    """Return the scale of the interquartile mean over the last axis, (..., n) to (...)."""
    n = values.shape[-1]
    if n < WINSORISED_FROM:
        return np.asarray(values.std(axis=-1, ddof=1) / np.sqrt(n))
    cut = int(TRIM * n)
    left, ordered = n - 2 * cut, np.sort(values, axis=-1)
    winsorised = np.clip(ordered, ordered[..., cut, None], ordered[..., n - cut - 1, None])
    return np.asarray(winsorised.std(axis=-1) * np.sqrt(n / (left * (left - 1))))


@cache
def _critical(n: int, level: float) -> float:
    """Return the ``level`` quantile of |error| / standard error of the interquartile mean of n normal values."""
    from scipy import stats

    if n > 40:
        return float(stats.t.ppf(0.5 + 0.5 * level, n - 2 * int(TRIM * n) - 1))
    sample = np.random.default_rng(n).normal(size=(SIMULATED, n))
    return float(np.quantile(np.abs(iqm(sample)) / _standard_error(sample), level))


# ---------------------------------------------------------------------- falls


def clustered_share(counts: ArrayLike, totals: ArrayLike, level: float = LEVEL) -> Interval:
    """Return the share of falls with its interval over runs, within which falls are correlated.

    Wilson's interval with the effective number of robots (their number over the design effect, at least 1) and
    Student's quantile of the runs less one (Korn and Graubard 1998, with Wilson's interval). n is that of the runs.

    Args:
        counts: falls of each run (n,).
        totals: robots of each run (n,).
        level: of the interval.
    """
    from scipy import stats

    fell, robots = np.asarray(counts, dtype=np.float64), np.asarray(totals, dtype=np.float64)
    fell, robots = fell[robots > 0], robots[robots > 0]
    n, everyone = len(robots), float(robots.sum())
    if not n:
        return Interval(np.nan, np.nan, np.nan, 0)
    share = float(fell.sum() / everyone)
    if n < 2:
        return Interval(share, np.nan, np.nan, n)
    residuals = fell - share * robots
    variance = n / (n - 1) * float((residuals**2).sum()) / everyone**2
    alone = share * (1.0 - share) / everyone
    effective = everyone / max(variance / alone, 1.0) if alone > 0.0 else everyone
    z2 = float(stats.t.ppf(0.5 + 0.5 * level, n - 1)) ** 2
    middle = (share + z2 / (2.0 * effective)) / (1.0 + z2 / effective)
    half = np.sqrt(z2 * (share * (1.0 - share) / effective + z2 / (4.0 * effective**2))) / (1.0 + z2 / effective)
    return Interval(share, max(float(middle - half), 0.0), min(float(middle + half), 1.0), n)


def share_bootstrap(
    counts: ArrayLike, totals: ArrayLike, draws: int = 2000, level: float = LEVEL, seed: int = 0
) -> Interval:
    """Return the share of falls with the percentile bootstrap interval over runs: too narrow for few runs."""
    fell, robots = np.asarray(counts, dtype=np.float64), np.asarray(totals, dtype=np.float64)
    fell, robots = fell[robots > 0], robots[robots > 0]
    n = len(robots)
    if n < 2:
        share = float(fell.sum() / robots.sum()) if n else np.nan
        return Interval(share, np.nan, np.nan, n)
    drawn = np.random.default_rng(seed).integers(n, size=(draws, n))
    shares = fell[drawn].sum(1) / robots[drawn].sum(1)
    low, high = np.quantile(shares, [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    return Interval(float(fell.sum() / robots.sum()), float(low), float(high), n)


def pooled_share(counts: ArrayLike, totals: ArrayLike, level: float = LEVEL) -> Interval:
    """Return the share of falls with Wilson's interval over all robots: of these policies alone."""
    return share_interval(int(np.sum(counts)), int(np.sum(totals)), level)
