"""The state of a search: its model, its evidence, and what became of its terms. Each step returns a new one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from go1exp.gap.data.windows import Splits
from go1exp.gap.replay.rows import Key, Machine, Theta
from go1exp.gap.result import Candidate, GapSettings
from go1exp.gap.score.likelihood import Scorer, excess, log_chi2, removed
from go1exp.gap.score.linear import Table, borrowed, table
from go1exp.gap.search import significance, thresholds, tolerances
from go1exp.gap.search.fit import Model, descend, scores
from go1exp.gap.search.screen import free_shapes
from go1exp.gap.search.tolerances import Freedom
from go1exp.sim.effects.tolerances import Tolerances, sizes


@dataclass(frozen=True)
class State:
    """A model with terms, and its fit."""

    scorer: Scorer  # of the windows
    splits: Splits  # which windows are for what
    settings: GapSettings  # the user's
    dt: float  # physics step, s
    theta: Theta = field(default_factory=dict)  # values of the model
    terms: tuple[str, ...] = ()  # accepted effects
    relaxed: tuple[str, ...] = ()  # effects that may move within their tolerances beside those of the tolerance box
    # effects and joints that stay within tolerance although their effect is a term
    kept: frozenset[tuple[str, int]] = frozenset()
    # the linear model of what may move about the nominal values; None before the first fit
    nominal: Table | None = None
    fitted: Table | None = None  # that about ``theta``; None before the first fit
    chi2: np.ndarray | None = None  # (V, G) per value on the windows of the fit; None before it

    @property
    def machine(self) -> Machine:
        """The robot that is compared."""
        return self.scorer.replayer.machine

    @property
    def tolerances(self) -> Tolerances:
        """Tolerances of that robot."""
        return self.machine.tolerances

    @property
    def keys(self) -> tuple[Key, ...]:
        """All parameters that may move: those of the tolerance box, and of the terms."""
        effects = dict.fromkeys([*tolerances.nominal(self.machine), *self.relaxed, *self.terms])
        shapes = [key for effect in self.terms for key in free_shapes(effect)]
        return (*(key for effect in effects for key in sizes(effect)), *shapes)

    @property
    def may(self) -> Freedom:
        """What may leave its tolerance."""
        return Freedom(self.tolerances, frozenset(self.terms), self.kept, not self.settings.calibrate)

    @property
    def table(self) -> Table:
        """The linear model of what may move about the fitted values."""
        assert self.fitted is not None
        return self.fitted

    @property
    def train_chi2(self) -> np.ndarray:
        """(V, G) chi2 per value on the windows of the fit."""
        assert self.chi2 is not None
        return self.chi2

    def linear(self, theta: Theta, windows: np.ndarray) -> Table:
        """Return the linear model of what may move about some values, on some windows (V,)."""
        probes = tolerances.probes(self.machine, self.keys, theta)
        return table(self.scorer, theta, windows, probes, self.dt)

    def model(self, theta: Theta) -> Model:
        """Return a model with all terms, to fit."""
        return Model("", theta, self.may, ())

    def converged(self, rounds: int, rival: State | None = None) -> State:
        """Return the state with all that may move fitted on the windows for training, in at most so many ``rounds``.

        A round measures the linear model and fits by it. No more are made once a round that gains as much as the last
        would not reach the fit of ``rival``.
        """
        worst = math.inf if rival is None else float(log_chi2(rival.train_chi2).mean())
        state, nearby = self, self._nearby() if rounds > 1 else None
        for turn in range(rounds):
            borrowing = not turn and nearby is not None
            linear = nearby if borrowing else state.linear(state.theta, self.splits.train)
            assert linear is not None
            before = float(log_chi2(self.scorer.chi2(linear.residual, linear.windows)).mean())
            best = descend(self.scorer, self.model(state.theta), linear, thresholds.STEPS_PER_ROUND, self.dt)
            assert best.residual is not None
            # Columns as they were measured: what they learned holds for the steps that were made, and for no others.
            fitted = replace(linear, residual=best.residual, theta=best.theta)
            state = replace(state, theta=best.theta, fitted=fitted, chi2=best.chi2)
            if state.nominal is None and not self.theta:
                state = replace(state, nominal=linear)
            reached = float(log_chi2(state.train_chi2).mean())
            gain = before - reached
            if reached - gain > worst:
                break
            if borrowing:
                if self._beside and gain < thresholds.BROYDEN_GAIN:
                    break
            elif gain < max(thresholds.CONVERGED, thresholds.CONVERGED_SHARE * reached) or (
                reached < thresholds.GOOD_FIT and not self.terms
            ):
                break
        return state

    @property
    def _beside(self) -> bool:
        """Whether the values are about those of the last linear model, and not nominal but for the terms."""
        return any(key[0] not in (*self.terms, *self.relaxed) for key in self.theta)

    def _nearby(self) -> Table | None:
        """Return a linear model about the values for a first round, with columns of a model that was measured before.

        That is the nominal one where all but the terms is nominal, else the last one. What differs from it by more than
        a tolerance has columns of its own. None on the ground, where columns of other values mean little.
        """
        known = self.fitted if self._beside else self.nominal
        if known is None or self.machine.on_ground:
            return None
        probes = tolerances.probes(self.machine, self.keys, self.theta)
        have = {p.key for p in known.probes}
        fresh = {key for key in self.keys if key not in have or self._far(key, known.theta)}
        return borrowed(known, self.scorer, self.theta, probes, fresh, self.dt)

    def _far(self, key: Key, other: Theta) -> bool:
        """Return whether a parameter differs from other values by more than its tolerance; a shape by anything."""
        p = self.tolerances.param(key)
        one, two = (theta.get(key, np.array([p.null])) for theta in (self.theta, other))
        return bool(np.any(np.abs(one - two) > (p.tolerance if math.isfinite(p.tolerance) else 0.0)))

    def at(self, theta: Theta) -> State:
        """Return the state with other values, as they are."""
        fitted = self.linear(theta, self.splits.train)
        chi2 = self.scorer.chi2(fitted.residual, fitted.windows)
        return replace(self, theta=theta, fitted=fitted, chi2=chi2)

    def updated(self) -> State:
        """Return the state with floors and initial states that suit its values."""
        assert self.scorer.updated is not None
        return replace(self, scorer=self.scorer.updated(self.theta))

    def finer(self) -> State:
        """Return the state replayed at a finer step by the same floors; itself on the ground, as contacts change."""
        finer = 1 if self.machine.on_ground else thresholds.FINER_STEPS
        return replace(self, scorer=replace(self.scorer, finer=finer))

    def without(self, term: str, instead: str = "") -> State:
        """Return the state without a term, or with another in its place, not fitted; its effect is within tolerance."""
        names = (instead if name == term else name for name in self.terms)
        theta = tolerances.without(self.theta, term, self.tolerances)
        return replace(self, terms=tuple(filter(None, names)), theta=theta)

    def keeping(self, kept: frozenset[tuple[str, int]]) -> State:
        """Return the state, not fitted, with terms' effects within tolerance at the joints of ``kept``."""
        theta = {key: self._within(key, value, kept) for key, value in self.theta.items()}
        return replace(self, kept=kept, theta=theta)

    def _within(self, key: Key, value: np.ndarray, kept: frozenset[tuple[str, int]]) -> np.ndarray:
        """Return values of which those at ``kept`` joints are within tolerance."""
        p = self.tolerances.param(key)
        joints = [j for name, j in kept if name == key[0]]
        if not joints or not math.isfinite(p.tolerance):
            return value
        values = np.broadcast_to(value, (len(self.machine.joints),)).copy()
        values[joints] = values[joints].clip(p.null - p.tolerance, p.null + p.tolerance)
        return values

    def held_out(self, theta: Theta | None = None, windows: np.ndarray | None = None) -> np.ndarray:
        """Return chi2 (V, G) of some values, or the present ones, on windows no fit has seen."""
        theta = self.theta if theta is None else theta
        return scores(self.scorer, [theta], self.splits.select if windows is None else windows, self.dt)[0]


@dataclass(frozen=True)
class LastCheck:
    """What terms do on windows that no decision has seen."""

    helps: bool  # whether most windows gain, or there is no gap; true without such windows
    # share of the excess chi-squared there that is gone; NaN without such windows, or without a gap there
    closed: float


@dataclass(frozen=True)
class Search:
    """What is known so far in a search. Each step of a search returns a new one."""

    state: State  # the present model, with its windows and settings
    rng: np.random.Generator  # of tests and bootstraps; drawn from in the order of the steps
    progress: Callable[[str, float], None]  # called with what is being done, and which share of all is finished
    # (V, G) chi2 per value of the present model on held-out windows
    select_chi2: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    nominal: Theta = field(default_factory=dict)  # values of the model within its tolerances, before any term
    first: float = math.nan  # held-out excess chi-squared with these
    aliases: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # effect -> effects that do as well
    shares: Mapping[str, float] = field(default_factory=dict)  # effect -> share of bootstraps in which it is selected
    candidates: tuple[Candidate, ...] = ()  # the evidence
    signal: Mapping[str, float] = field(default_factory=dict)  # effect -> chi2 that it would add at twice its tolerance
    steps: tuple[tuple[str, float], ...] = ()  # (what, held-out excess chi-squared) after every accepted term
    base: int = 0  # which of the steps is the model within its tolerances, without a term
    single: str = ""  # the term that explains nearly everything alone, or empty (``gap/search/single_cause.py``)
    # values within tolerances, shared by all joints, at which a fit on the ground begins
    within: Theta = field(default_factory=dict)
    # whether the first term was accepted although the tolerances explain the data nearly as well
    marginal: bool = False
    rivals: tuple[Model, ...] = ()  # fitted models that nearly did as well as the first term, best first
    # term -> share of the excess chi-squared that came back without it, in the last test of it
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
        """Return the share of the excess without a term that the term removes; NaN if not tested."""
        # Beside a large effect a small one has little of the whole excess, and may be all that is left without it.
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
