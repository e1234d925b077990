"""Judgement on data that no fit has seen: splits, sign flips, sets of equals, resamplings."""

from __future__ import annotations

import numpy as np

from go1exp.gap.result import GapSettings
from go1exp.gap.score.robust import log_chi2

FLIPS = 4000
"""Sign flips of a test: the smallest p-value is 1 / (FLIPS + 1)."""

SAME = 0.02
"""Gains of log chi2 that differ by less mean the same: 2 % of the floor, or of the larger of the gains."""

WORSE = 0.05
"""A model with a p-value below this is worse than another."""

LEAST = 0.7
"""A model with less than this share of the best one's gain is no equal, however uncertain."""

FEW_WINDOWS = 10.0
"""Times ``alpha`` of the settings that are enough for what removes ``LARGE`` of a gap: a stop or a limit of the torque
shows in few windows, and flipped signs cannot call three of them significant. Of sealed effects that removed so much
with p of 0.01 to 0.1, and did not come second to another one, all three were right; what removed half to ``LARGE``, one
of three."""

LARGE = 0.75
"""Share of the excess that only the right effect removes, or one that acts alike."""


def gains(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the fall of log chi2 (M, V G) of models in every window and group of joints.

    Groups do not feel each other, so each is a judgement of its own; an effect that few windows show needs them all.

    Args:
        before: chi2 per value (V, G).
        after: the same of each model (M, V, G).
    """
    return np.asarray(log_chi2(before) - log_chi2(after)).reshape(len(after), -1)


def max_t(gain: np.ndarray, rng: np.random.Generator, groups: int = 1, flips: int = FLIPS) -> np.ndarray:
    """Return a p-value (M,) for each of M models' mean gain (M, V G), right for all of them together.

    Under the hypothesis that a model gains nothing, a window's gain is as likely negative. All models' signs are
    flipped together, window by window, and each is compared with the largest statistic of all. Beside the mean over
    all, each group of joints is looked at by itself: what one joint of one leg lacks, the other legs' noise would hide.

    Args:
        gain: of every window and group, the groups of a window side by side.
        rng: of the flips.
        groups: G.
        flips: of signs.
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
    """Return which models (M,) held-out windows show to be better.

    Args:
        p: p-value (M,) of each model's gain.
        share: of the excess that is gone (M,).
        before: excess of the model with which they are compared.
        settings: significance, and the excess that is a gap.
    """
    large = (share >= LARGE) & (before > settings.material)
    return np.asarray((p < settings.alpha) | (large & (p < FEW_WINDOWS * settings.alpha)))


def same(gain: float) -> float:
    """Return by how much the mean of another model's gain may be smaller and still mean the same."""
    return SAME * max(1.0, gain)


def equals(gain: np.ndarray, best: int, rng: np.random.Generator) -> np.ndarray:
    """Return which models (M,) do as well as ``best`` by their gains (M, V): all but so, or not significantly worse."""
    mean = gain.mean(axis=1)
    equal = mean >= mean[best] - same(mean[best])
    for k in np.flatnonzero(~equal & (mean > LEAST * mean[best])):
        equal[k] = max_t((gain[best] - gain[k])[None], rng)[0] > WORSE
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
