"""Fewer and simpler terms: what is not needed is dropped, replaced, or kept to fewer joints."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from go1exp.gap.score.robust import excess, removed
from go1exp.gap.search import evidence, significance, strain, tolerances
from go1exp.gap.search.ledger import Ledger

NEEDED = 12.0
"""Fall of chi2 that a joint must bring before it may leave the tolerance of a term's effect."""


def eliminate(search: Ledger) -> None:
    """Drop terms without which the rest does as well."""
    for name in [t for t in search.state.terms if t != search.single and len(search.state.terms) > 1]:
        rest = search.state.without(name).settled(1)
        without = rest.held_out()
        gain = significance.gains(without, search.select_chi2[None])
        needed = removed(excess(without), excess(search.select_chi2)) > search.settings.min_share
        search.returned[name] = removed(search.first, search.first + excess(search.select_chi2) - excess(without))
        if not needed or significance.max_t(gain, search.rng)[0] >= search.settings.alpha:
            search.state, search.select_chi2 = rest, without
            search.steps.append((f"without {name}", excess(without)))


def simplify(search: Ledger) -> None:
    """Replace terms by effects that explain as much with fewer numbers, where they do."""
    for name in search.state.terms:
        simpler = tolerances.identification(name).simpler
        if not simpler or simpler in search.state.terms:
            continue
        rest = search.state.without(name, simpler).settled(2)
        before, after = search.state.held_out(search.nominal), search.state.held_out()
        gain, less = significance.gains(before, np.stack([after, rest.held_out()])).mean(axis=1)
        large = evidence.size(simpler, rest.theta, rest.tolerances) > 1.0
        if less > gain - significance.same(gain) and large:
            search.state = rest
            search.aliases[simpler], search.shares[simpler] = (simpler,), search.shares[name]
            search.returned[simpler] = search.returned.get(name, math.nan)
            search.select_chi2 = search.state.held_out()
            search.steps.append((f"{simpler} in place of {name}", excess(search.select_chi2)))


def prune(search: Ledger) -> None:
    """Bring back within tolerance what leaves it at a joint for next to nothing."""
    cost, may, kept = strain.cost(search.state.scorer, search.state.table), search.state.may, search.state.kept
    for name in search.state.terms:
        theta, joints = search.state.theta, search.state.machine.joints
        out = np.flatnonzero(evidence.beyond(name, theta, joints, search.state.tolerances))
        without = {int(j): cost(replace(may, kept=kept | {(name, int(j))})) for j in out}
        for j in sorted(without, key=lambda j: without[j])[: len(out) - 1]:  # where it brings most, it stays
            candidate = kept | {(name, j)}
            if cost(replace(may, kept=candidate)) - cost(replace(may, kept=kept)) < NEEDED:
                kept = candidate
    if kept != search.state.kept:
        search.state = search.state.keeping(kept).settled(2)
        search.select_chi2 = search.state.held_out()
        search.steps.append(("at fewer joints", excess(search.select_chi2)))
