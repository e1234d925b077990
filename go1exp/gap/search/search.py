"""The state of a search: its model, its evidence, and what became of its terms. Nothing changes it from outside."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from go1exp.gap.data.windows import Splits
from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import Candidate, GapSettings
from go1exp.gap.score.likelihood import Scorer, excess, removed
from go1exp.gap.search import significance, thresholds
from go1exp.gap.search.fit import Model
from go1exp.gap.search.state import State


@dataclass(frozen=True)
class LastCheck:
    """What terms do on windows that no decision has seen.

    Attributes:
        helps: whether most windows gain, or there is no gap; true without such windows.
        closed: share of the excess chi-squared there that is gone; NaN without such windows, or without a gap there.
    """

    helps: bool
    closed: float


@dataclass(frozen=True)
class Search:
    """What is known so far in a search. Each step of a search returns a new one.

    Attributes:
        state: the present model, with its windows and settings.
        rng: of tests and bootstraps; drawn from in the order of the steps.
        progress: called with what is being done, and which share of all is finished.
        select_chi2: (V, G) chi2 per value of the present model on held-out windows.
        nominal: values of the model within its tolerances, before any term.
        first: held-out excess chi-squared with these.
        aliases: effect -> effects that do as well.
        shares: effect -> share of bootstraps in which it is selected.
        candidates: the evidence.
        signal: effect -> chi2 that it would add at twice its tolerance.
        steps: (what, held-out excess chi-squared) after every accepted term.
        base: which of the steps is the model within its tolerances, without a term.
        single: the term that explains nearly everything alone, or empty (``gap/search/single_cause.py``).
        within: values within tolerances, shared by all joints, at which a fit on the ground begins.
        strained: whether the first term was accepted although the tolerances explain the data nearly as well.
        rivals: fitted models that nearly did as well as the first term, best first.
        returned: term -> share of the excess chi-squared that came back without it, in the last test of it.
    """

    state: State
    rng: np.random.Generator
    progress: Callable[[str, float], None]
    select_chi2: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    nominal: Theta = field(default_factory=dict)
    first: float = math.nan
    aliases: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    shares: Mapping[str, float] = field(default_factory=dict)
    candidates: tuple[Candidate, ...] = ()
    signal: Mapping[str, float] = field(default_factory=dict)
    steps: tuple[tuple[str, float], ...] = ()
    base: int = 0
    single: str = ""
    within: Theta = field(default_factory=dict)
    strained: bool = False
    rivals: tuple[Model, ...] = ()
    returned: Mapping[str, float] = field(default_factory=dict)

    @property
    def splits(self) -> Splits:
        """Which windows are for what."""
        return self.state.splits

    @property
    def settings(self) -> GapSettings:
        """The user's settings."""
        return self.state.settings

    @property
    def dt(self) -> float:
        """Physics step, s."""
        return self.state.dt

    def last_check(self) -> LastCheck:
        """Return what the terms do on the windows kept for a last check."""
        kept = self.splits.confirm
        if not len(kept):
            return LastCheck(True, math.nan)
        before, after = (self.state.held_out(theta, kept) for theta in (self.nominal, self.state.theta))
        level = excess(before)
        least = 0.0 if level > self.settings.material else -thresholds.SAME_GAIN
        helps = bool(significance.gains(before, after[None]).mean() > least)
        return LastCheck(helps, removed(level, excess(after)) if level > self.settings.adequate else math.nan)

    def share_of(self, term: str) -> float:
        """Return the share of the excess within the tolerances that comes back without a term; NaN if not tested."""
        if self.state.terms == (term,):
            return removed(self.first, excess(self.select_chi2))
        return self.returned.get(term, math.nan)

    def removes(self, term: str) -> float:
        """Return the share of the excess without a term that the term removes; NaN if not tested.

        Beside a large effect a small one has little of the whole excess, and may still be all that is left without it.
        """
        back = self.share_of(term) * self.first
        without = back + max(excess(self.select_chi2), 0.0)
        return back / without if without > 0.0 else math.nan

    # ------------------------------------------------------------------ the next state

    def with_model(self, state: State, chi2: np.ndarray, step: str) -> Search:
        """Return the search with another model, its held-out chi2 (V, G), and a step that names it."""
        return replace(self, state=state, select_chi2=chi2, steps=(*self.steps, (step, excess(chi2))))

    def measured_again(self, first: float) -> Search:
        """Return the search with this held-out excess within the tolerances, by the floors of the present terms."""
        steps = list(self.steps)
        steps[self.base] = (steps[self.base][0], first)
        return replace(self, first=first, steps=tuple(steps))

    def withdrawn(self, why: str) -> Search:
        """Return the search without its terms."""
        search = self.rejected(self.state.terms, why)
        state = replace(self.state, terms=(), theta=self.nominal)
        return replace(search, state=state, steps=(*self.steps, ("withdrawn", self.first)))

    def rejected(self, names: Sequence[str], why: str) -> Search:
        """Return the search with these accepted candidates rejected in the evidence."""
        candidates = tuple(
            replace(c, status="rejected", reason=why) if c.status == "accepted" and c.effect in names else c
            for c in self.candidates
        )
        return replace(self, candidates=candidates)


def begun(
    scorer: Scorer,
    splits: Splits,
    settings: GapSettings,
    dt: float,
    rng: np.random.Generator,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> Search:
    """Return a search at its beginning: a model without terms, at its nominal values."""
    return Search(State(scorer, splits, settings, dt), rng, progress)
