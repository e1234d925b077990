"""How long a protocol's robots play, and which settings say so."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass


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
        settle_s: time at its start that does not count, s.
        recorded: whether what measures need is recorded after it.
        policy_dt: period of their policy, s; None is that of the stage.
    """

    seconds: float
    robots: int
    causes: Sequence[Cause]
    settle_s: float = 0.0
    recorded: bool = False
    policy_dt: float | None = None
