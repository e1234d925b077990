"""Fewer and simpler terms: what is not needed is dropped, replaced, or kept to fewer joints."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.stats import norm

from go1exp.gap.replay.rows import Theta
from go1exp.gap.score.robust import excess, removed
from go1exp.gap.search import evidence, places, significance, thresholds, tolerances
from go1exp.gap.search.last_fit import bootstrapped
from go1exp.gap.search.ledger import Ledger
from go1exp.gap.search.state import State
from go1exp.sim.effects.tolerances import sizes


def eliminate(search: Ledger) -> None:
    """Drop terms without which the rest does as well."""
    for name in [t for t in search.state.terms if t != search.single and len(search.state.terms) > 1]:
        rest = search.state.without(name).settled(1)
        without = rest.held_out()
        gain = significance.gains(without, search.select_chi2[None])
        share = removed(excess(without), excess(search.select_chi2))
        search.returned[name] = removed(search.first, search.first + excess(search.select_chi2) - excess(without))
        p = significance.max_t(gain, search.rng, len(search.state.machine.groups))
        shown = significance.shown(p, np.array([share]), excess(without), search.settings)
        if not share > search.settings.min_share or not shown[0]:
            search.state, search.select_chi2 = rest, without
            search.steps.append((f"without {name}", excess(without)))


def simplify(search: Ledger) -> None:
    """Replace terms by effects that explain as much with fewer numbers, where they do."""
    for name in search.state.terms:
        simpler = tolerances.identification(name).simpler
        if not simpler or simpler in search.state.terms:
            continue
        if search.strained and simpler in search.aliases[name]:
            continue  # of so small a gap neither explains clearly more: both are named, as a set
        rest = instead_of(search.state, name).settled(2)
        before, after = search.state.held_out(search.nominal), search.state.held_out()
        gain, less = significance.gains(before, np.stack([after, rest.held_out()])).mean(axis=1)
        large = evidence.size(simpler, rest.theta, rest.tolerances) > 1.0
        joints, known = rest.machine.joints, rest.tolerances
        strains = evidence.bounded(simpler, rest.theta, joints, known).any()
        strained = evidence.bounded(name, search.state.theta, joints, known).any()
        # What would go beyond its bound is a worse name than what need not: a hip of twice its mass, for a load.
        if less > gain - significance.same(gain) and large and (strained or not strains):
            replaced(search, name, simpler, rest, still_equal(search, name, simpler, rest))


def prune(search: Ledger) -> None:
    """Bring back within tolerance what leaves it at a joint for too little (``gap/search/places.py``)."""
    linear, kept = places.Linear(search.state), search.state.kept
    for name in search.state.terms:
        theta, joints = search.state.theta, search.state.machine.joints
        outside = np.flatnonzero(evidence.beyond(name, theta, joints, search.state.tolerances))
        inside = places.chosen(linear, name, kept, search.rng)
        kept |= {(name, int(j)) for j in outside if j not in inside}
    if kept != search.state.kept:
        keep_within(search, kept)
    for name in search.state.terms:
        concentrate(search, name)


def concentrate(search: Ledger, name: str) -> None:
    """Keep a term to the fewest joints with which, all else fitted again, held-out windows are no worse."""
    linear, joints = places.Linear(search.state), search.state.machine.joints
    outside = np.flatnonzero(evidence.beyond(name, search.state.theta, joints, search.state.tolerances))
    for inside in places.fewer(linear, name, search.state.kept):
        others = frozenset((name, int(j)) for j in outside if j not in inside)
        sparse = search.state.keeping(search.state.kept | others).settled(3, rival=search.state)
        chi2 = sparse.held_out()
        loss = -significance.gains(search.select_chi2, chi2[None])
        worse = significance.max_t(loss, search.rng, len(search.state.machine.groups))[0]
        if loss.mean() < thresholds.SAME_GAIN and worse > thresholds.DOUBTFUL_P:
            search.state, search.select_chi2 = sparse, chi2
            search.steps.append(("at fewer joints", excess(chi2)))
            return


def keep_within(search: Ledger, kept: frozenset[tuple[str, int]]) -> bool:
    """Keep terms within tolerance at some joints, unless held-out windows miss that; return whether it was done.

    Args:
        search: whose state changes.
        kept: effects and joints, those that are kept already among them.
    """
    sparse = search.state.keeping(kept).settled(2)
    chi2 = sparse.held_out()
    if significance.gains(search.select_chi2, chi2[None]).mean() < -thresholds.SAME_GAIN:
        return False  # what looked small in the linear model was not
    search.state, search.select_chi2 = sparse, chi2
    search.steps.append(("at fewer joints", excess(chi2)))
    return True


def symmetrical(search: Ledger) -> None:
    """Replace a term by the simpler effect that it is if two parameters are equal, where their difference may be 0."""
    for name in search.state.terms:
        how = tolerances.identification(name)
        if not how.simpler_if_equal or how.simpler in search.state.terms:
            continue
        first, second = ((name, parameter) for parameter in how.simpler_if_equal)
        theta, joints = search.state.theta, search.state.machine.joints
        outside = evidence.beyond(name, theta, joints, search.state.tolerances)
        differences = np.stack([draw[first] - draw[second] for draw in resampled(search)])
        # 95 % for all joints together: of twelve intervals of 95 % one would often miss zero by chance.
        wide = norm.ppf(1.0 - 0.025 / max(int(outside.sum()), 1)) * differences.std(axis=0)
        if not np.all((np.abs(differences.mean(axis=0)) <= wide)[outside]):
            continue
        rest = instead_of(search.state, name).settled(2)
        if evidence.size(how.simpler, rest.theta, rest.tolerances) > 1.0:
            replaced(search, name, how.simpler, rest, still_equal(search, name, how.simpler, rest))


def still_equal(search: Ledger, name: str, instead: str, rest: State) -> tuple[str, ...]:
    """Return which equals of a term do as well as the one that is to take its place (``rest``, fitted).

    They were equals of the term, which says nothing of another: each is fitted in its place.
    """
    others = [n for n in search.aliases.get(name, ()) if n != instead and n not in search.state.terms]
    if not others:
        return ()
    fitted = [search.state.without(name, other).settled(2) for other in others]
    held_out = np.stack([rest.held_out(), *(state.held_out() for state in fitted)])
    equal = significance.equals(significance.gains(search.state.held_out(search.nominal), held_out), 0, search.rng)
    large = [evidence.size(n, s.theta, s.tolerances) > 1.0 for n, s in zip(others, fitted, strict=True)]
    return tuple(n for n, e, out in zip(others, equal[1:], large, strict=True) if e and out)


def instead_of(state: State, name: str) -> State:
    """Return the state with the simpler effect in the place of a term, not fitted.

    It begins half-way between two parameters of the term that are equal where it is that effect: friction that is the
    same both ways is far from the tolerance at which plain friction was left.
    """
    how = tolerances.identification(name)
    rest = state.without(name, how.simpler)
    if not how.simpler_if_equal:
        return rest
    one, other = (state.theta[name, parameter] for parameter in how.simpler_if_equal)
    return replace(rest, theta={**rest.theta, sizes(how.simpler)[0]: 0.5 * (one + other)})


def resampled(search: Ledger) -> list[Theta]:
    """Return values of the model by bootstraps of the windows of the fit, to first order."""
    state = search.state
    return list(
        bootstrapped(state, state.table, state.train_chi2, search.rng, thresholds.EQUALITY_DRAWS, nominal=False)
    )


def replaced(search: Ledger, name: str, instead: str, rest: State, equals: tuple[str, ...] = ()) -> None:
    """Put a fitted model with another term in the place of the present one; ``equals`` do as well as that."""
    search.state = rest
    search.aliases[instead], search.shares[instead] = (instead, *equals), search.shares[name]
    search.returned[instead] = search.returned.get(name, math.nan)
    search.select_chi2 = rest.held_out()
    search.steps.append((f"{instead} in place of {name}", excess(search.select_chi2)))


def unite(search: Ledger) -> None:
    """Replace several terms by one that does as well, if one does: a rival of the first that was set aside for it."""
    several = search.state.terms
    if len(several) < 2:
        return
    for model in search.rivals:
        if model.name in several:
            continue
        theta = {key: v for key, v in model.theta.items() if key[0] in (model.name, *search.state.loosened)}
        rest = replace(search.state, terms=(model.name,), kept=frozenset(), theta=theta).settled(4)
        chi2 = rest.held_out()
        before = search.state.held_out(search.nominal)
        gain, less = significance.gains(before, np.stack([search.select_chi2, chi2])).mean(axis=1)
        as_well = less > gain - significance.same(gain)
        as_well &= excess(chi2) <= excess(search.select_chi2) + thresholds.SAME_GAIN
        if as_well and evidence.size(model.name, rest.theta, rest.tolerances) > 1.0:
            search.reject(several, f"{model.name} alone does as well")
            replaced(search, several[0], model.name, rest)
            return
