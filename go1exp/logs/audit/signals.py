"""Estimators that need no model of the robot: step, noise, stale samples, clipping, scale between two channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import linear_sum_assignment

import go1exp.logs.audit.limits as limits

MOST_GAPS = 300
"""Most gaps in which a step is searched; of more, a part is taken, evenly over their sorted order."""


def stretches(flags: np.ndarray) -> list[tuple[int, int]]:
    """Return (first, end) of each run of true ``flags`` (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def quantum(values: np.ndarray) -> float:
    """Return the quantisation step of ``values`` (T,): all differences are whole multiples of it; 0 if there is none.

    Candidates are small gaps between neighbouring distinct values, and fractions of them. A candidate is refined by
    regression on larger and larger gaps. It is accepted if the gaps are whole multiples of it: the mean resultant of
    their phases exceeds 0.9, which allows for rounding to a tenth of a step, as in decimal text.
    """
    distinct = np.unique(values)
    gaps = np.diff(distinct)
    largest = float(np.abs(distinct[[0, -1]]).max())
    gaps = np.sort(gaps[gaps > 1e-9 * largest])
    if len(gaps) < (
        2 if len(values) > 20 * len(distinct) else 10
    ):  # few distinct values that occur often are quantised too
        return 0.0
    gaps = gaps[:: -(-len(gaps) // MOST_GAPS)]
    guesses = {float(gaps[int(share * len(gaps))]) / m for share in (0, 0.02, 0.1, 0.5) for m in range(1, 7)}
    steps = _refined(gaps, np.array(sorted(guesses, reverse=True)))
    steps = steps[steps > limits.CONTINUOUS * largest]
    whole = np.abs(np.exp(2j * np.pi * gaps / steps[:, None]).mean(axis=1)) > 0.9
    return float(steps[whole][0]) if whole.any() else 0.0


def _refined(gaps: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Refine candidates (C,) by regression of ``gaps`` (G,) on whole multiples of them, of larger and larger gaps."""
    refining = np.ones(len(steps), dtype=bool)
    for most in (3, 10, 30, 100):
        count = np.round(gaps / steps[:, None])
        count[(count < 1) | (count > most)] = 0.0
        squares = np.einsum("cg,cg->c", count, count)
        refining &= squares > 0  # a candidate is left as it is from where no gap is near enough
        steps = np.where(refining, count @ gaps / np.maximum(squares, 1.0), steps)
    return steps


def noise(values: np.ndarray) -> tuple[float, bool]:
    """Return the standard deviation of white noise on a smooth signal (T,), and whether it looks white.

    Third differences remove the smooth part; their median ignores rare events. Fifth differences give the same value
    for white noise and another one for motion.
    """
    if len(values) < limits.ENOUGH:
        return float("nan"), False
    sigma = []
    for order, gain in ((3, 20.0), (5, 252.0)):  # sums of the squared binomial coefficients
        d = np.diff(values, order)
        sigma.append(1.4826 * float(np.median(np.abs(d - np.median(d)))) / np.sqrt(gain))
    # 1.4826 times the median absolute deviation is the standard deviation of a Gaussian.
    sigma = [s if s > 1e-9 * float(np.ptp(values)) else 0.0 for s in sigma]
    white = sigma[0] > 0 and limits.WHITE[0] < sigma[1] / sigma[0] < limits.WHITE[1]
    return sigma[0], white


@dataclass(frozen=True)
class Repeats:
    """Samples (T,) at which a channel moved, the stale ones of them, and the share of stale ones beyond chance."""

    moving: np.ndarray
    stale: np.ndarray
    share: float


def repeats(values: np.ndarray, step: float, reach: int) -> Repeats:
    """Find samples that repeat the one before although the channel moves.

    A channel moves at a sample if, over the ``reach`` samples before it and those after it, it changes in the same
    direction and by at least two steps per sample. A value may then repeat by chance, but not more often than it
    changes by one step; only the repeats beyond that count.
    """
    n = len(values)
    moving, same = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    same[1:] = values[1:] == values[:-1]
    least = reach * max(2 * step, 1e-7 * float(np.ptp(values)))
    i = np.arange(reach + 1, n - reach)
    if least == 0 or not len(i):
        return Repeats(moving, same & moving, 0.0)
    before, after = values[i - 1] - values[i - 1 - reach], values[i + reach] - values[i]
    moving[i] = (np.abs(before) >= least) & (np.abs(after) >= least) & (before * after > 0)
    forward = (values[i] - values[i - 1]) * np.sign(after)
    natural = np.sum(moving[i] & (forward > 0.5 * step) & (forward < 1.5 * step)) if step else 0
    count, twice = int(moving.sum()), int(np.sum(same & moving))
    excess = twice - int(natural)
    sure = count >= limits.ENOUGH and excess > limits.SURE * np.sqrt(twice + natural)
    return Repeats(moving, same & moving, excess / count if sure else 0.0)


def clipped(values: np.ndarray, step: float) -> tuple[float, list[float]]:
    """Return the share of samples (T,) on flat maxima or minima that are entered or left at speed, and their levels.

    A smooth signal comes to its peak with zero speed; a clipped one does not.
    """
    span = float(np.ptp(values))
    share, levels = 0.0, []
    for level in (float(values.max()), float(values.min())):
        runs = [(a, b) for a, b in stretches(np.abs(values - level) <= 1e-9 * span) if b - a >= limits.PLATEAU]
        fast = max(6 * step, 1e-3 * span)  # over two samples, as the first may just miss the level
        around = [[values[i] for i in (a - 2, b + 1) if 0 <= i < len(values)] for a, b in runs]
        hard = [run for run, v in zip(runs, around, strict=True) if v and np.abs(np.array(v) - level).min() > fast]
        if len(hard) >= 2 or any(b - a >= 2 * limits.PLATEAU for a, b in hard):
            share += sum(b - a for a, b in hard) / len(values)
            levels.append(level)
    return share, levels


@dataclass(frozen=True)
class Scale:
    """One channel against another: factor, its standard error, correlation."""

    factor: float
    error: float
    correlation: float


def scale(reference: np.ndarray, other: np.ndarray, blocks: int = 10) -> Scale | None:
    """Return how large ``other`` (N,) is against ``reference`` (N,), with a jackknife error over ``blocks`` in time.

    Least squares: noise of ``other`` does not bias it. None if there are too few samples or nothing varies.
    """
    if len(reference) < limits.ENOUGH:
        return None
    parts = np.array_split(np.arange(len(reference)), blocks)
    sums = np.array([[a @ a, a @ b, b @ b] for a, b in ((reference[p], other[p]) for p in parts)])
    total = sums.sum(axis=0)
    if total[0] <= 0 or total[2] <= 0:
        return None

    def factor(s: np.ndarray) -> float:
        return float(s[1] / s[0]) if s[0] > 0 else float("nan")

    left_out = np.array([factor(total - s) for s in sums])
    spread = np.std(left_out) * np.sqrt(blocks - 1)
    return Scale(factor(total), float(spread), float(total[1] / np.sqrt(total[0] * total[2])))


def antiderivative(t: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Integrate a cubic spline through ``rate`` (T, ...) from the first sample to each."""
    return CubicSpline(t, rate, axis=0).antiderivative()(t)


def mixed_up(match: np.ndarray) -> dict[int, int]:
    """Return which columns the rows of ``match`` (J, J; correlations) belong to, for those that are not in place.

    The best assignment is split into cycles (a swap is a cycle of two). A cycle counts only if every member of it
    matches its new partner clearly, and clearly better than itself; a single joint that matches badly is not enough.
    """
    size = np.abs(match)
    diagonal = np.diag(size)
    _, partner = linear_sum_assignment(-(size**2))
    partners: dict[int, int] = {}
    for start in range(len(partner)):
        cycle, k = [start], int(partner[start])
        while k != start:
            cycle.append(k)
            k = int(partner[k])
        better = [size[j, partner[j]] > max(limits.CLEARLY, diagonal[j] + limits.BETTER) for j in cycle]
        if len(cycle) > 1 and all(better):
            partners[start] = int(partner[start])
    return partners
