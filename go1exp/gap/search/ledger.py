"""What a search knows and writes down: its present model, its evidence, and what became of its terms."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
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
    """What terms do on windows that nothing was decided on.

    Attributes:
        helps: whether most windows gain, or there is no gap; true without such windows.
        closed: share of the excess there that is gone; NaN without such windows, or where there is no gap.
    """

    helps: bool
    closed: float


@dataclass
class Ledger:
    """What is known so far in a search.

    Attributes:
        scorer: of the windows, as the search begins.
        splits: which windows are for what.
        settings: the user's.
        dt: physics step, s.
        rng: of tests and bootstraps.
        progress: called with what is being done, and which share of all is finished.
        state: the present model.
        select_chi2: (V, G) chi2 per value of the present model on held-out windows.
        nominal: values of the model within its tolerances, before any term.
        first: held-out excess with these.
        aliases: effect -> effects that do as well.
        shares: effect -> share of bootstraps in which it wins.
        candidates: the evidence.
        signal: effect -> chi2 that it would add at twice its tolerance.
        steps: (what, held-out excess) after every accepted term.
        base: which of the steps is the model within its tolerances, without a term.
        single: the term that explains nearly everything alone, if there is one (``gap/search/single_cause.py``).
        within: values within tolerances, alike at all joints, at which the fit of the tolerances begins; on the ground.
        strained: whether the first term was accepted although the tolerances explain the data nearly as well.
        rivals: fitted models that nearly did as well as the first term, best first.
        returned: term -> share of the excess within the tolerances that came back without it, as it was last looked at.
    """

    scorer: Scorer
    splits: Splits
    settings: GapSettings
    dt: float
    rng: np.random.Generator
    progress: Callable[[str, float], None]
    state: State = field(init=False)
    select_chi2: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    nominal: Theta = field(default_factory=dict)
    first: float = math.nan
    aliases: dict[str, tuple[str, ...]] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)
    candidates: list[Candidate] = field(default_factory=list)
    signal: dict[str, float] = field(default_factory=dict)
    steps: list[tuple[str, float]] = field(default_factory=list)
    base: int = 0
    single: str = ""
    within: Theta = field(default_factory=dict)
    strained: bool = False
    rivals: list[Model] = field(default_factory=list)
    returned: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Begin with a model without terms at its nominal values."""
        self.state = State(self.scorer, self.splits, self.settings, self.dt)

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
        """Return which share of the excess within the tolerances comes back without a term; NaN if nobody looked."""
        if self.state.terms == (term,):
            return removed(self.first, excess(self.select_chi2))
        return self.returned.get(term, math.nan)

    def removes(self, term: str) -> float:
        """Return which share of the excess that is there without a term goes with it; NaN if nobody looked.

        Beside a large effect a small one has little of the whole excess, and may still be all that is left without it.
        """
        back = self.share_of(term) * self.first
        without = back + max(excess(self.select_chi2), 0.0)
        return back / without if without > 0.0 else math.nan

    def measured_again(self, first: float) -> None:
        """Take this as the held-out excess within the tolerances: terms bring their initial states and floors."""
        self.first = first
        self.steps[self.base] = (self.steps[self.base][0], first)

    def withdraw(self, why: str) -> None:
        """Take back all terms."""
        self.reject(self.state.terms, why)
        self.state = replace(self.state, terms=(), theta=self.nominal)
        self.steps.append(("withdrawn", self.first))

    # ------------------------------------------------------------------ one term

    def reject(self, names: Sequence[str], why: str) -> None:
        """Note in the evidence that effects were taken back, and why."""
        for k, c in enumerate(self.candidates):
            if c.status == "accepted" and c.effect in names:
                self.candidates[k] = replace(c, status="rejected", reason=why)
