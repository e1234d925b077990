"""The clock of a table: its episodes, and what is wrong with it."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from go1exp.base.wording import counted
from go1exp.logs.importers.source import restarts
from go1exp.logs.recording import RecordingError

COARSE = 0.1
"""Share of rows with the time of the row before, from which the clock is rounded; fewer are copies of a row."""

OVERFLOW = (16, 24, 32)  # bits of counters that begin anew at their end


def episodes(labels: np.ndarray | None, t: np.ndarray | None, rows: int) -> list[tuple[str, np.ndarray]]:
    """Return name and rows (K,) of each episode: by its label, and by where the clock ``t`` begins anew."""
    by_label = [("", np.arange(rows))]
    if labels is not None:
        values, first, index = np.unique(labels, return_index=True, return_inverse=True)
        groups = np.split(np.argsort(index, kind="stable"), np.cumsum(np.bincount(index))[:-1])
        by_label = [(_label(values[k]), groups[k]) for k in np.argsort(first)]
    named = []
    for name, part in by_label:
        begins = [] if t is None else restarts(t[part])
        pieces = np.split(part, begins)
        named += [(f"{name}_{k}".strip("_") if begins else name, piece) for k, piece in enumerate(pieces)]
    return named


def _label(value: Any) -> str:
    """Return the value of an episode's column as a part of a file's name."""
    whole = not isinstance(value, str) and value == int(value)
    return re.sub(r"[^\w.-]+", "_", str(int(value) if whole else value)).strip("_") or "_"


def check(where: str, t: np.ndarray, cells: np.ndarray, column: str, place: Callable[[int], str]) -> None:
    """Raise RecordingError if the time ``t`` (T,), s, does not increase; with its place, its cell, and what to do."""
    if len(t) < 2:
        raise RecordingError(f"{where}: has {counted(len(t), 'row')} of numbers; at least 2 are needed")
    steps = np.diff(t)
    back = np.flatnonzero(steps <= 0)
    if not back.size:
        return
    k = int(back[0])
    rows = counted(back.size, "such row")
    where = f"{where}: column {column!r} (for t): must increase strictly, but {place(k + 1)} has {cells[k + 1]} after"
    where += f" {cells[k]} ({rows})"
    if bits := overflow(cells):
        raise RecordingError(f"{where}; it is a counter of {bits} bits that overflows: add {2**bits} from there on")
    if steps.max() <= 0 and t[-1] < t[0]:
        raise RecordingError(f"{where}; it runs backward: put the rows in the other order")
    if steps.min() < 0:
        several = "sort the rows by time, or leave such rows out; if the file has several episodes, give their column"
        raise RecordingError(f"{where}; {several} (episode: NAME)")
    if back.size < COARSE * len(steps) or t[-1] <= t[0]:
        raise RecordingError(f"{where}; leave such rows out (drop_repeats: true)")
    hz = (len(t) - 1) / (t[-1] - t[0])
    raise RecordingError(
        f"{where}; its times are rounded: take t out of columns and give rate_hz (about {hz:.3g}), "
        "or keep one row of each time (drop_repeats: true)"
    )


def overflow(cells: np.ndarray) -> int | None:
    """Return the bits of a counter (T,) that begins anew at its end; None if it is no such counter."""
    steps = np.diff(cells.astype(np.float64))
    ahead = steps[steps > 0]
    if cells.dtype.kind not in "iu" or not ahead.size:
        return None
    usual = 10 * float(np.median(ahead))
    return next((b for b in OVERFLOW if ((steps[steps < 0] + 2.0**b) > 0).all() and steps.min() + 2.0**b < usual), None)
