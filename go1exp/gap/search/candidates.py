"""Fitted candidates on held-out windows: sizes, locations, which one is accepted, and why the others are not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.gap.replay.rows import Key, Machine, Theta
from go1exp.gap.result import Candidate, GapSettings
from go1exp.gap.score.likelihood import Scorer, excess, removed
from go1exp.gap.score.linear import Layout
from go1exp.gap.search import significance, thresholds, tolerances
from go1exp.gap.search.fit import Model, scores
from go1exp.sim.effects.tolerances import Tolerances, effect_class, sizes


def deviation(theta: Theta, key: Key, tolerances: Tolerances) -> np.ndarray:
    """Return how far a parameter is from null, in tolerances; 1 for a value that lies on its tolerance."""
    p = tolerances.param(key)
    away = np.asarray(np.abs(theta.get(key, np.array([p.null])) - p.null) / p.tolerance)
    return np.where(np.abs(away - 1.0) < thresholds.ROUNDING, 1.0, away)


def size(effect: str, theta: Theta, tolerances: Tolerances) -> float:
    """Return the largest deviation of an effect from null, in tolerances."""
    return max(float(np.max(deviation(theta, key, tolerances))) for key in sizes(effect))


def beyond(effect: str, theta: Theta, joints: Sequence[str], tolerances: Tolerances) -> np.ndarray:
    """Return at which joints (J,) an effect leaves its tolerance."""
    outside = np.zeros(len(joints), dtype=bool)
    for key in sizes(effect):
        if tolerances.param(key).per == "joint":
            outside |= np.broadcast_to(deviation(theta, key, tolerances) > 1.0, len(joints))
    return outside


def at_bounds(key: Key, theta: Theta, tolerances: Tolerances) -> dict[float, np.ndarray]:
    """Return by bound of a parameter which values (J,) or (1,) leave their tolerance and lie on that bound."""
    p = tolerances.param(key)
    values = np.ravel(theta.get(key, np.array([p.null])))
    beyond = np.abs(values - p.null) > p.tolerance
    return {b: beyond & (np.abs(values - b) <= thresholds.AT_BOUND * p.tolerance) for b in (p.low, p.high)}


def on_bound(key: Key, bound: float, at: str, tolerances: Tolerances) -> str:
    """Say that a parameter lies on its bound ``at`` these joints, a list in words; empty for one of the whole robot."""
    p = tolerances.param(key)
    unit = "" if p.unit == "-" else f" {p.unit}"
    return f"{p.name}{f' at {at}' if at else ''} lies on its bound, {bound:g}{unit}"


def bounded(effect: str, theta: Theta, joints: Sequence[str], tolerances: Tolerances) -> np.ndarray:
    """Return at which joints (J,) a value of an effect lies on its bound, beyond its tolerance."""
    each = [at for key in sizes(effect) for at in at_bounds(key, theta, tolerances).values()]
    return np.any([np.broadcast_to(at, len(joints)) for at in each], axis=0)


def count(effect: str, theta: Theta, machine: Machine) -> int:
    """Return how many values of an effect leave their tolerance, at least 1; one for all joints counts once."""
    beyond_it = 0
    for key in sizes(effect):
        outside = np.atleast_1d(deviation(theta, key, machine.tolerances) > 1.0)
        beyond_it += min(int(outside.sum()), 1) if effect_class(effect).identification.common else int(outside.sum())
    return max(beyond_it, 1)


def parameters(model: Model) -> int:
    """Return how many parameters a fitted model uses, at least 1: shapes, and those that leave their tolerance."""
    known = model.may.tolerances
    used = [key for key in model.keys if not math.isfinite(known.param(key).tolerance)]
    used += [key for key in sizes(model.name) if float(np.max(deviation(model.theta, key, known))) > 1.0]
    return max(len(used), 1)


def candidate(model: Model, joints: Sequence[str], **tested: object) -> Candidate:
    """Write a fitted model down; ``tested`` are the other fields of :class:`~go1exp.gap.result.Candidate`."""
    tolerances = model.may.tolerances
    where = beyond(model.name, model.theta, joints, tolerances)
    params: dict[str, list[float] | float] = {}
    for key, value in model.theta.items():
        if key[0] == model.name:
            per_joint = tolerances.param(key).per == "joint"
            full = np.broadcast_to(value, len(joints)) if per_joint else value
            params[key[1]] = [float(v) for v in full[where]] if per_joint else float(full[0])
    names = tuple(j for j, b in zip(joints, where, strict=True) if b)
    largest = size(model.name, model.theta, tolerances)
    return Candidate(effect=model.name, joints=names, params=params, size_over_tolerance=largest, **tested)  # type: ignore[arg-type]


def absorbed(
    search_keys: Sequence[Key], relief: Mapping[str, float], theta: Theta, tolerances: Tolerances, most: int
) -> list[Candidate]:
    """Return, for a gap that the tolerances close, the effects that would rather leave theirs, strongest first."""
    order = sorted((e for e in relief if relief[e] > thresholds.LISTED_RELIEF), key=lambda e: -relief[e])
    return [
        Candidate(
            effect=effect,
            joints=(),
            params={},
            excess_after=math.nan,
            log_gain=0.0,
            p=math.nan,
            size_over_tolerance=max(
                float(np.max(deviation(theta, k, tolerances))) for k in search_keys if k[0] == effect
            ),
            alias_class=(effect,),
            status="rejected",
            reason=f"fits within its tolerance; without it chi2 would be {relief[effect]:.0f} lower",
        )
        for effect in order[:most]
    ]


def unexcited_rows(unexcited: Sequence[str], tested: Sequence[str]) -> list[Candidate]:
    """Return rows for the effects that the data cannot show."""
    return [
        Candidate(
            effect, (), {}, math.nan, 0.0, 1.0, 0.0, (effect,), "not excited", "twice its tolerance would not show"
        )
        for effect in unexcited
        if effect not in tested
    ]


@dataclass(frozen=True)
class Trial:
    """Fitted candidates on held-out windows."""

    names: list[str]  # of the M candidates
    after: list[float]  # their excess
    gain: np.ndarray  # (M, V G) fall of log chi2
    p: np.ndarray  # (M,) of all together
    share: np.ndarray  # (M,) of the excess that is gone
    sizes: np.ndarray  # (M,) in tolerances
    needed: float  # share that one must remove
    shown: np.ndarray  # (M,) which are significant
    helps: np.ndarray  # (M,) which are, and remove enough
    alias: np.ndarray  # (M,) which do as well as the best of those that also leave their tolerances
    aside: np.ndarray  # (M,) which do as well too, with more numbers
    chosen: int | None  # the one of these to accept; None if there is none, or if one within its tolerance does as well

    @property
    def mean(self) -> np.ndarray:
        """(M,) mean gain."""
        return np.asarray(self.gain.mean(axis=1))

    def reason(self, k: int) -> tuple[str, str]:
        """Return what becomes of a candidate, and why."""
        share, p, chosen = self.share[k], self.p[k], self.chosen
        if k == chosen:
            if self.needed < 0.0:  # a small gap
                return "accepted", f"held-out log chi2 falls by {self.mean[k]:.2g}, p = {p:.2g}"
            return "accepted", f"removes {share:.1%} of the excess on held-out windows, p = {p:.2g}"
        if chosen is not None and self.alias[k]:
            return "alias", f"does as well as {self.names[chosen]}: not distinguishable with these data"
        if self.needed < 0.0 and 1.0 < self.sizes[k] <= thresholds.CLEARLY_BEYOND:
            return "rejected", f"leaves its tolerance by too little ({self.sizes[k]:.2g} of it) to be called missing"
        if self.sizes[k] <= 1.0:
            return "rejected", f"fits within its tolerance ({self.sizes[k]:.2g} of it)"
        if not self.shown[k] and share > thresholds.FEW_WINDOWS_SHARE and self.mean[k] > 0:
            return "rejected", f"removes {share:.1%} of the excess, but too few windows show it (p = {p:.2g})"
        if self.shown[k] and share > self.needed and self.mean[k] <= 0:
            return "rejected", f"removes {share:.1%} of the excess, but other windows lose as much in log chi2"
        if not self.shown[k] or self.mean[k] <= 0:
            return "rejected", f"no significant gain on held-out windows (p = {p:.2g})"
        if chosen is None and self.helps[k]:
            return "rejected", "another effect does as well within its tolerance"
        if share <= self.needed:
            return "rejected", f"removes only {max(share, 0.0):.1%} of the excess on held-out windows"
        assert chosen is not None
        if self.mean[k] >= self.mean[chosen] - significance.same(self.mean[chosen]):
            return "rejected", f"does no better than {self.names[chosen]}, which needs fewer numbers"
        return "rejected", f"explains less than {self.names[chosen]} (excess falls by {share:.1%})"


def tried(
    scorer: Scorer,
    settings: GapSettings,
    fitted: Sequence[Model],
    train: np.ndarray,
    now: np.ndarray,
    windows: np.ndarray,
    dt: float,
    rng: np.random.Generator,
    small: bool = False,
) -> Trial:
    """Compare fitted candidates with the present model on ``windows`` that no fit has seen.

    The present model's chi2 is ``now`` (V, G) there, and ``train`` (T, G) on the windows of the fit. Where the gap is
    ``small``, within the tolerances, which share of it a candidate removes means nothing.
    """
    chi2 = scores(scorer, [m.theta for m in fitted], windows, dt)
    gain = significance.gains(now, chi2)
    groups = len(scorer.replayer.machine.groups)
    p = significance.max_t(gain, rng, groups) if settings.selection == "max_t" else np.zeros(len(fitted))
    if settings.selection == "bic":
        p = (_bic(scorer, fitted, train) >= 0).astype(float)
    before, after = excess(now), [excess(one) for one in chi2]
    share = np.array([removed(before, a) for a in after])
    needed = settings.min_share if before > settings.adequate else max(thresholds.MOST_OF_SMALL, settings.min_share)
    needed = -math.inf if small else needed
    sizes = np.array([size(m.name, m.theta, m.may.tolerances) for m in fitted])
    shown = significance.shown(p, share, 0.0 if small else before, settings)
    helps = shown & (share > needed) & (gain.mean(axis=1) > 0)
    outside = helps & (sizes > (thresholds.CLEARLY_BEYOND if small else 1.0))
    machine = scorer.replayer.machine
    numbers = np.array([(count(m.name, m.theta, machine), parameters(m)) for m in fitted], dtype=float)
    names, within = [m.name for m in fitted], tolerances.nominal(machine)
    unclear = [small and a not in within and any(tolerances.confounded(a, b) for b in names) for a in names]
    chosen, alias, aside = _choice(gain, outside, helps & (sizes <= 1.0), numbers, np.array(unclear), rng)
    return Trial(names, after, gain, p, share, sizes, needed, shown, helps, alias, aside, chosen)


def _choice(
    gain: np.ndarray,
    outside: np.ndarray,
    inside: np.ndarray,
    numbers: np.ndarray,
    unclear: np.ndarray,
    rng: np.random.Generator,
) -> tuple[int | None, np.ndarray, np.ndarray]:
    """Return the candidate to accept (or None), which do as well (M,), and which do so with more numbers (M,).

    Args:
        gain: (M, V G) fall of log chi2 of each candidate.
        outside: (M,) which help and leave their tolerances.
        inside: (M,) which help within their tolerances.
        numbers: (M, 2) how many values of each leave their tolerance, and how many parameters it uses.
        unclear: (M,) which are easily taken for another where the gap is so small that what means the same (``SAME``)
            is much of it: more numbers do not set them aside; which has fewer decides what comes first.
        rng: of the tests.
    """
    none = np.zeros(len(gain), dtype=bool)
    if not outside.any():
        return None, none, none
    mean = np.asarray(gain.mean(axis=1))
    best = int(max(np.flatnonzero(outside), key=lambda k: mean[k]))
    alias = significance.equals(gain, best, rng) & outside
    # What explains the same with more numbers is no rival: a tilt is two, the offsets that imitate it are twelve.
    equal = alias & (mean >= mean[best] - significance.same(mean[best]))
    clear = alias & ~unclear
    many = clear & equal & (numbers[:, 0] >= thresholds.MANY_TIMES * numbers[clear & equal, 0].min(initial=math.inf))
    rest = clear & ~many
    aside = many | (rest & (numbers[:, 1] > numbers[rest, 1].min(initial=math.inf)))
    alias &= ~aside
    # Of those that mean the same the one with the fewest values comes first: four lighter links imitate one rotor.
    same = alias if (alias & unclear).any() else equal
    order = sorted(
        np.flatnonzero(alias).tolist(), key=lambda k: (0, *numbers[k], -mean[k]) if same[k] else (1, 0, 0, -mean[k])
    )
    chosen = int(order[0])
    if inside.any() and mean[inside].max() >= mean[chosen] - significance.same(mean[chosen]):
        return None, none, aside  # a tolerance does as well: nothing must leave its tolerance
    return chosen, alias, aside


def _bic(scorer: Scorer, fitted: Sequence[Model], train: np.ndarray) -> np.ndarray:
    """Return by how much Schwarz's criterion grows (M,) with each candidate; its errors are independent, as usual."""
    machine = scorer.replayer.machine
    values = train.size * float(scorer.size.mean())
    growth = []
    for model in fitted:
        assert model.chi2 is not None
        unknowns = Layout.from_probes(machine, tolerances.probes(machine, model.keys, model.theta)).size
        growth.append(values * np.log(model.chi2.mean() / train.mean()) + unknowns * np.log(values))
    return np.array(growth)
