"""Judgement on data that no fit has seen: splits, sign flips, sets of equals, resamplings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.recording import Meta

FLIPS = 4000
"""Sign flips of a test: the smallest p-value is 1 / (FLIPS + 1)."""

SAME = 0.02
"""Gains of log chi2 that differ by less mean the same: 2 % of the floor, or of the larger of the gains."""

WORSE = 0.05
"""A model with a p-value below this is worse than another."""

LEAST = 0.7
"""A model with less than this share of the best one's gain is no equal, however uncertain."""


@dataclass(frozen=True)
class Splits:
    """Numbers of the windows that models are fitted on, chosen by, and finally confirmed on.

    Attributes:
        train: to fit.
        select: to judge by.
        confirm: whole episodes that nothing is decided on; may be empty.
        alone: episodes of which some stretches are in ``train`` and some in ``select``.
    """

    train: np.ndarray
    select: np.ndarray
    confirm: np.ndarray
    alone: tuple[str, ...] = ()


def _stretch(episode: np.ndarray) -> np.ndarray:
    """Return the number of the stretch of three windows that each window (W,) is in."""
    place = np.arange(len(episode)) - np.searchsorted(episode, episode)
    return np.asarray(np.unique(episode * len(episode) + place // 3, return_inverse=True)[1])


def splits(metas: Sequence[Meta], episode: np.ndarray, confirm: float, rng: np.random.Generator) -> Splits:
    """Split windows by episode, or within an episode of which there is only one of its kind.

    What only one episode shows, at the gains that show it, cannot be fitted if that episode judges, nor judged if it
    is fitted. So of episodes of one motion and gain set half are fitted and half judge; one that is alone is cut into
    stretches of three windows, which take turns. An episode and its repetition count as one.

    Args:
        metas: of the recordings.
        episode: (W,) recording of each window.
        confirm: share of the episodes for the last check, none of fewer than four.
        rng: of what goes where.
    """
    units = list(dict.fromkeys(m.repeat_of or m.episode for m in metas))
    unit = np.array([units.index(m.repeat_of or m.episode) for m in metas])[episode]
    about = {m.repeat_of or m.episode: m for m in reversed(metas)}
    kinds = [(about[u].excitation, about[u].kp, about[u].kd) for u in units]
    last = max(1, round(confirm * len(units))) if confirm and len(units) > 3 else 0
    # For the last check first those of which there are others, by their kind, then by their motion alone.
    likes = [(kinds.count(k), sum(k[0] == other[0] for other in kinds), rng.random()) for k in kinds]
    kept = sorted(range(len(units)), key=lambda u: likes[u], reverse=True)[:last]
    select = np.zeros(len(episode), dtype=bool)
    alone = []
    for kind in dict.fromkeys(kinds):
        mine = rng.permutation([u for u in range(len(units)) if kinds[u] == kind and u not in kept])
        if len(mine) == 1:
            alone.append(units[mine[0]])
            stretch = np.unique(_stretch(episode)[unit == mine[0]], return_inverse=True)[1]
            select[unit == mine[0]] = (stretch + len(alone)) % 2 == 1
        else:
            select |= np.isin(unit, mine[: len(mine) // 2])
    confirmed = np.isin(unit, kept)
    train, held, last_check = (np.flatnonzero(m) for m in (~select & ~confirmed, select & ~confirmed, confirmed))
    return Splits(train, held, last_check, tuple(alone))


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


def same(gain: float) -> float:
    """Return by how much the mean of another model's gain may be smaller and still mean the same."""
    return SAME * max(1.0, gain)


def equals(gain: np.ndarray, best: int, rng: np.random.Generator) -> np.ndarray:
    """Return which models (M,) do as well as ``best`` by their gains (M, V): all but so, or not significantly worse."""
    mean = gain.mean(axis=1)
    found = mean >= mean[best] - same(mean[best])
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
