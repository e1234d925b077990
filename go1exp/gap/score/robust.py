"""The one measure of how wrong a model is on windows, of which a few may be wild, and others show a joint at rest.

``log_chi2`` is what fits make small and what tests compare, window by window. ``excess`` is the level that is reported
and compared with limits. Everything in the workflow that judges a model uses these two.
"""

from __future__ import annotations

import numpy as np

KNEE = 10.0
"""chi2 per value from which a window counts by its logarithm: 5 % of the windows of a real robot made 35 to 85 % of a
plain mean, and so decided alone what was named. Up to it the level is the plain mean, to which all limits belong."""


def log_chi2(chi2: np.ndarray) -> np.ndarray:
    """Return the logarithm of chi2 per value, below 1 continued by its tangent, so never less than -1.

    A joint that rests in a model with dry friction does not move at all, and chi2 of such a window can be 1e-11. Below
    the floor there is nothing to be gained, and the logarithm of that would outweigh all else. The slope is
    1 / max(chi2, 1), the weight that windows have in the fits.
    """
    return np.where(chi2 < 1.0, chi2 - 1.0, np.log(np.maximum(chi2, 1.0)))


def excess(chi2: np.ndarray) -> float:
    """Return the typical excess of chi2 per value (any shape) over its floor of 1; NaN of nothing."""
    return float(weighted_excess(chi2.ravel(), np.ones(chi2.size)))


def weighted_excess(chi2: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the typical excess (...) of chi2 per value (N, ...), each with its weight (N, ...); NaN without any.

    The mean f^-1(mean f(chi2)) of Kolmogorov (1930) with f the identity up to ``KNEE`` and a logarithm beyond: the
    plain mean where no window is wild, and close to the geometric mean where all are far from the floor.
    """
    value = np.minimum(chi2, KNEE) + KNEE * np.log(np.maximum(chi2, KNEE) / KNEE)
    whole = np.asarray(weight.sum(axis=0), dtype=float)
    level = np.divide((value * weight).sum(axis=0), whole, where=whole > 0, out=np.full(whole.shape, np.nan))
    return np.where(level > KNEE, KNEE * np.exp(level / KNEE - 1.0), level) - 1.0


def removed(before: float, after: float) -> float:
    """Return the share of an excess that is gone; what lies below the floor counts as nothing."""
    return 1.0 - max(after, 0.0) / before if before > 0 else 0.0
