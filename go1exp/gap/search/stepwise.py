"""The stepwise search: fit what may move, screen, fit the best, judge, accept, and again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from go1exp.gap.replay.rows import Theta
from go1exp.gap.score.likelihood import excess
from go1exp.gap.search import candidates, reduction, significance, single_cause, thresholds, tolerances
from go1exp.gap.search.candidates import Trial, tried
from go1exp.gap.search.fit import Model, fit, misfit
from go1exp.gap.search.ledger import Ledger
from go1exp.gap.search.screen import Screened, library, motion, outside, rivals, screen
from go1exp.gap.search.state import State
from go1exp.sim.effects.tolerances import sizes


@dataclass
class Search(Ledger):
    """A search in progress, and its result (``gap/search/ledger.py``)."""

    # ------------------------------------------------------------------ the search

    def run(self) -> None:
        """Search."""
        cause = self.single_cause() if self.state.machine.on_ground else None
        if cause is None and self.within and self.settings.calibrate:
            # Of twelve joints that are each off within their tolerances a fit at states of the nominal model finds a
            # poor optimum: drives and masses that are all off alike had 26 times the floor left.
            self.state = replace(self.state, theta=self.within).renewed()
        self._fit_nominal()
        if cause is not None:
            self.progress(f"fitting the model with {cause.name}", 0.2)
            self.state, self.select_chi2 = self._with_term(cause)
        while len(self.state.terms) < self.settings.max_terms and self._advance():
            pass
        if self.state.terms:
            self.progress("is all of it needed", 0.85)
            reduction.eliminate(self)
            reduction.unite(self)
            reduction.simplify(self)
            reduction.prune(self)
            reduction.symmetrical(self)
        sizes_of_terms = [candidates.size(t, self.state.theta, self.state.tolerances) for t in self.state.terms]
        if self.strained and sizes_of_terms and max(sizes_of_terms) <= thresholds.CLEARLY_BEYOND:
            self.withdraw("it leaves its tolerance by too little to be called missing")

    def single_cause(self) -> Model | None:
        """Return the effect of the whole robot that explains nearly everything alone, if there is one."""
        sought = single_cause.cause(self.state, self.progress, self._judged)
        self.single, self.within = sought.best.name if sought.best else "", sought.within
        return sought.best

    def measure_signals(self) -> None:
        """Only measure how much each effect would show (``signal``)."""
        self.state = self.state.settled(1)
        self._note_signals(self._screened())

    def _fit_nominal(self) -> None:
        """Fit the model within its tolerances."""
        self.progress("fitting the model within its tolerances", 0.1)
        self.state = self.state.settled(3)
        self.select_chi2 = self.state.held_out()
        self.nominal, self.first = self.state.theta, excess(self.select_chi2)
        self.steps.append(("within tolerances", self.first))

    def _advance(self) -> bool:
        """Look for one more term, or one more effect to move within its tolerance; return whether to go on."""
        term = len(self.state.terms) + 1
        share = 0.15 + 0.7 * (term - 1) / self.settings.max_terms
        small = excess(self.select_chi2) < self.settings.material
        screened = self._screened() if self._looks_at_all(term, share, small) else []
        self._note_signals(screened)
        self.progress(f"fitting candidates for term {term}", share + 0.06)
        fitted = self._leaning(screened) if small else self._fitted(screened)
        accepted, inside = self._judged(fitted, self.state, self.state.train_chi2, self.select_chi2, small)
        if accepted is None and inside is None and not small and excess(self.select_chi2) <= self.settings.adequate:
            # Little is left, and nothing alone removes it: several tolerances may make up for what is missing.
            small = True
            fitted = self._leaning(screened)
            accepted, inside = self._judged(fitted, self.state, self.state.train_chi2, self.select_chi2, small)
        if accepted is not None:
            self.progress(f"fitting the model with {accepted.name}", share + 0.12)
            self.strained |= small and not self.state.terms
            return self._accept(accepted)
        if inside is None or len(self.state.loosened) == thresholds.MOST_RELAXED:
            return False
        self.progress(f"fitting the model with {inside.name}", share + 0.12)
        self._loosen(inside)
        return True

    def _looks_at_all(self, term: int, share: float, small: bool) -> bool:
        """Return whether all effects are screened: not where no gap is left, once their signals are known."""
        if small and self.signal:
            return False
        self.progress(f"screening for term {term}", share)
        return True

    def _leaning(self, screened: Sequence[Screened]) -> list[Model]:
        """Return fitted candidates where the tolerances close the gap: none unless something strains them.

        Args:
            screened: what screening says of every effect; it is asked if that is nothing, and needed.
        """
        within = tolerances.nominal(self.state.machine)
        relief = tolerances.relief(self.state.scorer, self.state.table, self.state.may)
        values = tolerances.values(self.state.scorer, self.state.table)
        straining = tolerances.straining(relief, values, [*self.state.terms, *self._unasked()])
        missing = outside(screened, within)
        if not straining and not missing:
            self._note_absorbed(relief)
            return []
        if not straining:
            return self._fitted(missing)
        given_back = [self._given_back(effect, self.state.theta) for effect in straining]
        taken_for = rivals(screened or self._screened(), straining, within)
        fitted = [self._given_back(s.variant.effect, s.theta, thresholds.RIVAL_ROUNDS) for s in taken_for]
        return given_back + [replace(m, keys=s.variant.free) for m, s in zip(fitted, taken_for, strict=True)]

    def _accept(self, model: Model) -> bool:
        """Make a candidate a term, unless the model is worse with all else fitted again; return whether it is one."""
        first = self.first
        state, chi2 = self._with_term(model)
        if excess(chi2) <= excess(state.held_out(self.state.theta)) + thresholds.SAME_GAIN:  # by the same floors
            self.state, self.select_chi2 = state, chi2
            return True
        self.steps.pop()
        self.measured_again(first)
        self.reject([model.name], "with all else fitted again the held-out error grows")
        return False

    def _with_term(self, model: Model) -> tuple[State, np.ndarray]:
        """Return the state with a candidate as a term and all else fitted again, and chi2 of held-out windows."""
        terms = (*self.state.terms, model.name)
        loosened = tuple(name for name in self.state.loosened if name != model.name)
        # What the box had taken on in place of the effect it gives back: it starts from the nominal values.
        theta = {key: value for key, value in model.theta.items() if key[0] in (*terms, *loosened)}
        state = replace(self.state, terms=terms, loosened=loosened, theta=theta)
        renews, held = state.scorer.renewed is not None, not state.machine.on_ground
        if renews and (held or model.name == self.single):
            # A loaded link answers its initial state otherwise: by the plain model's answer the truth has twice the
            # floor's chi2, and a fit spreads the load over its neighbours and the drives.
            state = state.renewed()
        state = state.settled(4)
        if renews:
            state = state.renewed().settled(2 if held else 1)
        chi2, plain = state.held_out(), state.held_out(model.theta)
        # With little data, what was fitted from scratch can be a poorer optimum.
        if excess(plain) < excess(chi2) - thresholds.SAME_GAIN:
            state, chi2 = state.at(model.theta), plain
        self.measured_again(excess(state.held_out(self.nominal)))  # by the same floors
        self.steps.append((model.name, excess(chi2)))
        return state, chi2

    def _loosen(self, model: Model) -> None:
        """Let an effect move within its tolerance."""
        loosened = (*self.state.loosened, model.name)
        self.state = replace(self.state, loosened=loosened, theta=model.theta).settled(2)
        self.select_chi2 = self.state.held_out()
        if not self.state.terms:
            self.nominal, self.first, self.base = self.state.theta, excess(self.select_chi2), len(self.steps)
        self.steps.append((f"{model.name} within its tolerance", excess(self.select_chi2)))

    # ------------------------------------------------------------------ candidates

    def _screened(self) -> list[Screened]:
        """Rank all ways in which an effect could be missing, on some of the windows of the fit."""
        linear, machine = self.state.table, self.state.machine
        moved = motion(self.state.scorer.windows, machine.effort)
        variants = library(machine, moved, [*self.state.terms, *self.state.loosened])
        if self.settings.effects:
            variants = [v for v in variants if v.effect in self.settings.effects]
        count = len(linear.windows)
        # Half of the windows that are looked at are the worst, half are spread evenly.
        worst = np.argsort(-self.state.scorer.chi2(linear.residual, linear.windows).sum(1))[
            : thresholds.SCREENED_WINDOWS // 2
        ]
        evenly = np.linspace(0, count - 1, min(thresholds.SCREENED_WINDOWS // 2, count)).astype(int)
        part = linear.part(np.unique([*worst, *evenly]))
        return screen(self.state.scorer, self.state.theta, part, self.state.may, variants, self.dt)

    def _note_signals(self, screened: Sequence[Screened]) -> None:
        for s in screened:
            self.signal[s.variant.effect] = max(self.signal.get(s.variant.effect, 0.0), s.signal)

    def _note_absorbed(self, relief: dict[str, float]) -> None:
        """Note which effects of the tolerance box the data would rather have outside it."""
        if not self.state.terms:  # beside a term they are no rivals of it
            state, most = self.state, self.settings.shortlist
            self.candidates += candidates.absorbed(state.keys, relief, state.theta, state.tolerances, most)

    def _unasked(self) -> list[str]:
        """Return the effects that the user does not want to be considered."""
        wanted = self.settings.effects
        return [e for e in tolerances.nominal(self.state.machine) if wanted and e not in wanted]

    def _freed(self, effect: str) -> Model:
        """Return the model in which an effect of the tolerance box may leave its tolerance, fitted."""
        model = Model(effect, self.state.theta, self.state.may.also(effect), sizes(effect))
        return fit(self.state.scorer, [model], self.state.table, self.settings.iterations, self.dt)[0]

    def _given_back(self, effect: str, theta: Theta, rounds: int = 2) -> Model:
        """Return the model in which an effect may leave its tolerance, and the others begin at their nominal values.

        Several effects within their tolerances make up for it together, at next to no cost: from there a fit of few
        steps hardly comes away.

        Args:
            effect: the candidate.
            theta: values of which those of the candidate and of the terms are kept.
            rounds: of fitting, at most.
        """
        terms = (*self.state.terms, effect)
        kept = {key: value for key, value in theta.items() if key[0] in (*terms, *self.state.loosened)}
        state = replace(self.state, terms=terms, theta=kept).settled(rounds)
        return Model(effect, state.theta, state.may, sizes(effect), state.train_chi2, state.table.residual)

    def _fitted(self, screened: Sequence[Screened]) -> list[Model]:
        """Return models of the best candidates, fitted.

        They start from what screening made of a few windows, and what looks hopeless after a step is given up. Where
        the model is near the data both may mislead: effects of the tolerance box are also fitted each on its own, from
        where they are, and the better fit counts. So may it where the best candidate is one that another is easily
        taken for: that one is fitted from nominal values of all else, too.
        """
        chosen: dict[str, Screened] = {}
        for s in screened:
            if len(chosen) < self.settings.shortlist and s.gain > 0.0:
                chosen.setdefault(s.variant.effect, s)
        may = self.state.may
        models = [Model(effect, s.theta, may.also(effect), s.variant.free) for effect, s in chosen.items()]
        fitted = fit(self.state.scorer, models, self.state.table, self.settings.iterations, self.dt) if models else []
        fitted = self._fitted_on(fitted)
        near = excess(self.select_chi2) <= self.settings.adequate
        movable = {key[0] for key in self.state.keys} if near else set()
        again = [self._freed(m.name) if m.name in movable else m for m in fitted]
        better = [min(pair, key=misfit) for pair in zip(fitted, again, strict=True)]
        best = min(better, key=misfit).name if better else ""
        return [
            min(m, self._given_back(m.name, m.theta), key=misfit) if tolerances.confounded(m.name, best) else m
            for m in better
        ]

    def _fitted_on(self, fitted: Sequence[Model]) -> list[Model]:
        """Return candidates, of which those that leave next to nothing are fitted on, if there are several.

        They may do equally well, and one whose fit ended a little early would be called worse than the others.
        """
        near = [m for m in fitted if m.chi2 is not None and excess(m.chi2) <= self.settings.adequate]
        if len(near) < 2:
            return [*fitted]
        ended = fit(self.state.scorer, near, self.state.table, self.settings.iterations, self.dt)
        by_name = {m.name: m for m in (*fitted, *ended)}
        return [by_name[m.name] for m in fitted]

    # ------------------------------------------------------------------ judgement

    def _judged(
        self, fitted: Sequence[Model], state: State, train: np.ndarray, select: np.ndarray, small: bool = False
    ) -> tuple[Model | None, Model | None]:
        """Test fitted candidates on held-out windows and note the evidence.

        Args:
            fitted: the candidates.
            state: with the scorer that counts.
            train: (V, G) chi2 of the present model on the windows of the fit.
            select: the same on held-out windows.
            small: whether the gap is small, so that which share of it a candidate removes means nothing.

        Returns:
            The one to accept, and the best of those that help within their tolerances.
        """
        if not fitted:
            return None, None
        windows = self.splits.select
        trial = tried(state.scorer, self.settings, fitted, train, select, windows, self.dt, self.rng, small)
        alias = sorted(np.flatnonzero(trial.alias).tolist(), key=lambda k: -trial.mean[k])
        names = tuple(fitted[k].name for k in alias)
        self._note_trial(trial, fitted, names)
        helps = [k for k in range(len(fitted)) if trial.helps[k] and trial.sizes[k] <= 1.0]
        inside = fitted[max(helps, key=lambda k: trial.mean[k])] if helps else None
        if trial.chosen is None:
            return None, inside
        accepted = fitted[trial.chosen]
        if not self.state.terms:
            near = trial.mean > thresholds.EQUAL_SHARE * trial.mean[trial.chosen]
            order = [k for k in np.argsort(-trial.mean) if near[k] and trial.sizes[k] > 1.0 and k != trial.chosen]
            self.rivals = [fitted[k] for k in order[: thresholds.RIVALS]]
        self.aliases[accepted.name] = (accepted.name, *(n for n in names if n != accepted.name))
        on_train = significance.gains(train, np.stack([m.chi2 for m in fitted if m.chi2 is not None]))
        every = np.concatenate([on_train, trial.gain], axis=1)
        self.shares[accepted.name] = self._bootstrap_share(every[~trial.aside], trial.alias[~trial.aside])
        return accepted, inside

    def _note_trial(self, trial: Trial, fitted: Sequence[Model], aliases: tuple[str, ...]) -> None:
        """Add the candidates of a trial to the evidence, best first."""
        for k in np.argsort(-trial.mean):
            status, reason = trial.reason(int(k))
            self.candidates.append(
                candidates.candidate(
                    fitted[k],
                    self.scorer.windows.joints,
                    excess_after=trial.after[k],
                    log_gain=float(trial.mean[k]),
                    p=float(trial.p[k]),
                    alias_class=aliases if trial.alias[k] else (fitted[k].name,),
                    status=status,
                    reason=reason,
                    stage=len(self.state.terms) + 1,
                )
            )

    def _bootstrap_share(self, gain: np.ndarray, alias: np.ndarray) -> float:
        """Return the share of bootstraps in which the chosen candidate, or its equal (``alias``), gains most."""
        episode = self.scorer.windows.episode[np.concatenate([self.splits.train, self.splits.select])]
        episode = np.repeat(episode, len(self.state.machine.groups))
        wins = 0
        for _ in range(self.settings.bootstraps):
            picked = significance.resampled(episode, self.rng)
            mean = gain[:, picked].mean(axis=1)
            close = mean >= mean.max() - significance.same(mean.max())
            wins += bool(close[alias].any())
        return wins / max(self.settings.bootstraps, 1)
