"""Fewer and simpler terms, at the fewest joints that explain them: by joint, part, leg and side."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.stats import norm

from go1exp.gap.replay.rows import Theta
from go1exp.gap.score.likelihood import excess, log_chi2, removed
from go1exp.gap.score.linear import Layout, predicted
from go1exp.gap.search import candidates, significance, thresholds, tolerances
from go1exp.gap.search.certainty import bootstrapped
from go1exp.gap.search.state import Search, State
from go1exp.sim.effects.tolerances import sizes


def parts(joints: Sequence[str]) -> list[frozenset[int]]:
    """Return the joints of each part, by their names: all hips (``FR_hip``), all thighs, all calves."""
    kinds = [name.split("_", 1)[-1] for name in joints]
    return [frozenset(k for k, kind in enumerate(kinds) if kind == part) for part in dict.fromkeys(kinds)]


def pieces(joints: Sequence[str]) -> list[frozenset[int]]:
    """Return sets of joints that an effect may be at, by names such as ``FR_hip``: each, part, leg, side, all."""
    names = [name.split("_", 1) if "_" in name else [name, ""] for name in joints]
    legs = list(dict.fromkeys(leg for leg, _ in names))
    sets = [*(frozenset([k]) for k in range(len(joints))), *parts(joints)]
    sets += [frozenset(k for k, name in enumerate(names) if name[0] == leg) for leg in legs]
    if len(legs) == 4 and all(len(leg) == 2 for leg in legs):
        for letter in (0, 1):
            values = dict.fromkeys(leg[letter] for leg in legs)
            sets += [frozenset(k for k, (leg, _) in enumerate(names) if leg[letter] == value) for value in values]
    return list(dict.fromkeys([*sets, frozenset(range(len(joints)))]))


class Linear:
    """The linear model of a converged state, on the windows of the fit and on those that no fit has seen."""

    def __init__(self, state: State) -> None:
        """Take it as it is known on the windows of the fit; on held-out ones it is measured where it is asked for."""
        scorer, self.train, self.may = state.scorer, state.table, state.may
        self.machine, self.theta = state.machine, state.theta
        self.layout = Layout.from_probes(self.machine, self.train.probes)
        chi2 = scorer.chi2(self.train.residual, self.train.windows)
        grams = self.train.grams(scorer) / np.maximum(chi2, 1.0)[..., None, None]
        self.matrix, self.right = self.layout.total(grams)
        self._state = state

    @cached_property
    def _held(self) -> tuple[np.ndarray, np.ndarray]:
        """Gram matrices and sizes of held-out windows: measured when first asked for, which is seldom."""
        state = self._state
        held = state.linear(state.theta, state.splits.select)
        return held.grams(state.scorer), state.scorer.size[held.windows][:, None]

    def _solved(self, kept: frozenset[tuple[str, int]]) -> tuple[np.ndarray, tolerances.Bounds]:
        may = replace(self.may, kept=kept)
        limits = tolerances.bounds(self.layout, self.train.probes, self.train.theta, may, back=True)
        return tolerances.solve(self.matrix, self.right, limits), limits

    def price(self, kept: frozenset[tuple[str, int]]) -> float:
        """Return how small chi2 and priors can be on the windows of the fit if effects stay in tolerance at joints."""
        return tolerances.price(self.matrix, self.right, self._solved(kept)[1])

    def held_out(self, kept: frozenset[tuple[str, int]]) -> np.ndarray:
        """Return log chi2 (V, G) on held-out windows, fitted on the others so."""
        held, size = self._held
        after = np.maximum(predicted(held, self.layout, self._solved(kept)[0]), 0.0)
        return log_chi2(after / size)


def chosen(linear: Linear, name: str, kept: frozenset[tuple[str, int]], rng: np.random.Generator) -> frozenset[int]:
    """Return the joints at which a term leaves its tolerance for a reason.

    Sets of joints are added as long as each joint gains more than ``JOINT_GAIN``. Then joints are taken away that bring
    too little, or that held-out windows do not miss.
    """
    joints, known = linear.machine.joints, linear.may.tolerances
    outside = frozenset(int(j) for j in np.flatnonzero(candidates.beyond(name, linear.theta, joints, known)))
    if len(outside) < 2 or tolerances.identification(name).common:  # what shares a value is where it was found
        return outside
    prices: dict[frozenset[int], float] = {}

    def without(inside: frozenset[int]) -> frozenset[tuple[str, int]]:
        return kept | {(name, j) for j in outside - inside}

    def price(inside: frozenset[int]) -> float:
        if inside not in prices:
            prices[inside] = linear.price(without(inside))
        return prices[inside]

    sets = [piece & outside for piece in pieces(joints) if piece & outside]
    inside = frozenset[int]()
    while inside != outside:
        larger = min(
            (inside | piece for piece in sets),
            key=lambda joints_of: price(joints_of) + thresholds.JOINT_GAIN * len(joints_of),
        )
        if price(larger) + thresholds.JOINT_GAIN * len(larger) >= price(inside) + thresholds.JOINT_GAIN * len(inside):
            break
        inside = larger
    brings = {j: price(inside - {j}) - price(inside) for j in inside}
    for j in sorted(brings, key=lambda j: brings[j]):
        relief = price(inside - {j}) - price(inside)
        if len(inside) > 1 and (
            relief < thresholds.JOINT_GAIN or _unmissed(linear, j, relief, brings, without, inside, rng)
        ):
            inside -= {j}
    return inside or frozenset([max(outside, key=lambda j: price(outside - {j}))])


def fewer(linear: Linear, name: str, kept: frozenset[tuple[str, int]]) -> list[frozenset[int]]:
    """Return smaller sets of joints that a term might be at alone, to be fitted: the fewest joints first.

    About values that are spread over joints the linear model does not predict what one of them would do alone. Sets
    that lose most of the term's gain are left out.
    """
    joints, known = linear.machine.joints, linear.may.tolerances
    outside = frozenset(int(j) for j in np.flatnonzero(candidates.beyond(name, linear.theta, joints, known)))
    if len(outside) < 2 or tolerances.identification(name).common:
        return []

    def price(inside: frozenset[int]) -> float:
        return linear.price(kept | {(name, j) for j in outside - inside})

    least, most = price(outside), price(frozenset())
    smaller = {piece & outside for piece in pieces(joints)} - {outside, frozenset()}
    left = {piece: (price(piece) - least) / max(most - least, 1e-9) for piece in smaller}
    best: dict[int, frozenset[int]] = {}
    for piece in sorted((p for p in left if left[p] < thresholds.LOST_SHARE), key=lambda p: left[p]):
        best.setdefault(len(piece), piece)
    return [best[size] for size in sorted(best)]


def _unmissed(
    linear: Linear,
    joint: int,
    relief: float,
    brings: Mapping[int, float],
    without: Callable[[frozenset[int]], frozenset[tuple[str, int]]],
    inside: frozenset[int],
    rng: np.random.Generator,
) -> bool:
    """Return whether held-out windows do as well without a joint that brings little beside the others."""
    if relief >= thresholds.PLAIN_SHARE * max(brings.values()):
        return False
    group = next(g for g, members in enumerate(linear.machine.groups) if joint in members)
    gain = linear.held_out(without(inside - {joint})) - linear.held_out(without(inside))
    return bool(
        gain[:, group].mean() <= 0.0 or significance.max_t(gain[None, :, group], rng)[0] > thresholds.DOUBTFUL_P
    )


def reduced(search: Search) -> Search:
    """Return the search with fewer and simpler terms, at fewer joints, where held-out windows are no worse."""
    for step in (eliminate, unite, simplify, prune, symmetrical):
        search = step(search)
    return search


def eliminate(search: Search) -> Search:
    """Return the search without the terms without which the rest does as well."""
    for name in [t for t in search.state.terms if t != search.single and len(search.state.terms) > 1]:
        rest = search.state.without(name).converged(1)
        without = rest.held_out()
        gain = significance.gains(without, search.select_chi2[None])
        share = removed(excess(without), excess(search.select_chi2))
        back = removed(search.first, search.first + excess(search.select_chi2) - excess(without))
        search = replace(search, returned={**search.returned, name: back})
        p = significance.max_t(gain, search.rng, len(search.state.machine.groups))
        shown = significance.shown(p, np.array([share]), excess(without), search.settings)
        if not share > search.settings.min_share or not shown[0]:
            search = search.with_model(rest, without, f"without {name}")
    return search


def simplify(search: Search) -> Search:
    """Return the search with terms replaced by effects that explain as much with fewer numbers, where they do."""
    for name in search.state.terms:
        simpler = tolerances.identification(name).simpler
        if not simpler or simpler in search.state.terms:
            continue
        if search.marginal and simpler in search.aliases[name]:
            continue  # of so small a gap neither explains clearly more: both are named, as a set
        rest = instead_of(search.state, name).converged(2)
        before, after = search.state.held_out(search.nominal), search.state.held_out()
        gain, less = significance.gains(before, np.stack([after, rest.held_out()])).mean(axis=1)
        large = candidates.size(simpler, rest.theta, rest.tolerances) > 1.0
        joints, known = rest.machine.joints, rest.tolerances
        at_bound = candidates.bounded(simpler, rest.theta, joints, known).any()
        was_at_bound = candidates.bounded(name, search.state.theta, joints, known).any()
        # What would go beyond its bound is a worse name than what need not: a hip of twice its mass, for a load.
        if less > gain - significance.same(gain) and large and (was_at_bound or not at_bound):
            search = replaced(search, name, simpler, rest, still_equal(search, name, simpler, rest))
    return search


def prune(search: Search) -> Search:
    """Return the search with terms within tolerance at the joints where they bring too little."""
    linear, kept = Linear(search.state), search.state.kept
    for name in search.state.terms:
        theta, joints = search.state.theta, search.state.machine.joints
        outside = np.flatnonzero(candidates.beyond(name, theta, joints, search.state.tolerances))
        inside = chosen(linear, name, kept, search.rng)
        kept |= {(name, int(j)) for j in outside if j not in inside}
    if kept != search.state.kept:
        search = keep_within(search, kept) or search
    for name in search.state.terms:
        search = concentrate(search, name)
    return search


def concentrate(search: Search, name: str) -> Search:
    """Return the search with a term at the fewest joints, if held-out windows are no worse with all else refitted."""
    linear, joints = Linear(search.state), search.state.machine.joints
    outside = np.flatnonzero(candidates.beyond(name, search.state.theta, joints, search.state.tolerances))
    for inside in fewer(linear, name, search.state.kept):
        others = frozenset((name, int(j)) for j in outside if j not in inside)
        sparse = search.state.keeping(search.state.kept | others).converged(3, rival=search.state)
        chi2 = sparse.held_out()
        loss = -significance.gains(search.select_chi2, chi2[None])
        worse = significance.max_t(loss, search.rng, len(search.state.machine.groups))[0]
        if loss.mean() < thresholds.SAME_GAIN and worse > thresholds.DOUBTFUL_P:
            return search.with_model(sparse, chi2, "at fewer joints")
    return search


def keep_within(search: Search, kept: frozenset[tuple[str, int]]) -> Search | None:
    """Return the search with terms within tolerance at some joints; None if held-out windows miss them there."""
    sparse = search.state.keeping(kept).converged(2)
    chi2 = sparse.held_out()
    if significance.gains(search.select_chi2, chi2[None]).mean() < -thresholds.SAME_GAIN:
        return None  # what looked small in the linear model was not
    return search.with_model(sparse, chi2, "at fewer joints")


def symmetrical(search: Search) -> Search:
    """Return the search with the simpler effect for a term of which two parameters may be equal."""
    for name in search.state.terms:
        how = tolerances.identification(name)
        if not how.simpler_if_equal or how.simpler in search.state.terms:
            continue
        first, second = ((name, parameter) for parameter in how.simpler_if_equal)
        theta, joints = search.state.theta, search.state.machine.joints
        outside = candidates.beyond(name, theta, joints, search.state.tolerances)
        differences = np.stack([draw[first] - draw[second] for draw in resampled(search)])
        # 95 % for all joints together: of twelve intervals of 95 % one would often miss zero by chance.
        wide = norm.ppf(1.0 - 0.025 / max(int(outside.sum()), 1)) * differences.std(axis=0)
        if not np.all((np.abs(differences.mean(axis=0)) <= wide)[outside]):
            continue
        rest = instead_of(search.state, name).converged(2)
        if candidates.size(how.simpler, rest.theta, rest.tolerances) > 1.0:
            search = replaced(search, name, how.simpler, rest, still_equal(search, name, how.simpler, rest))
    return search


def still_equal(search: Search, name: str, instead: str, rest: State) -> tuple[str, ...]:
    """Return which equals of a term, fitted in its place, do as well as the one that is to take it (``rest``)."""
    others = [n for n in search.aliases.get(name, ()) if n != instead and n not in search.state.terms]
    if not others:
        return ()
    fitted = [search.state.without(name, other).converged(2) for other in others]
    held_out = np.stack([rest.held_out(), *(state.held_out() for state in fitted)])
    equal = significance.equals(significance.gains(search.state.held_out(search.nominal), held_out), 0, search.rng)
    large = [candidates.size(n, s.theta, s.tolerances) > 1.0 for n, s in zip(others, fitted, strict=True)]
    return tuple(n for n, e, out in zip(others, equal[1:], large, strict=True) if e and out)


def instead_of(state: State, name: str) -> State:
    """Return the state with the simpler effect for a term, not fitted: half-way between two parameters of the term."""
    how = tolerances.identification(name)
    rest = state.without(name, how.simpler)
    if not how.simpler_if_equal:
        return rest
    one, other = (state.theta[name, parameter] for parameter in how.simpler_if_equal)
    return replace(rest, theta={**rest.theta, sizes(how.simpler)[0]: 0.5 * (one + other)})


def resampled(search: Search) -> list[Theta]:
    """Return values of the model by bootstraps of the windows of the fit, to first order."""
    state, draws = search.state, thresholds.EQUALITY_DRAWS
    return list(bootstrapped(state, state.table, state.train_chi2, search.rng, draws, nominal=False))


def replaced(search: Search, name: str, instead: str, rest: State, equals: tuple[str, ...] = ()) -> Search:
    """Return the search with a fitted model that has another term in the place of one; ``equals`` do as well."""
    search = replace(
        search,
        aliases={**search.aliases, instead: (instead, *equals)},
        shares={**search.shares, instead: search.shares[name]},
        returned={**search.returned, instead: search.returned.get(name, math.nan)},
    )
    return search.with_model(rest, rest.held_out(), f"{instead} in place of {name}")


def unite(search: Search) -> Search:
    """Return the search with one term for several, if one does as well: a rival of the first."""
    several = search.state.terms
    if len(several) < 2:
        return search
    for model in search.rivals:
        if model.name in several:
            continue
        theta = {key: v for key, v in model.theta.items() if key[0] in (model.name, *search.state.relaxed)}
        rest = replace(search.state, terms=(model.name,), kept=frozenset(), theta=theta).converged(4)
        chi2 = rest.held_out()
        before = search.state.held_out(search.nominal)
        gain, less = significance.gains(before, np.stack([search.select_chi2, chi2])).mean(axis=1)
        as_well = less > gain - significance.same(gain)
        as_well &= excess(chi2) <= excess(search.select_chi2) + thresholds.SAME_GAIN
        if as_well and candidates.size(model.name, rest.theta, rest.tolerances) > 1.0:
            return replaced(search.rejected(several, f"{model.name} alone does as well"), several[0], model.name, rest)
    return search
