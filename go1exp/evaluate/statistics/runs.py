"""Statistics over few training runs: interquartile mean, clustered shares, bootstrap, permutation tests, verdicts.

A run is one training seed. Robots of one policy are no independent samples of a configuration, so that intervals are
over runs. Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (NeurIPS
2021), recommend the interquartile mean with a stratified bootstrap; with fewer than ten runs that interval covers the
truth in 77 to 93 % instead of 95 % (docs/notebook/studies.md), so that ``iqm_interval`` is studentised.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from go1exp.evaluate.statistics.intervals import LEVEL, POWER, Interval, constant

TRIM = 0.25  # share of the values that the interquartile mean omits at each end
WINSORISED_FROM = 6  # least number of runs with a winsorised standard error
SIMULATED = 40_000  # normal samples for a critical value, which is then accurate to 1 %
Floats = NDArray[np.float64]


def iqm(values: ArrayLike) -> Floats:
    """Return the interquartile mean over the last axis, (..., n) to (...), as rliable does: a trimmed mean.

    NaN where there is a NaN, or nothing; SciPy's ``trim_mean`` takes ten times as long for a few runs.
    """
    each = np.asarray(values, dtype=np.float64)
    if not each.shape[-1]:
        return np.full(each.shape[:-1], np.nan)
    cut = int(TRIM * each.shape[-1])
    inner = np.sort(each, axis=-1)[..., cut : each.shape[-1] - cut].mean(axis=-1)
    return np.asarray(np.where(np.isnan(each).any(axis=-1), np.nan, inner))


def iqm_interval(values: ArrayLike) -> Interval:
    """Return the interquartile mean of one value per run with its interval (``iqm_band``), NaN of fewer than two."""
    each = np.asarray(values, dtype=np.float64).ravel()
    each = each[np.isfinite(each)]
    if not len(each):
        return Interval(np.nan, np.nan, np.nan, 0)
    middle, low, high = iqm_band(each[:, None])
    return Interval(float(middle[0]), float(low[0]), float(high[0]), len(each))


def iqm_band(values: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Return interquartile mean (T,), low and high (T,) at each of T times of n runs' values (n, T).

    The interval is studentised: the mean plus and minus a critical value times its standard error, the critical value
    being that of normal values, simulated once for each n. The standard error is that of the winsorised values (Tukey
    and McLaughlin 1963), with fewer than six runs that of all. Measured coverage: docs/notebook/studies.md.
    """
    each = np.asarray(values, dtype=np.float64)
    middle = iqm(each.T)
    if len(each) < 2:
        return middle, np.full_like(middle, np.nan), np.full_like(middle, np.nan)
    half = _critical(len(each)) * _standard_error(each.T)
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
def _critical(n: int) -> float:
    """Return the 95 % quantile of |error| / standard error of the interquartile mean of n normal values."""
    if n > 40:
        return float(scipy.stats.t.ppf(0.5 + 0.5 * LEVEL, n - 2 * int(TRIM * n) - 1))
    sample = np.random.default_rng(n).normal(size=(SIMULATED, n))
    return float(np.quantile(np.abs(iqm(sample)) / _standard_error(sample), LEVEL))


def clustered_share(counts: ArrayLike, totals: ArrayLike) -> Interval:
    """Return the share of falls with its interval over runs, within which falls are correlated.

    Wilson's interval with the effective number of robots (their number over the design effect, at least 1) and
    Student's quantile of the runs less one (Korn and Graubard 1998, with Wilson's interval). n is that of the runs.
    ``counts`` are the falls of each run (n,), ``totals`` its robots (n,).
    """
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
    z2 = float(scipy.stats.t.ppf(0.5 + 0.5 * LEVEL, n - 1)) ** 2
    middle = (share + z2 / (2.0 * effective)) / (1.0 + z2 / effective)
    half = np.sqrt(z2 * (share * (1.0 - share) / effective + z2 / (4.0 * effective**2))) / (1.0 + z2 / effective)
    return Interval(share, max(float(middle - half), 0.0), min(float(middle + half), 1.0), n)


def share_bootstrap(counts: ArrayLike, totals: ArrayLike) -> Interval:
    """Return the share of falls with the percentile bootstrap interval over runs: too narrow for few runs."""
    fell, robots = np.asarray(counts, dtype=np.float64), np.asarray(totals, dtype=np.float64)
    fell, robots = fell[robots > 0], robots[robots > 0]
    n = len(robots)
    if n < 2:
        share = float(fell.sum() / robots.sum()) if n else np.nan
        return Interval(share, np.nan, np.nan, n)
    drawn = np.random.default_rng(0).integers(n, size=(2000, n))
    shares = fell[drawn].sum(1) / robots[drawn].sum(1)
    low, high = np.quantile(shares, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return Interval(float(fell.sum() / robots.sum()), float(low), float(high), n)


Word = Literal["better", "worse", "no significant difference"]
Direction = Literal["lower", "higher"]
ORDER: tuple[Word, ...] = ("better", "worse", "no significant difference")
RESAMPLES = 20_000  # permutations of a test; where there are fewer, all of them
LEAST_RANDOM_P = 2.0 / (RESAMPLES + 1)  # smallest two-sided p of random permutations, which include the observed one
ALPHA = 1.0 - LEVEL


@dataclass(frozen=True)
class Difference:
    """Difference of a group from the baseline."""

    # interquartile mean of the group minus that of the baseline, with Yuen's interval; n is the number of runs of the
    # smaller group, or of pairs
    estimate: Interval
    p: float  # of the permutation test, two-sided
    effect: float  # Hedges' g, in standard deviations
    improvement: float  # probability that a run of the group has more than one of the baseline; ties count half
    least_p: float  # the smallest p that so few runs can give


def difference(group: ArrayLike, baseline: ArrayLike, paired: bool = False) -> Difference:
    """Return the difference of the runs (n,) from the baseline's (m,), pair by pair if ``paired``; without NaNs."""
    a, b = np.asarray(group, dtype=np.float64), np.asarray(baseline, dtype=np.float64)
    if paired:
        both = np.isfinite(a) & np.isfinite(b)
        a, b = a[both], b[both]
    else:
        a, b = a[np.isfinite(a)], b[np.isfinite(b)]
    return Difference(
        estimate=yuen(a, b, paired),
        p=permutation_p(a, b, paired),
        effect=hedges(a, b),
        improvement=probability_of_improvement(a, b),
        least_p=least_p(len(a), len(b), paired),
    )


def permutation_p(a: NDArray[np.float64], b: NDArray[np.float64], paired: bool = False) -> float:
    """Return the two-sided p of the difference of runs (n,) and (m,); NaN with fewer than two runs in a group.

    A permutation test of mean ranks (Wilcoxon 1945) over all, or 20,000, permutations of the runs, or within pairs. It
    is exact for any distribution, and robust to single failed runs.
    """
    if min(len(a), len(b)) < 2:
        return math.nan
    if paired:
        gain = a - b
        signed = scipy.stats.rankdata(np.abs(gain)) * np.sign(gain)
        return _p_of_ranks((tuple(np.sort(signed).tolist()),)) if gain.any() else 1.0
    together = scipy.stats.rankdata(np.concatenate([a, b]))
    if constant(np.concatenate([a, b])):
        return 1.0
    return _p_of_ranks(tuple(tuple(np.sort(each).tolist()) for each in np.split(together, [len(a)])))


@lru_cache(maxsize=4096)
def _p_of_ranks(ranks: tuple[tuple[float, ...], ...]) -> float:
    """Return the p of one sample of signed ranks, or of two samples of ranks; cached, since ranks recur."""
    kind = "samples" if len(ranks) == 1 else "independent"
    done = scipy.stats.permutation_test(
        tuple(map(np.asarray, ranks)),
        _mean_difference,
        permutation_type=kind,
        vectorized=True,
        n_resamples=RESAMPLES,
        axis=-1,
        rng=0,
    )
    return float(done.pvalue)


def _mean_difference(*ranks: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
    first = ranks[0].mean(axis=axis)
    return np.asarray(first - ranks[1].mean(axis=axis) if len(ranks) > 1 else first)


def least_p(n: int, m: int, paired: bool = False) -> float:
    """Return the smallest possible two-sided p of ``permutation_p`` of n and m runs."""
    if min(n, m) < 2:
        return math.nan
    ways = 2**n if paired else math.comb(n + m, n)
    return min(1.0, max(2.0 / ways, LEAST_RANDOM_P))


def runs_for_significance(paired: bool = False, figures: int = 1, alpha: float = ALPHA) -> int | None:
    """Return the fewest runs per group for one of ``figures`` comparisons to be significant; None if none suffice."""
    if LEAST_RANDOM_P * figures > alpha:
        return None
    n = 2
    while least_p(n, n, paired) * figures > alpha:
        n += 1
    return n


def holm(p_values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number (Holm 1979), in the same order; NaNs stay and are not counted."""
    p = np.asarray(p_values, dtype=np.float64)
    adjusted = np.full_like(p, np.nan)
    order = np.argsort(p)[: np.isfinite(p).sum()]  # NaNs come last
    adjusted[order] = np.maximum.accumulate(np.minimum(p[order] * np.arange(len(order), 0, -1), 1.0))
    return [float(value) for value in adjusted]


def yuen(a: NDArray[np.float64], b: NDArray[np.float64], paired: bool = False) -> Interval:
    """Return the difference of interquartile means with Yuen's interval (1974); of pairs, that of their differences.

    The interval is NaN where both groups, or the differences of pairs, are constant and the estimate is not zero.
    """
    parts = [a - b] if paired else [a, b]
    n = min(len(part) for part in parts)
    if not n:
        return Interval(math.nan, math.nan, math.nan, 0)
    estimate = float(iqm(parts[0]) - (0.0 if paired else iqm(b)))
    if n < 2:
        return Interval(estimate, math.nan, math.nan, n)
    trim = TRIM if n >= WINSORISED_FROM else 0.0
    if all(constant(part, trim) for part in parts):
        bound = 0.0 if estimate == 0.0 else math.nan
        return Interval(estimate, bound, bound, n)
    if paired:
        return iqm_interval(parts[0])
    centred = (part - np.median(part) for part in parts)  # exact for a constant group; only the width is used
    bounds = scipy.stats.ttest_ind(*centred, equal_var=False, trim=trim).confidence_interval(LEVEL)
    shift = estimate - 0.5 * (bounds.low + bounds.high)
    return Interval(estimate, float(bounds.low + shift), float(bounds.high + shift), n)


def hedges(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return Hedges' g: the difference of means in pooled standard deviations, corrected for few runs; or NaN."""
    n, m = len(a), len(b)
    if min(n, m) < 2 or (constant(a) and constant(b)):
        return math.nan
    pooled = math.sqrt(((n - 1) * a.var(ddof=1) + (m - 1) * b.var(ddof=1)) / (n + m - 2))
    return float((a.mean() - b.mean()) / pooled * (1.0 - 3.0 / (4.0 * (n + m) - 9.0)))


def probability_of_improvement(a: ArrayLike, b: ArrayLike) -> float:
    """Return the probability that a run of ``a`` has more than one of ``b``, ties half; of (n, tasks), mean over tasks.

    The Mann-Whitney statistic over n m, as in rliable.
    """
    x, y = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if not len(x) or not len(y):
        return math.nan
    above, equal = x[:, None] > y[None, :], x[:, None] == y[None, :]
    return float((above + 0.5 * equal).mean())


def runs_needed(a: NDArray[np.float64], b: NDArray[np.float64], alpha: float = ALPHA) -> int | None:
    """Return the runs per group needed to detect the observed difference with 80 % power; None if undefined.

    The normal approximation for two groups, with a quarter of the squared quantile for Student's: n = (z_alpha +
    z_power)^2 (s_a^2 + s_b^2) / d^2 + z_alpha^2 / 4.
    """
    if min(len(a), len(b)) < 2 or a.mean() == b.mean():
        return None
    z_alpha, z_power = float(scipy.stats.norm.ppf(1.0 - 0.5 * alpha)), float(scipy.stats.norm.ppf(POWER))
    ratio = (a.var(ddof=1) + b.var(ddof=1)) / (a.mean() - b.mean()) ** 2
    needed = (z_alpha + z_power) ** 2 * ratio + 0.25 * z_alpha**2
    least = runs_for_significance(alpha=alpha)
    return max(least, math.ceil(needed)) if least is not None and needed < 1e6 else None


def verdict_by_p(estimate: float, p: float, better: Direction) -> Word:
    """Return the verdict on a difference, group - baseline, by its adjusted p."""
    if not (math.isfinite(p) and p <= ALPHA) or estimate == 0.0:
        return "no significant difference"
    return "better" if (estimate > 0.0) == (better == "higher") else "worse"


FEWEST_PAIRS = 3  # pairs from which a difference may be significant: the spread of two is hardly known


def verdict_by_interval(between: Interval, better: Direction) -> Word:
    """Return the verdict on a difference, other - first, by whether its interval excludes zero; none from two pairs."""
    if between.n < FEWEST_PAIRS or not (math.isfinite(between.low) and math.isfinite(between.high)):
        return "no significant difference"
    if between.low > 0.0 or between.high < 0.0:
        return "better" if (between.low > 0.0) == (better == "higher") else "worse"
    return "no significant difference"
