"""The present model of a search: which effects may move, their values, and how well they fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from go1exp.gap.data.windows import Splits
from go1exp.gap.replay.rows import Key, Machine, Theta
from go1exp.gap.result import GapSettings
from go1exp.gap.score.likelihood import Scorer, log_chi2
from go1exp.gap.score.linear import Table, borrowed, table
from go1exp.gap.search import thresholds, tolerances
from go1exp.gap.search.fit import Model, descend, scores
from go1exp.gap.search.screen import free_shapes
from go1exp.gap.search.tolerances import Freedom
from go1exp.sim.effects.tolerances import Tolerances, sizes


@dataclass(frozen=True)
class State:
    """A model with terms, and its fit.

    Attributes:
        scorer: of the windows.
        splits: which windows are for what.
        settings: the user's.
        dt: physics step, s.
        theta: values of the model.
        terms: accepted effects.
        loosened: effects that may move within their tolerances beside those of the tolerance box.
        kept: effects and joints that stay within tolerance although their effect is a term.
        nominal: the linear model of what may move about the nominal values; None before the first fit.
        fitted: that about ``theta``; None before the first fit.
        chi2: (V, G) per value on the windows of the fit; None before it.
    """

    scorer: Scorer
    splits: Splits
    settings: GapSettings
    dt: float
    theta: Theta = field(default_factory=dict)
    terms: tuple[str, ...] = ()
    loosened: tuple[str, ...] = ()
    kept: frozenset[tuple[str, int]] = frozenset()
    nominal: Table | None = None
    fitted: Table | None = None
    chi2: np.ndarray | None = None

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
        effects = dict.fromkeys([*tolerances.nominal(self.machine), *self.loosened, *self.terms])
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

    def settled(self, rounds: int, rival: State | None = None) -> State:
        """Return the state with all that may move fitted on the windows for training.

        Args:
            rounds: of measuring the linear model and fitting by it, at most.
            rival: whose fit is to be reached: once a round that gains as much as the last would not come there, no more
                are made.
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
        return any(key[0] not in (*self.terms, *self.loosened) for key in self.theta)

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

    def renewed(self) -> State:
        """Return the state with floors and initial states that suit its values."""
        assert self.scorer.renewed is not None
        return replace(self, scorer=self.scorer.renewed(self.theta))

    def finer(self) -> State:
        """Return the state whose residuals are replayed at a finer step, by the same floors; on the ground itself.

        Feet that touch the ground at another moment change more than the values do.
        """
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
