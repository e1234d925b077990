"""Claims: limits of figures, and the verdict on each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from go1exp.config.schema.registry import NonNegative
from go1exp.config.schema.settings import settings
from go1exp.evaluate.statistics.intervals import Interval, SummaryEntry

Word = Literal["met", "close", "not met", "inconclusive"]


@settings
class Claim:
    """Limits of one figure in the conditions that it is about.

    Attributes:
        quantity: the figure.
        at_least: its lower limit; null for none.
        at_most: its upper limit; null for none.
        tolerance: excess over a limit that still counts as close, in the unit of the figure.
        where: only conditions with these values, such as {period: 7.0}; {} takes all.
        source: origin of the limit.
    """

    quantity: str
    at_least: float | None = None
    at_most: float | None = None
    tolerance: NonNegative
    where: dict[str, Any] = field(default_factory=dict)
    source: str

    def __post_init__(self) -> None:
        if self.at_least is None and self.at_most is None:
            raise ValueError("at_most = None: a claim needs at_most or at_least")


@dataclass(frozen=True)
class Verdict:
    """A claim and its worst condition."""

    name: str
    word: Word  # met, close, not met or inconclusive
    claim: Claim
    figure: Interval  # figure of the worst condition with its 95 % interval
    condition: Mapping[str, float | str]
    conditions: int  # number of conditions with the figure


def verdict(figure: Interval, claim: Claim) -> Word:
    """Return the verdict on a figure with its interval.

    met: the whole interval is within the limits. not met: the whole interval is beyond a limit, and the estimate beyond
    the tolerance. inconclusive: the interval reaches from within the limits to beyond the tolerance (n is too small),
    or there is no interval. close: otherwise.
    """
    if not all(map(math.isfinite, (figure.estimate, figure.low, figure.high))):
        return "inconclusive"
    low, high = sorted((_excess(figure.low, claim), _excess(figure.high, claim)))
    if high <= 0.0:
        return "met"
    least, most = _bounds(claim)
    if low > 0.0 and not (figure.low < least and figure.high > most):
        return "close" if _excess(figure.estimate, claim) <= claim.tolerance else "not met"
    return "close" if high <= claim.tolerance else "inconclusive"


ORDER: tuple[Word, ...] = ("not met", "inconclusive", "close", "met")  # from the worst to the best


def evaluated(claims: Mapping[str, Claim], summary: Sequence[SummaryEntry]) -> list[Verdict]:
    """Return the verdict on each claim in its worst condition of a ``summary``; inconclusive without any condition."""
    verdicts = []
    for name, claim in claims.items():
        candidates = []
        for entry in summary:
            figure = entry["figures"].get(claim.quantity)
            if figure is not None and all(entry["condition"].get(k) == v for k, v in claim.where.items()):
                known = (figure["estimate"], figure["low"], figure["high"])
                estimate, low, high = (math.nan if v is None else v for v in known)
                interval = Interval(estimate, low, high, figure["n"])
                candidates.append(Verdict(name, verdict(interval, claim), claim, interval, entry["condition"], 0))
        nothing = Verdict(name, "inconclusive", claim, Interval(math.nan, math.nan, math.nan, 0), claim.where, 0)
        worst = min(candidates, key=_rank, default=nothing)
        verdicts.append(replace(worst, conditions=len(candidates)))
    return verdicts


def _rank(verdict: Verdict) -> tuple[int, float]:
    """Return the sort key of a verdict, the worst first."""
    excess = _excess(verdict.figure.estimate, verdict.claim)
    return ORDER.index(verdict.word), -excess if math.isfinite(excess) else -math.inf


def limits(claim: Claim) -> str:
    """Return the limits of a claim as text."""
    if claim.at_least is not None and claim.at_most is not None:
        return f"{claim.at_least:g} to {claim.at_most:g}"
    return f"at least {claim.at_least:g}" if claim.at_least is not None else f"at most {claim.at_most:g}"


def _bounds(claim: Claim) -> tuple[float, float]:
    least = -math.inf if claim.at_least is None else claim.at_least
    return least, math.inf if claim.at_most is None else claim.at_most


def _excess(value: float, claim: Claim) -> float:
    """Return by how much a value is beyond the limits; negative within them."""
    least, most = _bounds(claim)
    return max(least - value, value - most)
