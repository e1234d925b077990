"""The design that separates best: a library looked at quickly, the best looked at well, and neighbours of the best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.gap.design.limits import DesignError
from go1exp.gap.design.plan import Attitude, Design, library, neighbours
from go1exp.gap.design.power import Judge, Worth
from go1exp.gap.design.rehearsal import Rehearsal, Stage
from go1exp.gap.design.settings import DesignSettings

ENOUGH = 0.8
"""Power from which two explanations count as told apart."""

LOT = 20
"""Designs whose windows are replayed together; more would need more memory."""

FEW, MORE = 3, 8
"""Windows of a design in the quick look, and in the closer one."""

FINALISTS = 4
"""Designs of the library that are looked at closely, and neighbours in a round."""

COARSE = 2.0
"""Physics step of all comparisons over that of the search: both sides have the same, and it takes half the time."""


@dataclass(frozen=True)
class Choice:
    """What a search for a design came to.

    Attributes:
        best: the design; None if no pair can be told apart.
        worths: of the recordings at hand and the best design together, pair by pair.
        reach: largest power that any design reached, pair by pair.
        tried: designs that were looked at.
        beyond: designs that were left out since they go beyond a limit.
    """

    best: Rehearsal | None
    worths: tuple[Worth, ...]
    reach: tuple[Worth, ...]
    tried: int
    beyond: int


class _Search:
    """Designs tried so far."""

    def __init__(self, stage: Stage, judges: Sequence[Judge]) -> None:
        self.stage, self.judges = stage, judges
        self.dt = stage.comparison.dt  # of what is held against limits
        self.tried = self.beyond = 0
        self.reach = [judge.worth(judge.at_hand) for judge in judges]

    def within_limits(self, designs: Sequence[Design]) -> list[Rehearsal]:
        """Return the designs that stay within the limits, as the model plays them."""
        played = [r for k in range(0, len(designs), 64) for r in self.stage.rehearsed(designs[k : k + 64], self.dt)]
        allowed = [r for r in played if self.stage.limits.allow(r.used)]
        self.tried, self.beyond = self.tried + len(designs), self.beyond + len(played) - len(allowed)
        return allowed

    def judged(self, played: Sequence[Rehearsal], few: int) -> list[tuple[Worth, ...]]:
        """Return the worth of each design with the recordings at hand, pair by pair, from ``few`` of its windows."""
        dt = COARSE * self.dt
        judgements: list[tuple[Worth, ...]] = []
        for k in range(0, len(played), LOT):
            lot = played[k : k + LOT]
            score = self.stage.scored(lot, dt, few)
            evidences = [judge.evidence(score, dt) for judge in self.judges]
            whole = self.stage.seconds / self.stage.comparison.settings.stride_s
            for number in range(len(lot)):
                worths = []
                for judge, evidence in zip(self.judges, evidences, strict=True):
                    count = int((evidence.episode == number).sum())
                    evidence_of_one = [evidence.one(number, max(whole / count, 1.0))] if count else []
                    worths.append(judge.worth(judge.at_hand, *evidence_of_one))
                judgements.append(tuple(worths))
        return judgements

    def note(self, worths: Sequence[tuple[Worth, ...]]) -> None:
        """Remember how far any design has come, pair by pair."""
        for each in worths:
            self.reach = [max(a, b, key=_order) for a, b in zip(self.reach, each, strict=True)]


def _order(worth: Worth) -> tuple[float, float]:
    return worth.power, worth.gain


def _value(worths: Sequence[Worth], goals: Sequence[int]) -> tuple[float, float, float]:
    """Return by what designs are ranked: the least power over the goals, the mean, the least difference."""
    wanted = [worths[k] for k in goals]
    return (
        min(w.power for w in wanted),
        float(np.mean([w.power for w in wanted])),
        min(w.gain for w in wanted),
    )


def attainable(worths: Sequence[tuple[Worth, ...]], fallback: bool) -> list[int]:
    """Return the pairs that some design tells apart; if there is none and ``fallback``, those that come nearest."""
    best = [max((w[k].power for w in worths), default=0.0) for k in range(len(worths[0]))] if worths else []
    goals = [k for k, reached in enumerate(best) if reached >= ENOUGH]
    return goals or ([k for k, reached in enumerate(best) if reached == max(best)] if fallback else [])


def choose(
    stage: Stage,
    judges: Sequence[Judge],
    attitudes: Sequence[Attitude],
    settings: DesignSettings,
    on_progress: Callable[[str, float], None],
) -> Choice:
    """Find the design that maximises the least power over the pairs that any design can tell apart.

    Raises:
        DesignError: if every design goes beyond a limit.
    """
    rng, search = np.random.default_rng(settings.seed), _Search(stage, judges)
    on_progress("designs within the limits", 0.2)
    played = search.within_limits(library(settings.designs, settings.gains, attitudes, rng))
    if not played:
        raise DesignError(f"limits: all of {search.tried} designs go beyond them; allow more (limits.speed=..., ...)")
    on_progress("a quick look at the designs", 0.3)
    quick = search.judged(played, FEW)
    goals = attainable(quick, True)
    order = sorted(range(len(played)), key=lambda k: _value(quick[k], goals), reverse=True)[:FINALISTS]
    # The best for each pair alone is looked at too: a quick look may be wrong about which can be told apart.
    alone = [max(range(len(played)), key=lambda k, n=n: _order(quick[k][n])) for n in range(len(judges))]  # type: ignore[misc]
    finalists = [played[k] for k in dict.fromkeys([*order, *alone])]
    on_progress("a closer look at the best", 0.6)
    worths = search.judged(finalists, MORE)
    for turn in range(settings.refine):
        goals = attainable(worths, True)
        top = max(range(len(finalists)), key=lambda k: _value(worths[k], goals))
        on_progress("neighbours of the best", 0.7 + 0.3 * turn / settings.refine)
        near = search.within_limits(neighbours(finalists[top].design, FINALISTS, settings.gains, attitudes, rng))
        if near:
            finalists, worths = [*finalists, *near], [*worths, *search.judged(near, MORE)]
    search.note(worths)
    goals = attainable(worths, False)
    if not goals:
        return Choice(None, tuple(search.reach), tuple(search.reach), search.tried, search.beyond)
    top = max(range(len(finalists)), key=lambda k: _value(worths[k], goals))
    return Choice(finalists[top], worths[top], tuple(search.reach), search.tried, search.beyond)
