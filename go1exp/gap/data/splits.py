"""Which windows models are fitted on, judged by, and finally confirmed on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.logs.recording import Meta

STRETCH = 3
"""Windows of a stretch."""

KEPT_EVERY = 5
"""Of this many stretches of an episode one is kept for the last check, where whole episodes cannot be."""


@dataclass(frozen=True)
class Splits:
    """Numbers of the windows that models are fitted on, chosen by, and finally confirmed on.

    Attributes:
        train: to fit.
        select: to judge by.
        confirm: whole episodes, or stretches of them, that nothing is decided on; may be empty.
        alone: episodes of which some stretches are in ``train`` and some in ``select``.
        shared: those of them that also lend stretches to ``confirm``.
    """

    train: np.ndarray
    select: np.ndarray
    confirm: np.ndarray
    alone: tuple[str, ...] = ()
    shared: tuple[str, ...] = ()

    @property
    def judged(self) -> np.ndarray:
        """Windows that no fitted value has seen: those of the last check, or if there are none the held-out ones."""
        return self.confirm if len(self.confirm) else self.select


def stretches(episode: np.ndarray) -> np.ndarray:
    """Return the number of the stretch of ``STRETCH`` windows that each window (W,) is in."""
    place = np.arange(len(episode)) - np.searchsorted(episode, episode)
    return np.asarray(np.unique(episode * len(episode) + place // STRETCH, return_inverse=True)[1])


def _kept_whole(kinds: Sequence[tuple[object, ...]], wanted: int, rng: np.random.Generator) -> list[int]:
    """Return which units to keep whole for the last check: of no motion the only one that is left.

    What a motion alone shows (drives that are off, say) cannot be judged by a model that was fitted without it, and
    would count against every term.
    """
    motions = [kind[0] for kind in kinds]
    likes = [(kinds.count(k), motions.count(k[0]), rng.random()) for k in kinds]
    kept: list[int] = []
    for u in sorted(range(len(kinds)), key=lambda u: likes[u], reverse=True):
        left = [motions[v] for v in range(len(kinds)) if v not in kept]
        if len(kept) < wanted and left.count(motions[u]) > 1:
            kept.append(u)
    return kept


def splits(metas: Sequence[Meta], episode: np.ndarray, confirm: float, rng: np.random.Generator) -> Splits:
    """Split windows by episode, or within an episode of which there is only one of its kind.

    What only one episode shows, at the gains that show it, cannot be fitted if that episode judges, nor judged if it
    is fitted. So of episodes of one motion and gain set half are fitted and half judge; one that is alone is cut into
    stretches of three windows, which take turns. For the last check whole episodes are kept of motions of which there
    are more; if those are fewer than ``confirm`` asks for, every fifth stretch of episodes that are alone is. An
    episode and its repetition count as one.

    Args:
        metas: of the recordings.
        episode: (W,) recording of each window.
        confirm: share for the last check; of fewer than four episodes none whole, and none of short ones.
        rng: of what goes where.
    """
    shown, episode = np.unique(episode, return_inverse=True)  # one without any window can neither judge nor be fitted
    metas = [metas[k] for k in shown]
    units = list(dict.fromkeys(m.repeat_of or m.episode for m in metas))
    unit = np.array([units.index(m.repeat_of or m.episode) for m in metas])[episode]
    about = {m.repeat_of or m.episode: m for m in reversed(metas)}
    kinds = [(about[u].excitation, about[u].kp, about[u].kd) for u in units]
    last = max(1, round(confirm * len(units))) if confirm and len(units) > 3 else 0
    kept = _kept_whole(kinds, last, rng)
    select, confirmed = np.zeros(len(episode), dtype=bool), np.isin(unit, kept)
    cut, alone, shared = len(kept) < max(last, 1 if confirm else 0), [], []
    before = 0  # stretches of episodes that are alone so far; those of few episodes count from each one's beginning
    for kind in dict.fromkeys(kinds):
        shuffled = rng.permutation([u for u in range(len(units)) if kinds[u] == kind and u not in kept])
        if len(shuffled) == 1:
            name, inside = units[shuffled[0]], unit == shuffled[0]
            alone.append(name)
            stretch = np.unique(stretches(episode)[inside], return_inverse=True)[1]
            count = int(stretch.max(initial=-1)) + 1
            spared = (before + stretch) % KEPT_EVERY == KEPT_EVERY - 1
            if cut and spared.any() and (len(units) > 3 or count >= KEPT_EVERY):
                shared.append(name)
                confirmed[inside] = spared
            before += count if len(units) > 3 else 0
            select[inside] = (stretch + len(alone)) % 2 == 1
        else:
            select |= np.isin(unit, shuffled[: len(shuffled) // 2])
    train, held, last_check = (np.flatnonzero(m) for m in (~select & ~confirmed, select & ~confirmed, confirmed))
    return Splits(train, held, last_check, tuple(alone), tuple(shared))
