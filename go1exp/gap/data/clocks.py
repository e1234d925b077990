"""The same rows of recordings as windows under several clocks, so that clocks are judged on the same readings.

A window has a length in seconds, and a clock says which rows that is. Here windows begin at the same row and compare
the same rows by every clock. Only what the model does between those rows differs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from go1exp.gap.data.cutting import FIT_S, Place, even_clock
from go1exp.gap.data.standing import rows_at
from go1exp.gap.data.windows import PAST_S, Windows
from go1exp.gap.result import GapSettings
from go1exp.logs.recording import Recording, RecordingError

TRIES = 9
"""Rows at which a window may begin: the one with the smoothest motion about it is taken."""

SMOOTH_ROWS = 3
"""Rows to both sides in which motion is looked at for that."""

Key = TypeVar("Key", bound=str)
Cut = Callable[[Sequence[Sequence[Place]]], Windows]
"""Cuts recordings by one clock at places of each."""


def rows_of(windows: Windows, which: np.ndarray, recordings: Sequence[Recording]) -> list[np.ndarray]:
    """Return which rows of each recording (T,) bool have a part in some windows (numbers), first state included."""
    masks = []
    for e, recording in enumerate(recordings):
        t, mask = even_clock(recording), np.zeros(len(recording.t), dtype=bool)
        for k in which[windows.episode[which] == e]:
            mask |= (t >= windows.begin[k] - FIT_S) & (t <= windows.begin[k] + windows.length)
        masks.append(mask)
    return masks


def beginnings(clocks: Sequence[np.ndarray], q: np.ndarray, settings: GapSettings, spared: np.ndarray) -> list[int]:
    """Return rows of one recording at which windows may begin by every clock.

    About one stride apart, where the motion is smooth within a third of it, as for windows of one clock. Smoothness is
    told from the rows alone, so that no clock has its way.

    Args:
        clocks: times (T,), s, by each.
        q: angles (T, J), rad.
        settings: lengths of windows.
        spared: (T,) bool, rows that no window may have.
    """
    length = settings.burn_s + settings.window_s
    bend = np.abs(np.diff(q, 3, axis=0, prepend=q[:1], append=q[-2:]))
    bend = (bend / np.maximum(np.median(bend, axis=0), 1e-9)).max(axis=1)
    rough = np.convolve(bend, np.ones(2 * SMOOTH_ROWS + 1), "same")
    stride = max(round(settings.stride_s / float(np.median(np.diff(t)))) for t in clocks)
    taken = np.concatenate([[0], np.cumsum(spared)])

    def free(row: int) -> bool:
        ends = [int(np.searchsorted(t, t[row] + length)) for t in clocks]
        first = min(int(np.searchsorted(t, t[row] - FIT_S)) for t in clocks)
        return max(ends) < len(q) and taken[max(ends)] == taken[first]

    begun: list[int] = []
    row = max(int(np.searchsorted(t, t[0] + PAST_S)) for t in clocks)
    while row < len(q):
        tries = [r for r in np.unique(np.linspace(row, row + stride / 3, TRIES).astype(int)) if r < len(q) and free(r)]
        if tries:
            begun.append(int(min(tries, key=lambda r: rough[r])))
        row += stride
    return begun


def same_rows(
    recordings: Mapping[Key, Sequence[Recording]],
    cuts: Mapping[Key, Cut],
    settings: GapSettings,
    spared: Sequence[np.ndarray],
) -> tuple[dict[Key, Windows], dict[Key, int]]:
    """Return windows by each clock that begin at the same rows, compare the same rows, and have the same floor.

    Beside them, how many of the places that were tried each clock leaves: no window may have a hole by its clock.

    Noise is the smaller of what is seen by the clocks, since a wrong one makes motion look like noise. The first states
    are as uncertain as by the clock that knows them less.

    Args:
        recordings: by each clock.
        cuts: how to cut them by that clock.
        settings: lengths of windows.
        spared: rows (T,) bool of each recording that no window may have.

    Raises:
        RecordingError: if not one window fits by all clocks.
    """
    clocks = {name: [even_clock(r) for r in logs] for name, logs in recordings.items()}
    first = next(iter(recordings.values()))
    order = list(range(len(first)))
    rows = [beginnings([c[e] for c in clocks.values()], first[e].joint("q"), settings, spared[e]) for e in order]
    windows = _cut_at(rows, clocks, cuts)
    begun = {name: _begun(w, clocks[name]) for name, w in windows.items()}
    left = {name: len(each) for name, each in begun.items()}
    common = set.intersection(*(set(each) for each in begun.values()))
    if not common:
        raise RecordingError("no window is whole by both clocks")
    windows = _cut_at([[r for r in rows[e] if (e, r) in common] for e in order], clocks, cuts)
    return _shared({n: _masked(w, clocks[n], list(clocks.values()), settings) for n, w in windows.items()}), left


def _cut_at(
    rows: Sequence[Sequence[int]], clocks: Mapping[Key, Sequence[np.ndarray]], cuts: Mapping[Key, Cut]
) -> dict[Key, Windows]:
    """Cut windows that begin at rows of each recording, by each clock."""
    return {
        name: cuts[name]([[Place(t[r], t[r]) for r in rows[e]] for e, t in enumerate(clock)])
        for name, clock in clocks.items()
    }


def _begun(windows: Windows, clock: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """Return recording and row at which each window begins."""
    pairs = zip(windows.episode.tolist(), windows.begin, strict=True)
    return [(e, int(rows_at(clock[e], np.array([begin]))[0])) for e, begin in pairs]


def _masked(
    windows: Windows, clock: Sequence[np.ndarray], everyone: Sequence[Sequence[np.ndarray]], settings: GapSettings
) -> Windows:
    """Return windows by one clock of which only rows are valid that are scored by all clocks."""
    valid = windows.valid.copy()
    for k, (e, start) in enumerate(_begun(windows, clock)):
        rows = rows_at(clock[e], windows.begin[k] + windows.t[k])
        for other in everyone:
            since = other[e][rows] - other[e][start]
            valid[k] &= (since >= settings.burn_s - 1e-7) & (since <= settings.burn_s + settings.window_s + 1e-7)
    return replace(windows, valid=valid)


def _shared(windows: Mapping[Key, Windows]) -> dict[Key, Windows]:
    """Return windows with the least noise, and the widest first states, of all."""
    every = list(windows.values())
    scale = np.min([w.scale for w in every], axis=0)
    q_sd, qd_sd = (np.max([getattr(w, name) for w in every], axis=0) for name in ("q_sd", "qd_sd"))
    return {name: replace(w, scale=scale, q_sd=q_sd, qd_sd=qd_sd) for name, w in windows.items()}
