"""Columns of an observation some of whose terms show what they were in earlier steps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from go1exp.config.schema.registry import Term


class HistoryColumns(NamedTuple):
    """Columns of an observation with a history, (H,) each.

    Attributes:
        earlier: those that hold earlier frames.
        newest: for each of them, where the newest frame has that number.
        carried: for each of them, where it was one period before.
    """

    earlier: list[int]
    newest: list[int]
    carried: list[int]


def columns_of(terms: Iterable[tuple[int, int]]) -> HistoryColumns:
    """Return the columns of terms one after the other: numbers in a frame, and frames, the newest first."""
    columns, start = HistoryColumns([], [], []), 0
    for wide, frames in terms:
        end = start + wide * frames
        columns.earlier.extend(range(start + wide, end))
        columns.newest.extend([*range(start, start + wide)] * (frames - 1))
        columns.carried.extend(range(start, end - wide))
        start = end
    return columns


def frame_width(term: Term) -> int:
    """Return how many numbers an observation term is in one step."""
    return int(term.entry.traits["size"])


def frames_of(term: Term) -> int:
    """Return how many frames of an observation term are observed, the newest included."""
    return int(term.slots.get("history", 1))


def width(term: Term) -> int:
    """Return how many columns an observation term has."""
    return frame_width(term) * frames_of(term)


def history_columns(terms: Sequence[Term]) -> HistoryColumns:
    """Return which columns of an observation are earlier frames, and where those of the next one come from."""
    return columns_of((frame_width(t), frames_of(t)) for t in terms)
