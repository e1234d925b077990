"""How hard the tolerances are leant on: what would be gained if the model might leave them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import numpy as np

from go1exp.gap.score.likelihood import Scorer
from go1exp.gap.score.linear import Layout, Table
from go1exp.gap.search import thresholds, tolerances


def values(scorer: Scorer, linear: Table) -> float:
    """Return how many values are compared in the windows of ``own``."""
    return float(scorer.size[linear.windows].sum()) * len(scorer.replayer.machine.groups)


def cost(scorer: Scorer, linear: Table) -> Callable[[tolerances.Freedom], float]:
    """Return a function that says how small chi2 and priors can be, to first order about ``own``, with some freedom."""
    layout = Layout.from_probes(scorer.replayer.machine, linear.probes)
    chi2 = scorer.chi2(linear.residual, linear.windows)
    matrix, right = layout.total(linear.grams(scorer) / np.maximum(chi2, 1.0)[..., None, None])

    def smallest(may: tolerances.Freedom) -> float:
        limits = tolerances.bounds(layout, linear.probes, linear.theta, may, back=True)
        return price(matrix, right, limits)

    return smallest


def price(matrix: np.ndarray, right: np.ndarray, limits: tolerances.Bounds) -> float:
    """Return the bounded minimum that :func:`go1exp.gap.search.tolerances.solve` reaches."""
    x = tolerances.solve(matrix, right, limits)
    return float(x @ matrix @ x - 2.0 * right @ x + (limits.weight * (x - limits.centre) ** 2).sum())


def relief(scorer: Scorer, linear: Table, may: tolerances.Freedom) -> dict[str, float]:
    """Return by how much chi2 and priors would fall if an effect might leave its tolerance."""
    effects = dict.fromkeys(p.key[0] for p in linear.probes)
    smallest = cost(scorer, linear)
    return {effect: smallest(may) - smallest(may.also(effect)) for effect in effects}


def straining(relieved: Mapping[str, float], count: float, but: Collection[str]) -> list[str]:
    """Return the effects that would leave their tolerance if they might, the one that gains most first.

    Args:
        relieved: what :func:`relief` found.
        count: of values that were compared.
        but: effects that are out of the question.
    """
    order = sorted((e for e in relieved if e not in but), key=lambda e: -relieved[e])
    return [
        e
        for e in order[: thresholds.MOST_ACTIVE_BOUNDS]
        if relieved[e] > max(thresholds.ACTIVE_BOUND * count, relieved[order[0]] / thresholds.RIVAL_RATIO)
    ]
