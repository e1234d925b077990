"""At which joints a term is: as few as explain it, chosen joint by joint, part by part, leg by leg, side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from go1exp.gap.score.linear import Layout, predicted
from go1exp.gap.score.robust import log_chi2
from go1exp.gap.search import evidence, significance, strain, thresholds, tolerances
from go1exp.gap.search.state import State


def parts(joints: Sequence[str]) -> list[frozenset[int]]:
    """Return the joints of each part, by their names: all hips (``FR_hip``), all thighs, all calves."""
    kinds = [name.split("_", 1)[-1] for name in joints]
    return [frozenset(k for k, kind in enumerate(kinds) if kind == part) for part in dict.fromkeys(kinds)]


def pieces(joints: Sequence[str]) -> list[frozenset[int]]:
    """Return sets of joints that an effect may be at, by their names (``FR_hip``): each one, part, leg, side, and all.

    A side is the legs that share a letter of their two: front, rear, right, left.
    """
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
    """The linear model of a settled state, on the windows of the fit and on those that no fit has seen."""

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
        return strain.price(self.matrix, self.right, self._solved(kept)[1])

    def held_out(self, kept: frozenset[tuple[str, int]]) -> np.ndarray:
        """Return log chi2 (V, G) on held-out windows, fitted on the others so."""
        held, size = self._held
        after = np.maximum(predicted(held, self.layout, self._solved(kept)[0]), 0.0)
        return log_chi2(after / size)


def chosen(linear: Linear, name: str, kept: frozenset[tuple[str, int]], rng: np.random.Generator) -> frozenset[int]:
    """Return the joints at which a term leaves its tolerance for a reason.

    Sets of joints are added as long as each joint pays for itself; then joints are taken away that bring too little, or
    that held-out windows do not miss.

    Args:
        linear: of the model with the term.
        name: of the term.
        kept: effects and joints that stay within tolerance already.
        rng: of the tests.
    """
    joints, known = linear.machine.joints, linear.may.tolerances
    outside = frozenset(int(j) for j in np.flatnonzero(evidence.beyond(name, linear.theta, joints, known)))
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

    About values that are spread over joints the linear model cannot tell what one of them would do alone: a thigh of
    0.74 of its mass was 0.83, with two hips of 1.8 and 1.4. Left out are sets that lose most of what the term brings.

    Args:
        linear: of the model with the term.
        name: of the term.
        kept: effects and joints that stay within tolerance already.
    """
    joints, known = linear.machine.joints, linear.may.tolerances
    outside = frozenset(int(j) for j in np.flatnonzero(evidence.beyond(name, linear.theta, joints, known)))
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
