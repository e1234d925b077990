"""The stepwise search: fit what may move, screen, fit the best, judge, accept, and again."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from go1exp.effects.tolerances import Tolerances, sizes
from go1exp.gap.replay.rows import Key, Theta
from go1exp.gap.result import Candidate, GapSettings
from go1exp.gap.score.likelihood import Scorer
from go1exp.gap.score.linear import Table, table
from go1exp.gap.search import evidence, significance, single_cause, strain, tolerances
from go1exp.gap.search.fit import Model, fit, misfit, scores
from go1exp.gap.search.screen import Screened, free_shapes, library, outside, screen
from go1exp.gap.search.trial import excess, removed, tried

Progress = Callable[[str, float], None]

SILENT = 0.02
"""An effect that adds less than this to the chi2 of every window, at twice its tolerance, is not excited."""

SCREENED = 20
"""Windows in which candidates are screened, at most."""

LOOSENED = 3
"""Most effects that join the box because the data ask for some of them, within their tolerances."""

NEEDED = 12.0
"""Fall of chi2 that a joint must bring before it may leave the tolerance of a term's effect."""

SETTLED = 0.01
"""Fall of log chi2 in a round of fitting, and log chi2 itself, below which more rounds are not worth their time."""


@dataclass
class Search:
    """A search in progress, and what it found.

    Attributes:
        scorer: of the windows.
        splits: which windows are for what.
        settings: the user's.
        dt: physics step, s.
        rng: of tests and bags.
        progress: told what goes on, and which share of all is done.
        theta: values of the present model.
        nominal: values of the model within its tolerances, before any term.
        first: held-out excess with these.
        terms: accepted effects.
        loosened: effects that may move within their tolerances beside those of the box.
        kept: effects and joints that stay within tolerance although their effect is a term.
        aliases: effect -> effects that do as well.
        shares: effect -> share of bags in which it wins.
        candidates: the evidence.
        signal: effect -> how loud it would be at twice its tolerance.
        steps: (what, held-out excess) after every accepted term.
        single: the term that explains nearly everything alone, if there is one (``gap/search/single_cause.py``).
        own: the linear model of what may move, with the residuals at ``theta`` and changes near it.
    """

    scorer: Scorer
    splits: significance.Splits
    settings: GapSettings
    dt: float
    rng: np.random.Generator
    progress: Progress
    theta: Theta = field(default_factory=dict)
    nominal: Theta = field(default_factory=dict)
    first: float = math.nan
    terms: list[str] = field(default_factory=list)
    loosened: list[str] = field(default_factory=list)
    kept: frozenset[tuple[str, int]] = frozenset()
    aliases: dict[str, tuple[str, ...]] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)
    candidates: list[Candidate] = field(default_factory=list)
    signal: dict[str, float] = field(default_factory=dict)
    steps: list[tuple[str, float]] = field(default_factory=list)
    own: Table | None = None
    single: str = ""

    @property
    def keys(self) -> tuple[Key, ...]:
        """All parameters that may move: those of the box, and of the terms."""
        effects = dict.fromkeys([*tolerances.nominal(self.scorer.replayer.machine), *self.loosened, *self.terms])
        shapes = [key for effect in self.terms for key in free_shapes(effect)]
        return (*(key for effect in effects for key in sizes(effect)), *shapes)

    @property
    def robot_tolerances(self) -> Tolerances:
        """Tolerances of the robot that is compared."""
        return self.scorer.replayer.machine.tolerances

    def linear(self, theta: Theta, windows: np.ndarray) -> Table:
        """Return the linear model of what may move."""
        return table(
            self.scorer, theta, windows, tolerances.probes(self.scorer.replayer.machine, self.keys, theta), self.dt
        )

    @property
    def may(self) -> tolerances.Freedom:
        """What may leave its tolerance."""
        return tolerances.Freedom(self.robot_tolerances, frozenset(self.terms), self.kept, not self.settings.calibrate)

    def model(self, theta: Theta) -> Model:
        """Return a model with all terms, to fit."""
        return Model("", theta, self.may, ())

    def settle(self, rounds: int) -> np.ndarray:
        """Fit all that may move, on the windows for training; return chi2 (V, G) there."""
        reached = np.inf
        for _ in range(rounds):
            own = self.linear(self.theta, self.splits.train)
            (best,) = fit(self.scorer, [self.model(self.theta)], own, 2, self.dt)
            self.theta = best.theta
            assert best.chi2 is not None
            before, reached = reached, float(np.log(best.chi2).mean())
            if reached > before - SETTLED or (reached < SETTLED and not self.terms):
                break
        assert best.residual is not None
        assert best.chi2 is not None
        self.own = replace(own, residual=best.residual, theta=best.theta)
        return best.chi2

    def held_out(self, theta: Theta, windows: np.ndarray | None = None) -> np.ndarray:
        """Return chi2 (V, G) on windows no fit has seen."""
        return scores(self.scorer, [theta], self.splits.select if windows is None else windows, self.dt)[0]

    def run(self) -> None:
        """Search."""
        settings = self.settings
        hidden = single_cause.cause(self) if self.scorer.replayer.machine.base_probe else None
        self.progress("fitting the model within its tolerances", 0.1)
        train = self.settle(3)
        now = self.held_out(self.theta)
        self.nominal, self.first = self.theta, excess(now)
        self.steps.append(("within tolerances", excess(now)))
        stage, strained = 1, False
        if hidden is not None:
            self.progress(f"fitting the model with {hidden.name}", 0.2)
            train, now = self._take(hidden)
            stage = 2
        while stage <= settings.max_terms:
            share = 0.15 + 0.7 * (stage - 1) / settings.max_terms
            small = excess(now) < settings.material
            found: list[Screened] = []
            if not small or not self.signal:
                self.progress(f"screening for term {stage}", share)
                found = self._screened()
                self._listen(found)
            assert self.own is not None
            relief = strain.relief(self.scorer, self.own, self.may) if small else {}
            straining = strain.straining(relief, strain.values(self.scorer, self.own), [*self.terms, *self._unasked()])
            beyond = outside(found, tolerances.nominal(self.scorer.replayer.machine)) if small and not straining else []
            if small and straining is None and not beyond:
                if not self.terms:  # beside a term they are no rivals of it
                    self.candidates += evidence.absorbed(
                        self.keys, relief, self.theta, self.robot_tolerances, settings.shortlist
                    )
                break
            self.progress(f"fitting candidates for term {stage}", share + 0.06)
            chosen = beyond if small else found
            near = excess(now) <= settings.adequate
            fitted = self._fitted(chosen, near) if straining is None else self._freed(straining)
            accepted, inside = self.judged(stage, fitted, train, now, small)
            if accepted is None and (inside is None or len(self.loosened) == LOOSENED):
                break
            self.progress(f"fitting the model with {(accepted or inside).name}", share + 0.12)  # type: ignore[union-attr]
            if accepted is not None:
                state = list(self.terms), list(self.loosened), self.theta, self.own, self.scorer, self.first
                strained |= small and not self.terms
                train, now = self._take(accepted)
                if excess(now) > excess(self.held_out(state[2])) + significance.SAME:  # by the same floors
                    self.terms, self.loosened, self.theta, self.own, self.scorer, self.first = state
                    now = self._refused(accepted.name)
                    break
                stage += 1
            else:
                assert inside is not None
                train, now = self._loosen(inside, now)
        if self.terms:
            self.progress("is all of it needed", 0.85)
            self._eliminate(now)
            self._simplify()
            self._prune()
        if (
            strained
            and self.terms
            and max(evidence.size(t, self.theta, self.robot_tolerances) for t in self.terms) <= strain.CLEAR
        ):
            self.withdraw("it leaves its tolerance by too little to be called missing")

    def confirmed(self) -> bool:
        """Return whether the terms help on the episodes kept for a last check, or there is nothing to help there."""
        kept = self.splits.confirm
        if not len(kept):
            return True
        before, after = (self.held_out(theta, kept) for theta in (self.nominal, self.theta))
        least = 0.0 if excess(before) > self.settings.material else -significance.SAME
        return bool(significance.gains(before, after[None]).mean() > least)

    def withdraw(self, why: str) -> None:
        """Take back all terms."""
        self._reject(self.terms, why)
        self.terms, self.theta = [], self.nominal
        self.steps.append(("withdrawn", self.first))

    def listen(self) -> None:
        """Only find out how loud each effect would be (``signal``)."""
        self.settle(1)
        self._listen(self._screened())

    def _take(self, model: Model) -> tuple[np.ndarray, np.ndarray]:
        """Make a candidate a term; return chi2 of training and of held-out windows."""
        self.terms.append(model.name)
        self.loosened = [name for name in self.loosened if name != model.name]
        # What the box had taken on in place of the effect it gives back: it starts from the nominal values.
        self.theta = {k: v for k, v in model.theta.items() if k[0] in (*self.terms, *self.loosened)}
        if self.scorer.renewed is not None and model.name == self.single:
            self.scorer = self.scorer.renewed(self.theta)
        train = self.settle(4)
        if self.scorer.renewed is not None:
            self.scorer = self.scorer.renewed(self.theta)
            train = self.settle(1)
        now, plain = self.held_out(self.theta), self.held_out(model.theta)
        if (
            excess(plain) < excess(now) - significance.SAME
        ):  # little data: what was fitted from scratch is a poorer optimum
            self.theta, now = model.theta, plain
            self.own = self.linear(self.theta, self.splits.train)
            train = self.scorer.chi2(self.own.residual, self.own.windows)
        self.first = excess(self.held_out(self.nominal))  # by the same floors
        self.steps.append((model.name, excess(now)))
        return train, now

    def _refused(self, name: str) -> np.ndarray:
        """Note that a term that looked well made things worse with all else fitted again; return held-out chi2."""
        self.steps.pop()
        self._reject([name], "with all else fitted again the held-out error grows")
        return self.held_out(self.theta)

    def _reject(self, names: Sequence[str], why: str) -> None:
        for k, c in enumerate(self.candidates):
            if c.status == "accepted" and c.effect in names:
                self.candidates[k] = replace(c, status="rejected", reason=why)

    def _loosen(self, model: Model, now: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Let an effect move within its tolerance; return chi2 of training and of held-out windows."""
        self.loosened.append(model.name)
        self.theta = model.theta
        train, after = self.settle(2), self.held_out(self.theta)
        if not self.terms:
            self.nominal, self.first = self.theta, excess(after)
        self.steps.append((f"{model.name} within its tolerance", excess(after)))
        return train, after

    def _screened(self) -> list[Screened]:
        own = self.own
        assert own is not None
        mean = self.scorer.windows.y[:, :, 0].mean((0, 1))
        ways = library(self.scorer.replayer.machine, mean, [*self.terms, *self.loosened])
        if self.settings.effects:
            ways = [v for v in ways if v.effect in self.settings.effects]
        count = len(own.windows)
        # Half of the windows that are looked at are the worst, half are spread evenly.
        worst = np.argsort(-self.scorer.chi2(own.residual, own.windows).sum(1))[: SCREENED // 2]
        evenly = np.linspace(0, count - 1, min(SCREENED // 2, count)).astype(int)
        some = own.part(np.unique([*worst, *evenly]))
        return screen(self.scorer, self.theta, some, self.may, ways, self.dt)

    def _unasked(self) -> list[str]:
        """Return the effects that the user does not want to be considered."""
        wanted = self.settings.effects
        return [e for e in tolerances.nominal(self.scorer.replayer.machine) if wanted and e not in wanted]

    def _freed(self, effect: str) -> list[Model]:
        """Return the model in which an effect of the box may leave its tolerance, fitted."""
        assert self.own is not None
        model = Model(effect, self.theta, self.may.also(effect), sizes(effect))
        return fit(self.scorer, [model], self.own, self.settings.iterations, self.dt)

    def _listen(self, found: Sequence[Screened]) -> None:
        for s in found:
            self.signal[s.variant.effect] = max(self.signal.get(s.variant.effect, 0.0), s.signal)

    def _fitted(self, found: Sequence[Screened], near: bool) -> list[Model]:
        """Return models of the best candidates, fitted.

        They start from what screening made of a few windows, and what looks hopeless after a step is given up. Where
        the model is ``near`` the data both may mislead: effects of the box are also fitted each on its own, from where
        they are, and the better fit counts.
        """
        chosen: dict[str, Screened] = {}
        for s in found:
            if len(chosen) < self.settings.shortlist and s.gain > 0.0:
                chosen.setdefault(s.variant.effect, s)
        models = [Model(effect, s.theta, self.may.also(effect), s.variant.free) for effect, s in chosen.items()]
        assert self.own is not None
        fitted = fit(self.scorer, models, self.own, self.settings.iterations, self.dt) if models else []
        own = {key[0] for key in self.keys} if near else ()
        again = [self._freed(m.name)[0] if m.name in own else m for m in fitted]
        return [min(pair, key=misfit) for pair in zip(fitted, again, strict=True)]

    def judged(
        self, stage: int, fitted: list[Model], train: np.ndarray, now: np.ndarray, small: bool = False
    ) -> tuple[Model | None, Model | None]:
        """Test the fitted candidates on held-out windows and note the evidence.

        Where the gap is ``small``, what a candidate removes of it is not asked.

        Returns:
            The one to accept, and the best of those that help within their tolerances.
        """
        if not fitted:
            return None, None
        trial = tried(self.scorer, self.settings, fitted, train, now, self.splits.select, self.dt, self.rng, small)
        names = tuple(fitted[k].name for k in sorted(np.flatnonzero(trial.alias), key=lambda k: -trial.mean[k]))
        for k in np.argsort(-trial.mean):
            status, reason = trial.reason(int(k))
            self.candidates.append(
                evidence.candidate(
                    fitted[k],
                    self.scorer.windows.joints,
                    excess_after=trial.after[k],
                    log_gain=float(trial.mean[k]),
                    p=float(trial.p[k]),
                    alias_class=names if trial.alias[k] else (fitted[k].name,),
                    status=status,
                    reason=reason,
                    stage=stage,
                )
            )
        helps = [k for k in range(len(fitted)) if trial.helps[k] and trial.sizes[k] <= 1.0]
        inside = fitted[max(helps, key=lambda k: trial.mean[k])] if helps else None
        if trial.chosen is None:
            return None, inside
        accepted = fitted[trial.chosen]
        self.aliases[accepted.name] = (accepted.name, *(n for n in names if n != accepted.name))
        on_train = significance.gains(train, np.stack([m.chi2 for m in fitted if m.chi2 is not None]))
        every = np.concatenate([on_train, trial.gain], axis=1)
        self.shares[accepted.name] = self._bag(every[~trial.aside], trial.alias[~trial.aside])
        return accepted, inside

    def _bag(self, gain: np.ndarray, alias: np.ndarray) -> float:
        """Return the share of resampled windows in which the chosen candidate or its equal (``alias``) gains most."""
        episode = self.scorer.windows.episode[np.concatenate([self.splits.train, self.splits.select])]
        episode = np.repeat(episode, len(self.scorer.replayer.machine.groups))
        wins = 0
        for _ in range(self.settings.bags):
            picked = significance.resampled(episode, self.rng)
            mean = gain[:, picked].mean(axis=1)
            close = mean >= mean.max() - significance.same(mean.max())
            wins += bool(close[alias].any())
        return wins / max(self.settings.bags, 1)

    def _eliminate(self, now: np.ndarray) -> None:
        """Drop terms without which the rest does as well."""
        for name in [t for t in self.terms if t != self.single and len(self.terms) > 1]:
            theta = tolerances.without(self.theta, name, self.robot_tolerances)
            rest = replace(self, terms=[t for t in self.terms if t != name], theta=theta)
            rest.settle(1)
            without = self.held_out(rest.theta)
            gain = significance.gains(without, now[None])
            needed = removed(excess(without), excess(now)) > self.settings.min_share
            if not needed or significance.max_t(gain, self.rng)[0] >= self.settings.alpha:
                self.terms, self.theta, self.own, now = rest.terms, rest.theta, rest.own, without
                self.steps.append((f"without {name}", excess(now)))

    def _simplify(self) -> None:
        """Replace terms by effects that say the same with fewer numbers, where they do."""
        for name in [t for t in self.terms if (tolerances.identification(t).simpler or t) not in self.terms]:
            other = tolerances.identification(name).simpler
            terms = [other if t == name else t for t in self.terms]
            rest = replace(self, terms=terms, theta=tolerances.without(self.theta, name, self.robot_tolerances))
            rest.settle(2)
            before, now = self.held_out(self.nominal), self.held_out(self.theta)
            gain, less = significance.gains(before, np.stack([now, self.held_out(rest.theta)])).mean(axis=1)
            if less > gain - significance.same(gain) and evidence.size(other, rest.theta, self.robot_tolerances) > 1.0:
                self.terms, self.theta, self.own = rest.terms, rest.theta, rest.own
                self.aliases[other], self.shares[other] = (other,), self.shares[name]
                self.steps.append((f"{other} in place of {name}", excess(self.held_out(self.theta))))

    def _prune(self) -> None:
        """Bring back within tolerance what leaves it at a joint for next to nothing."""
        machine = self.scorer.replayer.machine
        assert self.own is not None
        cost = strain.cost(self.scorer, self.own)
        kept = self.kept
        for name in self.terms:
            out = np.flatnonzero(evidence.beyond(name, self.theta, machine.joints, self.robot_tolerances))
            alone = {int(j): cost(replace(self.may, kept=kept | {(name, int(j))})) for j in out}
            for j in sorted(alone, key=lambda j: alone[j])[: len(out) - 1]:  # where it brings most, it stays
                more = kept | {(name, j)}
                if cost(replace(self.may, kept=more)) - cost(replace(self.may, kept=kept)) < NEEDED:
                    kept = more
        if kept != self.kept:
            self.kept = kept
            self.theta = {k: self._within(k, v) for k, v in self.theta.items()}
            self.settle(2)
            self.steps.append(("at fewer joints", excess(self.held_out(self.theta))))

    def _within(self, key: Key, value: np.ndarray) -> np.ndarray:
        """Return values of which those of ``kept`` joints are within tolerance."""
        p = self.robot_tolerances.param(key)
        mine = [j for name, j in self.kept if name == key[0]]
        if not mine or not math.isfinite(p.tolerance):
            return value
        found = np.broadcast_to(value, (len(self.scorer.windows.joints),)).copy()
        found[mine] = found[mine].clip(p.null - p.tolerance, p.null + p.tolerance)
        return found
