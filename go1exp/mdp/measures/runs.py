"""Stances and swings of many feet as one table, from contact flags."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NOT_COUNTED = 2
"""State of a foot at a time that does not count, beside 0 for the air and 1 for the ground."""


@dataclass(frozen=True)
class Runs:
    """Maximal stretches of one state in columns of samples, ordered by column and time; all arrays are (R,).

    Attributes:
        column: which column.
        start: its first sample.
        stop: the sample after its last.
        value: the state.
        begins: it begins with a change between air and ground, and not with the record.
        ends: it ends so.
    """

    column: NDArray[np.intp]
    start: NDArray[np.intp]
    stop: NDArray[np.intp]
    value: NDArray[np.int8]
    begins: NDArray[np.bool_]
    ends: NDArray[np.bool_]

    @property
    def length(self) -> NDArray[np.intp]:
        """Samples of each run."""
        return self.stop - self.start

    def where(self, value: int, *, whole: bool) -> Runs:
        """Return those of a state that begin, and if ``whole`` also end, with a change between air and ground."""
        which = (self.value == value) & self.begins & (self.ends | (not whole))
        return Runs(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def find_runs(states: NDArray[np.int8]) -> Runs:
    """Return the runs of ``states`` (columns, samples)."""
    samples = states.shape[1]
    if not states.size:
        none = np.zeros(0, np.intp)
        return Runs(none, none, none, none.astype(np.int8), none.astype(bool), none.astype(bool))
    flat = states.ravel()
    change = np.ones(len(flat), bool)
    change[1:] = flat[1:] != flat[:-1]
    change[::samples] = True
    first = np.flatnonzero(change)
    last = np.append(first[1:], len(flat))
    column, value = first // samples, flat[first]
    counted = value != NOT_COUNTED
    joined = np.zeros(len(first) + 1, bool)  # between a run and the one before it
    joined[1:-1] = (column[1:] == column[:-1]) & counted[1:] & counted[:-1]
    return Runs(column, first - column * samples, last - column * samples, value, joined[:-1], joined[1:])


def settled(states: NDArray[np.int8], least: int) -> NDArray[np.int8]:
    """Return ``states`` (columns, samples) without stretches in the air, then on the ground, of less than ``least``.

    A foot that strikes a stiff ground may leave it again for a sample or two: that ends no stance.
    """
    for value in (0, 1):
        runs = find_runs(states)
        short = (runs.value == value) & runs.begins & runs.ends & (runs.length < least)
        filled = np.where(short, 1 - runs.value, runs.value).astype(np.int8)
        states = np.repeat(filled, runs.length).reshape(states.shape)
    return states


def largest_within(
    values: NDArray[np.float64], column: NDArray[np.intp], start: NDArray[np.intp], stop: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return the largest of ``values`` (columns, samples) in each stretch (E,), from start to before stop."""
    samples = values.shape[1]
    flat = np.append(values.ravel(), -np.inf)  # a stretch may end where the values do
    bounds = np.stack([column * samples + start, column * samples + stop], 1).ravel()
    return np.maximum.reduceat(flat, bounds)[::2] if len(bounds) else np.zeros(0)
