"""Judgement on data that no fit has seen: splits, sign flips, sets of equals, resamplings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.recording import Meta

FLIPS = 4000
"""Sign flips of a test: the smallest p-value is 1 / (FLIPS + 1)."""

SAME = 0.02
"""Gains of log chi2 that differ by less mean the same: 2 % of the floor."""

WORSE = 0.05
"""A model with a p-value below this is worse than another."""

LEAST = 0.7
"""A model with less than this share of the best one's gain is no equal, however uncertain."""


@dataclass(frozen=True)
class Splits:
    """Numbers of the windows that models are fitted on, chosen by, and finally confirmed on."""

    train: np.ndarray
    select: np.ndarray
    confirm: np.ndarray
    by_episode: bool


def splits(metas: Sequence[Meta], episode: np.ndarray, confirm: float, rng: np.random.Generator) -> Splits:
    """Split windows by episode so that every part has, if it can, every excitation and every gain set.

    An episode and its repetition stay together. With fewer than three different episodes, stretches of windows are
    split instead.

    Args:
        metas: of the recordings.
        episode: (W,) recording of each window.
        confirm: share for the last check.
        rng: of the search for a good split.
    """
    names = [m.repeat_of or m.episode for m in metas]
    units = list(dict.fromkeys(names))
    by_episode = len(units) >= 3
    if by_episode:
        unit = np.array([units.index(names[e]) for e in episode])
    else:
        first = np.searchsorted(episode, episode)
        unit = np.unique(episode * 1000 + (np.arange(len(episode)) - first) // 3, return_inverse=True)[1]
    count = int(unit.max()) + 1
    about = [metas[episode[np.flatnonzero(unit == u)[0]]] for u in range(count)]
    last = max(1, round(confirm * count)) if confirm and count > 3 else 0
    middle = max(1, round(0.45 * (count - last)))
    best, chosen = -1.0, np.arange(count)
    for _ in range(400):
        order = rng.permutation(count)
        parts = order[last + middle :], order[last : last + middle], order[:last]
        value = 0.0
        for part, weight in zip(parts, (2.0, 1.5, 1.0), strict=True):
            value += weight * len({about[u].excitation for u in part})
            value += weight * len({(about[u].kp, about[u].kd) for u in part})
        if value > best + 1e-9:
            best, chosen = value, order
    parts = chosen[last + middle :], chosen[last : last + middle], chosen[:last]
    train, select, kept = (np.flatnonzero(np.isin(unit, part)) for part in parts)
    return Splits(train, select, kept, by_episode)


def gains(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the fall of log chi2 (M, V G) of models in every window and group of joints.

    Groups do not feel each other, so each is a judgement of its own; an effect that few windows show needs them all.

    Args:
        before: chi2 per value (V, G).
        after: the same of each model (M, V, G).
    """
    return np.asarray(np.log(before) - np.log(after)).reshape(len(after), -1)


def max_t(gain: np.ndarray, rng: np.random.Generator, flips: int = FLIPS) -> np.ndarray:
    """Return a p-value (M,) for each of M models' mean gain (M, V), right for all of them together.

    Under the hypothesis that a model gains nothing, a window's gain is as likely negative. All models' signs are
    flipped together, window by window, and each is compared with the largest statistic of all.
    """
    count = gain.shape[1]
    scale = np.sqrt(np.mean(gain**2, axis=1)) / np.sqrt(count) + 1e-12
    signs = rng.choice([-1.0, 1.0], size=(flips, count))
    largest = ((signs @ gain.T) / count / scale).max(axis=1)
    seen = gain.mean(axis=1) / scale
    return np.asarray([(1 + np.sum(largest >= s - 1e-12)) / (flips + 1) for s in seen])


def equals(gain: np.ndarray, best: int, rng: np.random.Generator) -> np.ndarray:
    """Return which models (M,) do as well as ``best`` by their gains (M, V): all but so, or not significantly worse."""
    mean = gain.mean(axis=1)
    found = mean >= mean[best] - SAME
    for k in np.flatnonzero(~found & (mean > LEAST * mean[best])):
        found[k] = max_t((gain[best] - gain[k])[None], rng)[0] > WORSE
    found[best] = True
    return np.asarray(found)


def resampled(episode: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a bootstrap sample of windows (numbers): episodes, then their windows."""
    units = np.unique(episode)
    picked = []
    for unit in rng.choice(units, len(units)):
        mine = np.flatnonzero(episode == unit)
        picked.append(rng.choice(mine, len(mine)))
    return np.concatenate(picked)
