"""Fewer and simpler terms (``go1exp/gap/search/reduction.py``), on models whose error is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import Candidate
from go1exp.gap.search import reduction, tolerances
from go1exp.gap.search.state import Search
from go1exp.robot import JOINTS
from go1exp.sim.effects.tolerances import DECLARED

NONE: Theta = {}


@dataclass(frozen=True)
class Known:
    """A model whose held-out chi2 is a function of its terms."""

    chi2: Callable[[tuple[str, ...]], float]
    terms: tuple[str, ...]
    theta: Theta
    relaxed: tuple[str, ...] = ()
    worse: Callable[[frozenset[tuple[str, int]]], np.ndarray] | None = None
    kept: frozenset[tuple[str, int]] = frozenset()
    machine: Any = field(
        default_factory=lambda: SimpleNamespace(joints=JOINTS, tolerances=DECLARED, groups=(0, 1, 2, 3))
    )
    tolerances: Any = DECLARED

    def converged(self, rounds: int, rival: Known | None = None) -> Known:
        return self

    def without(self, term: str, instead: str = "") -> Known:
        bound = 0.5 * (self.theta[term, "forward"] + self.theta[term, "backward"])
        names = tuple(filter(None, (instead if name == term else name for name in self.terms)))
        theta = {**tolerances.without(self.theta, term, DECLARED), ("coulomb", "bound"): bound}
        return Known(self.chi2, names, theta)

    def keeping(self, kept: frozenset[tuple[str, int]]) -> Known:
        return replace(self, kept=kept)

    def held_out(self, theta: Theta | None = None) -> np.ndarray:
        if self.worse is not None:
            return self.worse(self.kept)
        return np.full((30, 4), 100.0 if theta is NONE else self.chi2(self.terms))


def search(state: Any, *rivals: Any) -> Search:
    evidence = tuple(Candidate(name, (), {}, 0.0, 1.0, 0.01, 2.0, (name,), "accepted", "") for name in state.terms)
    return Search(
        state,
        np.random.default_rng(0),
        lambda what, share: None,
        select_chi2=state.held_out(),
        nominal=NONE,
        aliases={name: (name,) for name in state.terms},
        shares=dict.fromkeys(state.terms, 1.0),
        candidates=evidence,
        rivals=rivals,
    )


@pytest.mark.parametrize(("difference", "name"), [(0.03, "coulomb"), (0.30, "asymmetric_friction")])
def test_friction_that_is_equal_both_ways_is_dry_friction(
    difference: float, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The difference is known to 0.05 N m; where it may be zero the simpler name wins, though it fits worse."""
    forward, backward = np.full(12, 0.4 + difference), np.full(12, 0.4)
    theta = {("asymmetric_friction", "forward"): forward, ("asymmetric_friction", "backward"): backward}
    rng = np.random.default_rng(0)

    def draws(_: Any) -> list[Theta]:
        noise = 0.05 * rng.standard_normal((40, 12))
        return [{**theta, ("asymmetric_friction", "forward"): forward + n} for n in noise]

    monkeypatch.setattr(reduction, "resampled", draws)
    asked = search(Known(lambda terms: 1.0 if "asymmetric_friction" in terms else 1.2, ("asymmetric_friction",), theta))
    asked = reduction.symmetrical(asked)
    assert asked.state.terms == (name,)
    assert (name == "coulomb") == bool(asked.steps)


@pytest.mark.parametrize(
    ("marginal", "alias", "name"),
    [
        (False, (), "coulomb"),
        (True, (), "coulomb"),
        (False, ("coulomb",), "coulomb"),
        (True, ("coulomb",), "asymmetric_friction"),
    ],
)
def test_a_simpler_effect_that_is_named_in_the_set_of_a_small_gap_takes_no_place(
    marginal: bool, alias: tuple[str, ...], name: str
) -> None:
    friction = {("asymmetric_friction", way): np.full(12, 0.4) for way in ("forward", "backward")}
    asked = search(Known(lambda terms: 1.0, ("asymmetric_friction",), friction))
    aliases = {"asymmetric_friction": ("asymmetric_friction", *alias)}
    asked = replace(asked, marginal=marginal, aliases=aliases)
    asked = reduction.simplify(asked)
    assert asked.state.terms == (name,)


@pytest.mark.parametrize(
    ("both_ways", "name"),
    [((3.5, 2.5), "asymmetric_friction"), ((3.2, 2.4), "coulomb"), ((4.0, 2.0), "coulomb")],
    ids=["only the simpler one is at its bound", "neither is", "both are"],
)
def test_a_simpler_effect_at_its_bound_takes_no_place_of_one_that_is_at_none(
    both_ways: tuple[float, float], name: str
) -> None:
    """The simpler one is half-way between two parameters that lie beyond their bounds, of 3 and of 2 N m."""
    highs = [DECLARED.param(key).high for key in (("coulomb", "bound"), ("asymmetric_friction", "forward"))]
    assert highs == [3.0, 2.0]
    values = dict(zip(("forward", "backward"), both_ways, strict=True))
    theta = {("asymmetric_friction", way): np.full(12, value) for way, value in values.items()}
    asked = search(Known(lambda terms: 1.0, ("asymmetric_friction",), theta))
    asked = reduction.simplify(asked)
    assert asked.state.terms == (name,)


@pytest.mark.parametrize(("alone", "names"), [(1.01, ("payload",)), (2.0, ("strength", "link_mass"))])
def test_one_cause_takes_the_place_of_two_if_it_does_as_well(alone: float, names: tuple[str, ...]) -> None:
    two = Known(lambda terms: alone if terms == ("payload",) else 1.0, ("strength", "link_mass"), {})
    rival = SimpleNamespace(name="payload", theta={("payload", "mass"): np.array([2.0])})
    asked = search(two, rival)
    asked = reduction.unite(asked)
    assert asked.state.terms == names
    assert {c.status for c in asked.candidates} == {"rejected" if names == ("payload",) else "accepted"}


@pytest.mark.parametrize(("loss", "joints"), [(0.0, {5}), (0.01, {3, 4, 5}), (0.2, {3, 4, 5})])
def test_a_term_is_kept_to_the_fewest_joints_that_held_out_windows_allow(
    loss: float, joints: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the leg's other joints its windows lose ``loss`` in log chi2, of which 0.01 is little but certain."""
    noise = 0.02 * np.random.default_rng(1).standard_normal((30, 4))

    def worse(kept: frozenset[tuple[str, int]]) -> np.ndarray:
        left = {5} <= set(range(12)) - {j for _, j in kept}
        missed = loss * np.eye(4)[1] if kept else np.zeros(4)
        return np.exp(missed + (noise if kept else 0.0)) * (1.5 if left else 9.0)

    theta = {("link_mass", "scale"): np.where(np.isin(np.arange(12), (3, 4, 5)), 1.6, 1.0)}
    monkeypatch.setattr(reduction, "Linear", lambda state: state)
    monkeypatch.setattr(reduction, "fewer", lambda linear, name, kept: [frozenset({3}), frozenset({5})])
    asked = search(Known(lambda terms: 1.0, ("link_mass",), theta, worse=worse))
    asked = reduction.concentrate(asked, "link_mass")
    assert {3, 4, 5} - {j for _, j in asked.state.kept} == joints
    assert bool(asked.steps) == (joints == {5})
