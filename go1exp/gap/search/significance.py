"""Tests on data that no fit has seen: splits, sign flips, sets of equals, resamplings."""

from __future__ import annotations

import numpy as np

from go1exp.gap.result import GapSettings
from go1exp.gap.score.likelihood import log_chi2
from go1exp.gap.search import thresholds


def gains(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the fall of log chi2 (M, V G) of models (M, V, G), of each window and group of joints by itself."""
    return np.asarray(log_chi2(before) - log_chi2(after)).reshape(len(after), -1)


def max_t(
    gain: np.ndarray, rng: np.random.Generator, groups: int = 1, flips: int = thresholds.SIGN_FLIPS
) -> np.ndarray:
    """Return a p-value (M,) for each of M models' mean gain (M, V G), right for all of them together.

    Under the hypothesis that a model gains nothing, a window's gain is as likely negative. All models' signs are
    flipped together, window by window, and each is compared with the largest statistic of all. Beside the mean over
    all, each of the G groups of joints, which are side by side in a window, is looked at by itself: noise of the other
    legs would hide an effect at one joint.
    """
    signs = rng.choice([-1.0, 1.0], size=(flips, gain.shape[1]))
    parts = [slice(None), *(slice(g, None, groups) for g in range(groups if groups > 1 else 0))]
    largest, observed = [], []
    for part in parts:
        gains_there = gain[:, part]
        scale = np.sqrt(np.mean(gains_there**2, axis=1)) / np.sqrt(gains_there.shape[1]) + 1e-12
        largest.append(((signs[:, part] @ gains_there.T) / gains_there.shape[1] / scale).max(axis=1))
        observed.append(gains_there.mean(axis=1) / scale)
    of_all = np.max(largest, axis=0)
    return np.asarray([(1 + np.sum(of_all >= s - 1e-12)) / (flips + 1) for s in np.max(observed, axis=0)])


def shown(p: np.ndarray, share: np.ndarray, before: float, settings: GapSettings) -> np.ndarray:
    """Return which models (M,) held-out windows show to be better."""
    large = (share >= thresholds.LARGE_SHARE) & (before > settings.material)
    return np.asarray((p < settings.alpha) | (large & (p < thresholds.LARGE_ALPHA * settings.alpha)))


def same(gain: float) -> float:
    """Return by how much the mean of another model's gain may be smaller and still mean the same."""
    return thresholds.SAME_GAIN * max(1.0, gain)


def equals(gain: np.ndarray, best: int, rng: np.random.Generator) -> np.ndarray:
    """Return which models (M,) do as well as ``best`` by their gains (M, V): all but so, or not significantly worse."""
    mean = gain.mean(axis=1)
    equal = mean >= mean[best] - same(mean[best])
    for k in np.flatnonzero(~equal & (mean > thresholds.EQUAL_SHARE * mean[best])):
        equal[k] = max_t((gain[best] - gain[k])[None], rng)[0] > thresholds.WORSE_P
    equal[best] = True
    return np.asarray(equal)


def resampled(episode: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a bootstrap sample of windows (numbers): episodes, then their windows."""
    units = np.unique(episode)
    picked = []
    for unit in rng.choice(units, len(units)):
        rows = np.flatnonzero(episode == unit)
        picked.append(rng.choice(rows, len(rows)))
    return np.concatenate(picked)
