"""Correlates of a quantity: rank correlation with its test, and permutation importance."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

RESAMPLES = 9_999  # most permutations of a test
FOLDS = 5  # folds of the cross-validation
SHUFFLES = 20  # permutations of a quantity for its importance
LARGE = 500  # largest number of values with a permutation test; more are tested by Student's approximation


@dataclass(frozen=True)
class Association:
    """Correlation of one quantity with another."""

    name: str
    spearman: float  # rank correlation; NaN for categories
    p: float  # of the correlation, two-sided, or of the variance between categories; by permutation
    importance: float  # explained share of the variance; 0 or less is none
    n: int


def spearman(x: ArrayLike, y: ArrayLike) -> tuple[float, float]:
    """Return the rank correlation of x (n,) with y (n,), and its two-sided p by permutation; NaN where undefined."""
    a, b = scipy.stats.rankdata(x), scipy.stats.rankdata(y)
    if len(a) < 3 or np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
        return math.nan, math.nan
    if len(a) > LARGE:
        done = scipy.stats.spearmanr(a, b)
        return float(done.statistic), float(done.pvalue)
    centred = (b - b.mean()) / (len(b) * b.std())

    def statistic(drawn: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
        scaled = (drawn - drawn.mean(axis=axis, keepdims=True)) / a.std()
        return np.asarray((scaled * centred).sum(axis=axis))

    test = _permuted(a, statistic, "two-sided")
    return float(test.statistic), float(test.pvalue)


def _permuted(values: NDArray[np.float64], statistic: Callable[..., NDArray[np.float64]], alternative: str) -> Any:
    options = {"permutation_type": "pairings", "vectorized": True, "n_resamples": RESAMPLES, "rng": 0}
    return scipy.stats.permutation_test((values,), statistic, alternative=alternative, **options)


def explained_by_names(names: ArrayLike, y: ArrayLike) -> float:
    """Return the p of the variance of y (n,) between categories ``names`` (n,), by permutation."""
    values = scipy.stats.rankdata(y)
    labels, which = np.unique(np.asarray(names, dtype=str), return_inverse=True)
    if len(labels) < 2 or len(labels) == len(values) or np.ptp(values) == 0.0:
        return math.nan
    counts = np.bincount(which)
    member = np.eye(len(labels))[which]  # (n, names)

    def between(drawn: NDArray[np.float64], axis: int = -1) -> NDArray[np.float64]:
        means = np.moveaxis(drawn, axis, -1) @ member / counts
        return np.asarray((counts * means**2).sum(-1))

    return float(_permuted(values, between, "greater").pvalue)


def associations(quantities: Mapping[str, ArrayLike], figure: ArrayLike) -> list[Association]:
    """Return the correlation of each of several quantities (n,) with ``figure`` (n,), the most important first.

    Rows with undefined values and constant quantities are ignored. The importance is that of a cross-validated linear
    model of ranks (one column per category), which misses effects that are not monotone, and interactions.
    """
    y = np.asarray(figure, dtype=np.float64)
    kept = np.isfinite(y)
    columns = {name: np.asarray(values) for name, values in quantities.items()}
    for values in columns.values():
        if values.dtype.kind in "fiub":
            kept &= np.isfinite(values.astype(np.float64))
    y = y[kept]
    columns = {name: values[kept] for name, values in columns.items() if len(np.unique(values[kept])) > 1}
    importance = permutation_importance(columns, y)
    entries = []
    for name, values in columns.items():
        if values.dtype.kind in "fiub":
            rho, p = spearman(values.astype(np.float64), y)
        else:
            rho, p = math.nan, explained_by_names(values, y)
        entries.append(Association(name, rho, p, importance[name], len(y)))
    return sorted(entries, key=lambda e: -e.importance if math.isfinite(e.importance) else math.inf)


def permutation_importance(columns: Mapping[str, np.ndarray], y: NDArray[np.float64]) -> dict[str, float]:
    """Return the share of y's rank variance that each quantity explains; NaN with few rows.

    Each row is predicted from the other folds; shuffling a quantity raises the mean square error by twice its
    share (Breiman 2001, with a linear model in place of a forest).
    """
    n = len(y)
    blocks = {name: _features(values) for name, values in columns.items()}
    width = sum(block.shape[1] for block in blocks.values())
    if n < max(2 * FOLDS, 2 * (width + 1)) or np.ptp(y) == 0.0:
        return dict.fromkeys(columns, math.nan)
    ranks = scipy.stats.rankdata(y)
    target = (ranks - ranks.mean()) / ranks.std()
    rng = np.random.default_rng(0)
    fold = rng.permutation(np.arange(n) % FOLDS)
    design = np.column_stack([np.ones(n), *blocks.values()])
    weights = [np.linalg.lstsq(design[fold != k], target[fold != k], rcond=None)[0] for k in range(FOLDS)]

    def error(matrix: NDArray[np.float64]) -> float:
        predicted = np.empty(n)
        for k in range(FOLDS):
            predicted[fold == k] = matrix[fold == k] @ weights[k]
        return float(((target - predicted) ** 2).mean())

    usual, first, importance = error(design), 1, {}
    for name, block in blocks.items():
        columns_of = slice(first, first + block.shape[1])
        first += block.shape[1]
        losses = []
        for _ in range(SHUFFLES):
            shuffled = design.copy()
            shuffled[:, columns_of] = block[rng.permutation(n)]
            losses.append(error(shuffled))
        importance[name] = 0.5 * (float(np.mean(losses)) - usual)
    return importance


def _features(values: np.ndarray) -> NDArray[np.float64]:
    """Return the columns of a quantity: its ranks, or one for each category but the first."""
    if values.dtype.kind in "fiub":
        ranks = scipy.stats.rankdata(values)
        return np.asarray((ranks - ranks.mean()) / ranks.std())[:, None]
    labels, which = np.unique(values.astype(str), return_inverse=True)
    return np.asarray(np.eye(len(labels))[which][:, 1:])
