"""How long a protocol's robots play, which settings say so, and whether that fits into memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from go1exp import memory
from go1exp.schema.registry import TooLongError
from go1exp.wording import counted

if TYPE_CHECKING:
    from go1exp.protocol.base import Chosen
    from go1exp.protocol.stage import Stage


@dataclass(frozen=True)
class Cause:
    """A setting that says how long robots play.

    Attributes:
        key: its name.
        value: what it is.
        least: what it must be at least.
        fitting: gives the value with which they play for so many s, all other settings as they are.
        unit: of the value.
        falling: whether they play the longer, the smaller it is.
    """

    key: str
    value: float
    least: float = 0.0
    fitting: Callable[[float], float] = lambda seconds: seconds
    unit: str = " s"
    falling: bool = False

    def limit(self, seconds: float) -> str | None:
        """Return what it may be for ``seconds`` to be the length; None if that is not allowed."""
        most = self.fitting(seconds)
        if most < self.least:
            return None
        if self.falling:  # rounded to the side that fits
            return f"{1.006 * most:.3g}{self.unit} at least"
        return f"{0.994 * most:.3g}{self.unit} at most"


@dataclass(frozen=True)
class Length:
    """How long robots play that are in memory at once.

    Attributes:
        seconds: the length, s.
        robots: how many.
        causes: settings that say so, the likeliest to be wrong first.
        policy_dt: period of their policy, s; None is that of the stage.
        listen_from: time from which what measures need is recorded, s; None records nothing.
    """

    seconds: float
    robots: int
    causes: Sequence[Cause]
    policy_dt: float | None = None
    listen_from: float | None = None


def refuse_too_long(chosen: Chosen, stage: Stage) -> None:
    """Refuse a protocol whose robots do not fit into memory, before anything of that size is made.

    What fails for certain is refused, nothing else.

    Raises:
        TooLongError: names the setting, and the largest value of it that would fit.
    """
    available, lengths = memory.free(), chosen.protocol.lengths()
    if available is None or not lengths:
        return
    length = max(lengths, key=lambda one: _needed(one, stage))  # what mends the largest batch mends the others
    if (needed := _needed(length, stage)) > available:
        plain, recorded = stage.bytes_per_second(length)
        # Where the memory ends before the recording begins, the second overstates what fits; the first does else.
        fitting = min(available / plain, (available + _quiet(length) * recorded) / (plain + recorded))
        raise TooLongError([_problem(chosen, length, needed, available, fitting)])


def _needed(length: Length, stage: Stage) -> float:
    """Return what a batch takes at least, B."""
    plain, recorded = stage.bytes_per_second(length)
    return length.seconds * plain + (length.seconds - _quiet(length)) * recorded


def _quiet(length: Length) -> float:
    """Return the time for which nothing is recorded for measures, s."""
    return length.seconds if length.listen_from is None else min(length.listen_from, length.seconds)


def _problem(chosen: Chosen, length: Length, needed: float, available: float, fitting: float) -> str:
    """Word that a length needs too much: of the first setting that alone can mend it, or of all where none can."""
    path, robots = f"protocol.{chosen.key}", chosen.protocol.robots
    amounts = memory.too_much(needed, available)
    what = f"to play {length.seconds:g} s with {counted(length.robots, 'robot')} {amounts}"
    for cause in length.causes:
        if limit := cause.limit(fitting):
            return f"{path}.{cause.key} = {cause.value:g}: {what}; {limit} would fit"
    fewer = math.floor(robots * available / needed)
    if fewer:
        return f"{path}.robots = {robots}: {what}; {fewer} at most would fit"
    given = ", ".join(f"{cause.key} = {cause.value:g}" for cause in length.causes)
    return f"{path}: {given}, robots = {robots}: {what}; {0.994 * fitting:.3g} s at most would fit"
