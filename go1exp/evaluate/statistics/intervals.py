"""Intervals of figures over robots: means, phases, shares, rates, thresholds, differences between pairs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

LEVEL = 0.95

ROUNDING = 1e-9
"""Values that vary by less than this share of their largest are the same."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its confidence interval, and the number of robots that it stands on."""

    estimate: float
    low: float
    high: float
    n: int


def alike(values: ArrayLike, trim: float = 0.0) -> bool:
    """Return whether values are the same but for rounding; NaNs, and a share ``trim`` at each end, are left out.

    Of such values nothing says how sure they are: no interval and no effect size can be made of them.
    """
    each = np.asarray(values, dtype=np.float64).ravel()
    each = np.sort(each[np.isfinite(each)])
    cut = int(trim * len(each))
    middle = each[cut : len(each) - cut]
    return not len(middle) or bool(np.ptp(middle) <= ROUNDING * np.abs(each).max())


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


# ---------------------------------------------------------------------- counts, medians, curves


def rate_interval(count: int, exposure: float, level: float = LEVEL) -> Interval:
    """Return ``count`` / ``exposure`` with the exact Poisson interval (Garwood 1936); n is the count."""
    from scipy import stats

    if not exposure > 0:
        return Interval(np.nan, np.nan, np.nan, count)
    tail = 0.5 * (1.0 - level)
    low = stats.chi2.ppf(tail, 2 * count) / 2.0 if count else 0.0
    high = stats.chi2.ppf(1.0 - tail, 2 * count + 2) / 2.0
    return Interval(count / exposure, float(low / exposure), float(high / exposure), count)


def bootstrap_interval(
    function: Callable[[NDArray[np.intp]], float], n: int, draws: int = 400, level: float = LEVEL, seed: int = 0
) -> Interval:
    """Return ``function`` of all of n robots, with its percentile interval over robots drawn with replacement.

    For what has no interval of its own, such as thresholds and areas. It is too narrow for few: of the mean of normal
    values it holds the truth in 79, 86 and 90 of 100 studies of 4, 6 and 10 robots (docs/notebook/experiments.md).

    Args:
        function: a figure of the robots with these numbers (n,), each in 0 to n - 1; NaN where it is not defined.
        n: robots.
        draws: how many samples.
        level: of the interval.
        seed: of the draws.
    """
    estimate = float(function(np.arange(n))) if n else np.nan
    if n < 2 or not np.isfinite(estimate):
        return Interval(estimate, np.nan, np.nan, n)
    rng = np.random.default_rng(seed)
    each = np.array([function(rng.integers(n, size=n)) for _ in range(draws)])
    each = each[np.isfinite(each)]
    if len(each) < 0.5 * draws:  # mostly undefined: nothing can be said
        return Interval(estimate, np.nan, np.nan, n)
    low, high = np.quantile(each, [0.5 - 0.5 * level, 0.5 + 0.5 * level])
    return Interval(estimate, float(low), float(high), n)


@dataclass(frozen=True)
class Logistic:
    """Share of successes at x: 1 / (1 + exp(slope (x - middle))); ``middle`` is where half succeed."""

    middle: float
    slope: float

    def __call__(self, x: ArrayLike) -> NDArray[np.float64]:
        """Return the share at ``x``."""
        from scipy.special import expit

        return np.asarray(expit(-self.slope * (np.asarray(x, dtype=np.float64) - self.middle)))

    def where(self, share: float) -> float:
        """Return the x at which that share succeeds."""
        return self.middle - float(np.log(share / (1.0 - share))) / self.slope


def logistic_fit(x: ArrayLike, success: ArrayLike) -> Logistic | None:
    """Fit falling success (E,) of 0 or 1 against x (E,) by maximum likelihood; None where all or none succeed.

    A Gaussian prior on the logarithm of the slope, wide by a factor of e^2 about eight over the range of x, keeps
    the fit finite where success and failure do not overlap.
    """
    from scipy import optimize

    at, won = np.asarray(x, dtype=np.float64), np.asarray(success, dtype=np.float64)
    if not len(at) or won.min() == won.max() or at.min() == at.max():
        return None
    span = float(np.ptp(at))
    levels, level = np.unique(at, return_inverse=True)
    wins, trials = np.bincount(level, won), np.bincount(level)

    def loss(values: NDArray[np.float64]) -> float:
        logit = -np.exp(values[1]) * ((levels - at.min()) / span - values[0])
        fit = wins * np.logaddexp(0.0, -logit) + (trials - wins) * np.logaddexp(0.0, logit)
        return float(fit.sum() + 0.5 * ((values[1] - np.log(8.0)) / 2.0) ** 2)

    start = np.array([float(won.mean()), np.log(8.0)])
    solution = optimize.minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-6})
    return Logistic(float(at.min() + span * solution.x[0]), float(np.exp(solution.x[1]) / span))


# ---------------------------------------------------------------------- pairs


def paired_mean_interval(difference: ArrayLike, level: float = LEVEL) -> Interval:
    """Return the mean of one difference per robot with Student's t interval; NaNs are left out.

    Not the bootstrap's, which is too narrow for few: of two robots it is clear of zero every other time although
    nothing differs. Where all differences are the same and not zero, as those of coarse figures of few robots can be,
    nothing says how sure that is: the interval is NaN.
    """
    around = mean_interval(difference, level)
    if around.n > 1 and around.estimate != 0.0 and alike(difference):
        return Interval(around.estimate, np.nan, np.nan, around.n)
    return around


def paired_share_interval(first: ArrayLike, second: ArrayLike, level: float = LEVEL) -> Interval:
    """Return the share of ``second`` less that of ``first``, of the same robots, with Agresti and Min's interval.

    Half a robot is added to each of the four outcomes of a pair (Agresti and Min, Statistics in Medicine 24, 2005),
    so that no interval has the width zero, as the bootstrap's has where all pairs agree.
    """
    from scipy import stats

    a, b = np.asarray(first, dtype=bool), np.asarray(second, dtype=bool)
    n = len(a)
    if not n:
        return Interval(np.nan, np.nan, np.nan, 0)
    gained, lost, all_of = (~a & b).sum() + 0.5, (a & ~b).sum() + 0.5, n + 2.0
    middle = (gained - lost) / all_of
    spread = np.sqrt((gained + lost - (gained - lost) ** 2 / all_of) / all_of**2)
    half = float(stats.norm.ppf(0.5 + 0.5 * level) * spread)
    return Interval(float(b.mean() - a.mean()), max(middle - half, -1.0), min(middle + half, 1.0), n)


def stratified_mean_interval(values: ArrayLike, strata: ArrayLike, level: float = LEVEL) -> Interval:
    """Return the mean of the strata's means with Student's interval of what varies within them; NaNs are left out.

    For one value per robot under several conditions, which are the same in every evaluation: that conditions differ
    makes nothing uncertain. The variance is pooled over the strata. The interval is NaN where nothing varies.

    Args:
        values: (n,).
        strata: (n,) which stratum each is of.
        level: of the interval.
    """
    from scipy import stats

    each = np.asarray(values, dtype=np.float64).ravel()
    known = np.isfinite(each)
    each, (labels, stratum) = each[known], np.unique(np.asarray(strata).ravel()[known], return_inverse=True)
    if not len(each):
        return Interval(np.nan, np.nan, np.nan, 0)
    sizes = np.bincount(stratum)
    means = np.bincount(stratum, each) / sizes
    estimate, free = float(means.mean()), len(each) - len(labels)
    within = float(((each - means[stratum]) ** 2).sum())
    if not free or np.sqrt(within / free) <= ROUNDING * np.abs(each).max():
        return Interval(estimate, np.nan, np.nan, len(each))
    error = np.sqrt(within / free * (1.0 / sizes).sum()) / len(labels)
    half = float(stats.t.ppf(0.5 + 0.5 * level, free) * error)
    return Interval(estimate, estimate - half, estimate + half, len(each))


def pairs_needed(difference: ArrayLike, power: float = 0.8, level: float = LEVEL) -> int | None:
    """Return how many robots would tell a mean difference like the one seen from zero; None if it is zero or constant.

    The normal approximation of a paired test: ((z_level + z_power) sd / mean)^2.
    """
    from scipy import stats

    each = np.asarray(difference, dtype=np.float64).ravel()
    each = each[np.isfinite(each)]
    if len(each) < 2 or each.mean() == 0.0 or alike(each):
        return None
    z = float(stats.norm.ppf(0.5 + 0.5 * level) + stats.norm.ppf(power))
    return max(2, int(np.ceil((z * each.std(ddof=1) / each.mean()) ** 2)))
