"""Which windows models are fitted on, judged by, and finally confirmed on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.recording import Meta


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
        shuffled = rng.permutation([u for u in range(len(units)) if kinds[u] == kind and u not in kept])
        if len(shuffled) == 1:
            alone.append(units[shuffled[0]])
            stretch = np.unique(_stretch(episode)[unit == shuffled[0]], return_inverse=True)[1]
            select[unit == shuffled[0]] = (stretch + len(alone)) % 2 == 1
        else:
            select |= np.isin(unit, shuffled[: len(shuffled) // 2])
    confirmed = np.isin(unit, kept)
    train, held, last_check = (np.flatnonzero(m) for m in (~select & ~confirmed, select & ~confirmed, confirmed))
    return Splits(train, held, last_check, tuple(alone))
