"""Length of the batches of a protocol, and the settings that determine it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Cause:
    """A setting that determines the length of a batch.

    Attributes:
        key: its name.
        value: its value.
        least: its lower bound.
        fitting: length, s -> the value that makes the batch so long, all other settings unchanged.
        unit: of the value.
        falling: whether the length falls as the value grows.
    """

    key: str
    value: float
    least: float = 0.0
    fitting: Callable[[float], float] = lambda seconds: seconds
    unit: str = " s"
    falling: bool = False

    def limit(self, seconds: float) -> str | None:
        """Return the limit of the value for a length of ``seconds`` as text; None if that is out of bounds."""
        most = self.fitting(seconds)
        if most < self.least:
            return None
        if self.falling:  # rounded to the side that fits
            return f"{1.006 * most:.3g}{self.unit} at least"
        return f"{0.994 * most:.3g}{self.unit} at most"


@dataclass(frozen=True)
class Length:
    """Length of one batch of robots.

    Attributes:
        seconds: the length, s.
        robots: number of robots.
        causes: settings that determine the length, the likeliest to be wrong first.
        settle_s: time at its start that does not count, s.
        recorded: whether the channels of measures are recorded after it.
        policy_dt: period of their policy, s; None is that of the stage.
    """

    seconds: float
    robots: int
    causes: Sequence[Cause]
    settle_s: float = 0.0
    recorded: bool = False
    policy_dt: float | None = None
