"""The stepwise search: fit what may move, screen, fit the best, judge, accept, and again."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from go1exp.gap import box, judge
from go1exp.gap.fit import Model, fit, scores
from go1exp.gap.likelihood import Scorer, Table, table
from go1exp.gap.replay import Key, Theta
from go1exp.gap.result import Candidate, GapSettings
from go1exp.gap.screen import FREE_SHAPES, Screened, library, screen

Progress = Callable[[str, float], None]

SILENT = 0.02
"""An effect that adds less than this to the chi2 of every window, at twice its tolerance, is not excited."""

SCREENED = 20
"""Windows in which candidates are screened, at most."""

FEW = 0.5
"""A candidate that removes more than this share of the excess without being significant is seen in too few windows."""

SETTLED = 0.01
"""Fall of log chi2 in a round of fitting, and log chi2 itself, below which more rounds are not worth their time."""


def excess(chi2: np.ndarray) -> float:
    """Return the mean excess of chi2 per value (V, G)."""
    return float(chi2.mean() - 1.0) if chi2.size else math.nan


def removed(before: float, after: float) -> float:
    """Return the share of an excess that is gone; what lies below the floor counts as nothing."""
    return 1.0 - max(after, 0.0) / before if before > 0 else 0.0


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
        terms: accepted effects.
        aliases: effect -> effects that do as well.
        shares: effect -> share of bags in which it wins.
        candidates: the evidence.
        signal: effect -> how loud it would be at twice its tolerance.
        steps: (what, held-out excess) after every accepted term.
        own: the linear model of what may move, with the residuals at ``theta`` and changes near it.
    """

    scorer: Scorer
    splits: judge.Splits
    settings: GapSettings
    dt: float
    rng: np.random.Generator
    progress: Progress
    theta: Theta = field(default_factory=dict)
    terms: list[str] = field(default_factory=list)
    aliases: dict[str, tuple[str, ...]] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)
    candidates: list[Candidate] = field(default_factory=list)
    signal: dict[str, float] = field(default_factory=dict)
    steps: list[tuple[str, float]] = field(default_factory=list)
    own: Table | None = None

    @property
    def keys(self) -> tuple[Key, ...]:
        """All parameters that may move: those of the box, and of the terms."""
        effects = dict.fromkeys([*box.BOX, *self.terms])
        shapes = [(e, name) for e in self.terms for name in FREE_SHAPES.get(e, ())]
        return (*(k for e in effects for k in box.sizes(e)), *shapes)

    def linear(self, theta: Theta, windows: np.ndarray) -> Table:
        """Return the linear model of what may move."""
        return table(self.scorer, theta, windows, box.probes(self.scorer.replayer.machine, self.keys, theta), self.dt)

    def settle(self, rounds: int) -> np.ndarray:
        """Fit all that may move, on the windows for training; return chi2 (V, G) there."""
        reached = np.inf
        for _ in range(rounds):
            own = self.linear(self.theta, self.splits.train)
            (best,) = fit(self.scorer, [Model("", self.theta, frozenset(self.terms), ())], own, 2, self.dt)
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
        self.progress("fitting the model within its tolerances", 0.1)
        train = self.settle(3)
        now = self.held_out(self.theta)
        self.steps.append(("within tolerances", excess(now)))
        for stage in range(1, settings.max_terms + 1):
            if excess(now) < settings.material and stage > 1:
                break
            share = 0.15 + 0.7 * (stage - 1) / settings.max_terms
            self.progress(f"screening for term {stage}", share)
            found, own = self._screened()
            if stage == 1:
                self._listen(found)
            if excess(now) < settings.material:
                break
            self.progress(f"fitting candidates for term {stage}", share + 0.06)
            fitted = self._fitted(found, own)
            accepted = self._judged(stage, fitted, found, train, now)
            if accepted is None:
                break
            self.terms.append(accepted.name)
            # What the box had taken on in place of the effect it gives back: it starts from the nominal values.
            self.theta = {key: value for key, value in accepted.theta.items() if key[0] in self.terms}
            self.progress(f"fitting the model with {accepted.name}", share + 0.12)
            train = self.settle(4)
            now = self.held_out(self.theta)
            self.steps.append((accepted.name, excess(now)))
        if len(self.terms) > 1:
            self._eliminate(now)

    def listen(self) -> None:
        """Only find out how loud each effect would be (``signal``)."""
        self.settle(1)
        found, _ = self._screened()
        self._listen(found)

    def _screened(self) -> tuple[list[Screened], Table]:
        assert self.own is not None
        mean = self.scorer.windows.y[:, :, 0].mean((0, 1))
        ways = library(self.scorer.replayer.machine, mean, self.terms)
        if self.settings.effects:
            ways = [v for v in ways if v.effect in self.settings.effects]
        count = len(self.own.windows)
        # Half of the windows that are looked at are the worst, half are spread evenly.
        worst = np.argsort(-self.scorer.chi2(self.own.residual, self.own.windows).sum(1))[: SCREENED // 2]
        evenly = np.linspace(0, count - 1, min(SCREENED // 2, count)).astype(int)
        some = self.own.part(np.unique([*worst, *evenly]))
        return screen(self.scorer, self.theta, some, self.terms, ways, self.dt), self.own

    def _listen(self, found: Sequence[Screened]) -> None:
        for s in found:
            self.signal[s.variant.effect] = max(self.signal.get(s.variant.effect, 0.0), s.signal)

    def _fitted(self, found: Sequence[Screened], own: Table) -> list[Model]:
        chosen: dict[str, Screened] = {}
        for s in found:
            if len(chosen) < self.settings.shortlist and s.gain > 0.0:
                chosen.setdefault(s.variant.effect, s)
        models = []
        for effect, s in chosen.items():
            keys = s.variant.free
            models.append(Model(effect, s.theta, frozenset([*self.terms, effect]), keys))
        return fit(self.scorer, models, own, self.settings.iterations, self.dt) if models else []

    def _judged(
        self, stage: int, fitted: list[Model], found: Sequence[Screened], train: np.ndarray, now: np.ndarray
    ) -> Model | None:
        """Test the fitted candidates on held-out windows, note the evidence, and return the one to accept."""
        settings = self.settings
        if not fitted:
            return None
        after = scores(self.scorer, [m.theta for m in fitted], self.splits.select, self.dt)
        gain = judge.gains(now, after)
        p = judge.max_t(gain, self.rng)
        sizes = [self._size(m) for m in fitted]
        share = [removed(excess(now), excess(a)) for a in after]
        fit_for_it = [
            k
            for k in range(len(fitted))
            if p[k] < settings.alpha and share[k] > settings.min_share and sizes[k] > 1.0 and gain[k].mean() > 0
        ]
        chosen, alias = None, np.zeros(len(fitted), dtype=bool)
        if fit_for_it:
            best = max(fit_for_it, key=lambda k: gain[k].mean())
            alias = judge.equals(gain, best, self.rng) & np.isin(np.arange(len(fitted)), fit_for_it)
            many = [len(m.keys) for m in fitted]
            simplest = min(many[k] for k in np.flatnonzero(alias))
            alias &= np.array(many) == simplest  # what says the same with more numbers is no rival
            chosen = int(max(np.flatnonzero(alias), key=lambda k: gain[k].mean()))
        names = tuple(fitted[k].name for k in sorted(np.flatnonzero(alias), key=lambda k: -gain[k].mean()))
        for k in np.argsort(-gain.mean(axis=1)):
            status, reason = self._reason(int(k), chosen, alias, p, share, sizes, gain, fitted)
            self.candidates.append(
                Candidate(
                    effect=fitted[k].name,
                    joints=self._joints(fitted[k]),
                    params=self._params(fitted[k]),
                    excess_after=excess(after[k]),
                    log_gain=float(gain[k].mean()),
                    p=float(p[k]),
                    size_over_tolerance=sizes[k],
                    alias_class=names if alias[k] else (fitted[k].name,),
                    status=status,  # type: ignore[arg-type]
                    reason=reason,
                    stage=stage,
                )
            )
        if chosen is None:
            return None
        accepted = fitted[chosen]
        self.aliases[accepted.name] = (accepted.name, *(n for n in names if n != accepted.name))
        every = np.concatenate([judge.gains(train, np.stack([m.chi2 for m in fitted if m.chi2 is not None])), gain], 1)
        self.shares[accepted.name] = self._bag(every, chosen, alias)
        return accepted

    def _bag(self, gain: np.ndarray, chosen: int, alias: np.ndarray) -> float:
        """Return the share of resampled windows in which the chosen candidate, or its equal, gains most."""
        episode = self.scorer.windows.episode[np.concatenate([self.splits.train, self.splits.select])]
        episode = np.repeat(episode, len(self.scorer.replayer.machine.groups))
        wins = 0
        for _ in range(self.settings.bags):
            picked = judge.resampled(episode, self.rng)
            mean = gain[:, picked].mean(axis=1)
            close = mean >= mean.max() - judge.SAME
            wins += bool(close[chosen] or close[alias].any())
        return wins / max(self.settings.bags, 1)

    def _reason(
        self,
        k: int,
        chosen: int | None,
        alias: np.ndarray,
        p: np.ndarray,
        share: Sequence[float],
        sizes: Sequence[float],
        gain: np.ndarray,
        fitted: Sequence[Model],
    ) -> tuple[str, str]:
        settings = self.settings
        if k == chosen:
            return "accepted", f"removes {share[k]:.1%} of the excess on held-out windows, p = {p[k]:.2g}"
        if chosen is not None and alias[k]:
            return "alias", f"does as well as {fitted[chosen].name}: these data cannot tell them apart"
        if sizes[k] <= 1.0:
            return "rejected", f"fits within its tolerance ({sizes[k]:.2g} of it)"
        if p[k] >= settings.alpha and share[k] > FEW and gain[k].mean() > 0:
            return "rejected", f"removes {share[k]:.1%} of the excess, but too few windows show it (p = {p[k]:.2g})"
        if p[k] >= settings.alpha or gain[k].mean() <= 0:
            return "rejected", f"no significant gain on held-out windows (p = {p[k]:.2g})"
        if share[k] <= settings.min_share:
            return "rejected", f"removes only {max(share[k], 0.0):.1%} of the excess on held-out windows"
        assert chosen is not None
        if gain[k].mean() >= gain[chosen].mean() - judge.SAME:
            return "rejected", f"does no better than {fitted[chosen].name}, which needs fewer numbers"
        return "rejected", f"explains less than {fitted[chosen].name} (excess falls by {share[k]:.1%})"

    def _size(self, model: Model) -> float:
        """Return the largest deviation of an effect from null in tolerances."""
        return max(float(np.max(_deviation(model.theta, key))) for key in box.sizes(model.name))

    def _joints(self, model: Model) -> tuple[str, ...]:
        joints = self.scorer.windows.joints
        beyond = np.zeros(len(joints), dtype=bool)
        for key in box.sizes(model.name):
            if box.param(key).per == "joint":
                beyond |= np.broadcast_to(_deviation(model.theta, key) > 1.0, len(joints))
        return tuple(j for j, b in zip(joints, beyond, strict=True) if b)

    def _params(self, model: Model) -> dict[str, list[float] | float]:
        named = np.isin(self.scorer.windows.joints, self._joints(model))
        found: dict[str, list[float] | float] = {}
        for key, value in model.theta.items():
            if key[0] == model.name:
                per_joint = box.param(key).per == "joint"
                full = np.broadcast_to(value, len(named)) if per_joint else value
                found[key[1]] = [float(v) for v in full[named]] if per_joint else float(full[0])
        return found

    def _eliminate(self, now: np.ndarray) -> None:
        """Drop terms without which the rest does as well."""
        for name in list(self.terms[:-1]):
            rest = replace(self, terms=[t for t in self.terms if t != name], theta=_without(self.theta, name))
            rest.settle(1)
            without = self.held_out(rest.theta)
            gain = judge.gains(without, now[None])
            needed = removed(excess(without), excess(now)) > self.settings.min_share
            if not needed or judge.max_t(gain, self.rng)[0] >= self.settings.alpha:
                self.terms, self.theta, now = rest.terms, rest.theta, without
                self.steps.append((f"without {name}", excess(now)))


def _deviation(theta: Theta, key: Key) -> np.ndarray:
    """Return how far a parameter is from null, in tolerances."""
    p = box.param(key)
    return np.asarray(np.abs(theta.get(key, np.array([p.null])) - p.null) / p.tolerance)


def _without(theta: Theta, name: str) -> Theta:
    """Return the values without a term; a part of the box goes back inside."""
    found = {}
    for key, value in theta.items():
        if key[0] == name:
            p = box.param(key)
            if name not in box.BOX or not math.isfinite(p.tolerance):
                continue
            value = value.clip(p.null - p.tolerance, p.null + p.tolerance)
        found[key] = value
    return found
