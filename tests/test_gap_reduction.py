"""Fewer and simpler terms, at which joints, under which name: on models whose error is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import Candidate, GapSettings
from go1exp.gap.score.likelihood import removed
from go1exp.gap.score.linear import Layout
from go1exp.gap.search import candidates, reduction, stepwise, thresholds, tolerances
from go1exp.gap.search.candidates import Trial, _choice
from go1exp.gap.search.fit import Model
from go1exp.gap.search.screen import Motion, Screened, Variant, library, rivals
from go1exp.gap.search.state import Search
from go1exp.gap.search.tolerances import Freedom
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


@pytest.mark.parametrize(("difference", "name"), [(0.03, "coulomb"), (0.10, "coulomb"), (0.30, "asymmetric_friction")])
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


# ---------------------------------------------------------------------- which joints


LEGS = tuple(tuple(range(3 * leg, 3 * leg + 3)) for leg in range(4))
MACHINE: Any = SimpleNamespace(
    joints=JOINTS, groups=LEGS, base_probe=(), on_ground=False, tolerances=DECLARED, effort=(23.7, 23.7, 35.55) * 4
)


@dataclass
class Quadratic:
    """A linear model whose chi2 is known: every joint that is kept within its tolerance costs ``cost`` (12,)."""

    theta: Theta
    cost: np.ndarray
    gain: np.ndarray
    may: Freedom = field(default_factory=lambda: Freedom(DECLARED))
    machine: Any = field(default_factory=lambda: MACHINE)

    def price(self, kept: frozenset[tuple[str, int]]) -> float:
        return float(sum(self.cost[j] for _, j in kept))

    def held_out(self, kept: frozenset[tuple[str, int]]) -> np.ndarray:
        worse = np.zeros((40, 4))
        for _, j in kept:
            worse[:, j // 3] += self.gain[j] + 0.05 * np.random.default_rng(j).standard_normal(40)
        return worse


def at(cost: np.ndarray, gain: np.ndarray | None = None) -> set[str]:
    theta = {("link_mass", "scale"): np.full(12, 1.6)}
    linear: Any = Quadratic(theta, cost, 0.01 * cost if gain is None else gain)
    inside = reduction.chosen(linear, "link_mass", frozenset(), np.random.default_rng(0))
    return {JOINTS[j] for j in inside}


@pytest.mark.parametrize(
    ("cost", "joints"),
    [
        (np.where(np.arange(12) == 5, 900.0, 4.0), {JOINTS[5]}),
        (np.full(12, 300.0), {*JOINTS}),
        (np.tile([3.0, 3.0, 250.0], 4), {j for j in JOINTS if j.endswith("calf")}),
    ],
    ids=["one loaded link though all were free", "everywhere", "a part of the robot as one"],
)
def test_a_term_is_at_the_joints_that_pay(cost: np.ndarray, joints: set[str]) -> None:
    assert at(cost) == joints


def test_a_joint_that_held_out_windows_do_not_miss_is_left_out() -> None:
    """It pays on the windows of the fit, by 2 % of what the loaded link brings, and nowhere else."""
    cost, gain = np.full(12, 1.0), np.zeros(12)
    cost[[5, 8]], gain[5] = (900.0, 18.0), 0.5
    assert at(cost, gain) == {JOINTS[5]}
    gain[8] = 0.5
    assert at(cost, gain) == {JOINTS[5], JOINTS[8]}


def test_fewer_joints_that_lose_little_are_to_be_fitted_the_fewest_first() -> None:
    """One calf brings most, with its leg nearly all; all calves and a side are the best of four and of six."""
    cost = np.full(12, 1.0)
    cost[[3, 4, 5]] = 20.0, 120.0, 260.0
    linear: Any = Quadratic({("link_mass", "scale"): np.full(12, 1.6)}, cost, np.zeros(12))
    sets = [{5}, {3, 4, 5}, {2, 5, 8, 11}, {3, 4, 5, 9, 10, 11}]
    assert reduction.fewer(linear, "link_mass", frozenset()) == sets
    linear.theta = {("link_mass", "scale"): np.where(np.arange(12) == 5, 1.6, 1.05)}
    assert reduction.fewer(linear, "link_mass", frozenset()) == []  # the others are within their tolerance


def test_a_value_on_its_tolerance_is_not_beyond_it_and_is_not_asked() -> None:
    """A value that is clipped to 1 + 0.05 is 0.05 and 4e-17 away from 1."""
    p = DECLARED.param(("link_mass", "scale"))
    on, beyond = (np.full(12, p.null + far * p.tolerance) for far in (1.0, 1.001))
    assert abs(on[0] - p.null) > p.tolerance
    assert not candidates.beyond("link_mass", {("link_mass", "scale"): on}, JOINTS, DECLARED).any()
    assert candidates.beyond("link_mass", {("link_mass", "scale"): beyond}, JOINTS, DECLARED).all()
    scale = np.where(np.arange(12) == 3, 2.0, 1.0)
    linear: Any = Quadratic({("link_mass", "scale"): scale}, np.full(12, 500.0), np.zeros(12))
    assert reduction.chosen(linear, "link_mass", frozenset(), np.random.default_rng(0)) == {3}


def test_pieces_are_joints_parts_legs_sides_and_all() -> None:
    sets = {frozenset(JOINTS[j] for j in piece) for piece in reduction.pieces(JOINTS)}
    assert len(sets) == 12 + 3 + 4 + 4 + 1
    assert frozenset(j for j in JOINTS if j[1] == "R") in sets  # the right side
    assert reduction.pieces(["shoulder", "elbow"]) == [frozenset([0]), frozenset([1]), frozenset([0, 1])]


# ---------------------------------------------------------------------- held-out tests

FLOOR = np.ones((40, 4))
"""chi2 per value of a model that is right, of 40 windows and four legs."""


def friction(chi2: np.ndarray) -> Model:
    """Return a fitted model with viscous friction of three tolerances."""
    key = ("viscous", "damping")
    theta = {key: np.full(12, 3.0 * DECLARED.param(key).tolerance)}
    return Model("viscous", theta, Freedom(DECLARED), (key,), chi2)


def judged(
    now: np.ndarray, after: np.ndarray, monkeypatch: pytest.MonkeyPatch, fit: float = 1.0, **settings: Any
) -> Trial:
    """Test friction, which changes chi2 on held-out windows, and ``fit`` times on those of the fit."""
    monkeypatch.setattr(candidates, "scores", lambda scorer, thetas, windows, dt: after[None])
    scorer: Any = SimpleNamespace(replayer=SimpleNamespace(machine=MACHINE), size=np.full(40, 100.0))
    rng, windows = np.random.default_rng(0), np.arange(40)
    return candidates.tried(scorer, GapSettings(**settings), [friction(fit * now)], now, now, windows, 1e-3, rng)


def test_candidates_are_tested_on_windows_that_no_fit_has_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    trial, asked = judged(2.0 * FLOOR, 2.0 * FLOOR, monkeypatch), list[np.ndarray]()

    def tried(
        scorer: Any, settings: Any, fitted: Any, train: Any, now: Any, windows: np.ndarray, *others: Any
    ) -> Trial:
        asked.append(windows)
        return trial

    monkeypatch.setattr(stepwise, "tried", tried)
    scorer = SimpleNamespace(windows=SimpleNamespace(joints=JOINTS))
    about = {"settings": GapSettings(), "dt": 1e-3, "terms": (), "scorer": scorer}
    state: Any = SimpleNamespace(splits=SimpleNamespace(train=np.arange(40), select=np.arange(40, 80)), **about)
    begun = Search(state, np.random.default_rng(0), lambda *about: None)
    stepwise.held_out_test(begun, [friction(FLOOR)], state, FLOOR, FLOOR)
    assert [windows.tolist() for windows in asked] == [[*range(40, 80)]]


def test_where_little_is_left_a_candidate_must_remove_most_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = GapSettings()
    for left, needed in ((2.0, usual.min_share), (0.5 * (usual.material + usual.adequate), thresholds.MOST_OF_SMALL)):
        assert judged((1.0 + left) * FLOOR, FLOOR, monkeypatch).needed == needed


def test_what_helps_one_leg_and_harms_the_others_as_much_helps_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    now, after = np.array([9.0, 1.0, 1.0, 1.0]) * FLOOR, np.array([6.0, 1.5, 1.5, 1.5]) * FLOOR
    trial = judged(now, after, monkeypatch, min_share=0.1)
    assert trial.shown.all()
    assert trial.share > 0.1
    assert not trial.helps.any()
    assert trial.chosen is None


@pytest.mark.parametrize(("fall", "significant"), [(50.0, False), (200.0, True)])
def test_schwarz_asks_for_a_fall_of_the_logarithm_of_the_number_of_values_for_each_unknown(
    fall: float, significant: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """12 ln(16 000) = 116."""
    trial = judged(3.0 * FLOOR, FLOOR, monkeypatch, fit=np.exp(-fall / 16000.0), selection="bic")
    assert trial.p.tolist() == [0.0 if significant else 1.0]


@pytest.mark.parametrize(("after", "kept"), [(1.0, True), (1.01, True), (1.05, False)])
def test_a_term_with_which_all_else_fits_worse_is_none(
    after: float, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    refitted = SimpleNamespace(
        state=SimpleNamespace(held_out=lambda theta: 2.0 * FLOOR), select_chi2=(1.0 + after) * FLOOR
    )
    monkeypatch.setattr(stepwise, "with_term", lambda search, model: refitted)
    asked = search(Known(lambda terms: 1.0, ("viscous",), {}))
    found, goes_on = stepwise.accept(asked, Model("viscous", {}, Freedom(DECLARED), ()))
    assert goes_on == (found is refitted) == kept
    assert kept or [c.status for c in found.candidates] == ["rejected"]


def test_a_term_is_named_again_in_the_resamples_that_it_wins() -> None:
    """In three of four episodes it gains most, in the fourth another much more."""
    episode = np.repeat(np.arange(4), 10)
    state: Any = SimpleNamespace(
        scorer=SimpleNamespace(windows=SimpleNamespace(episode=episode)), machine=SimpleNamespace(groups=LEGS[:1])
    )
    state.splits = SimpleNamespace(train=np.arange(0, 40, 2), select=np.arange(1, 40, 2))
    state.settings = GapSettings(bootstraps=400)
    of_windows = np.concatenate([episode[state.splits.train], episode[state.splits.select]])
    gain = np.array([np.ones(40), np.where(of_windows == 3, 3.5, 0.0)])
    share = stepwise._bootstrap_share(
        Search(state, np.random.default_rng(0), lambda *about: None), gain, np.array([True, False])
    )
    assert share == pytest.approx(0.75**4 + 4 * 0.25 * 0.75**3, abs=0.08)  # not more than once in a sample of four


def test_what_falls_below_the_floor_is_not_more_than_all_of_a_gap() -> None:
    assert [removed(2.0, after) for after in (1.0, 0.0, -0.5)] == [0.5, 1.0, 1.0]
    assert removed(0.0, -0.5) == 0.0


def test_an_effect_may_leave_its_tolerance_as_a_term_and_not_where_it_is_kept() -> None:
    key = ("viscous", "damping")
    tolerance, may = (
        DECLARED.param(key).tolerance,
        Freedom(DECLARED, frozenset(["viscous"]), frozenset([("viscous", 3)])),
    )
    assert [may.reach(key, joint) for joint in (2, 3)] == [np.inf, tolerance]
    assert [Freedom(DECLARED, rigid=rigid).reach(key, 2) for rigid in (False, True)] == [tolerance, 0.0]


# ---------------------------------------------------------------------- names


def choice(
    gain: np.ndarray, numbers: Any, second: tuple[bool, bool] = (False, False)
) -> tuple[int | None, list[bool], list[bool]]:
    """Return the chosen of two candidates of which nothing remains, which are its equals, and which stand aside."""
    counts, all_out, none = np.array(numbers, dtype=float), np.ones(2, dtype=bool), np.zeros(2, dtype=bool)
    chosen, alias, aside = _choice(gain, all_out, none, counts, np.array(second), np.random.default_rng(0))
    return chosen, alias.tolist(), aside.tolist()


@pytest.mark.parametrize(("within", "chosen"), [(0.97, 0), (0.985, None), (1.5, None)])
def test_where_a_tolerance_does_as_well_nothing_must_leave_its_own(within: float, chosen: int | None) -> None:
    gain, outside = np.array([[1.0], [within]]).repeat(20, axis=1), np.array([True, False])
    numbers, rng = np.ones((2, 2)), np.random.default_rng(0)
    assert _choice(gain, outside, ~outside, numbers, np.zeros(2, dtype=bool), rng)[0] == chosen


def test_a_tilt_is_simpler_than_the_twelve_offsets_that_imitate_it() -> None:
    offsets = {("encoder_offset", "offset"): np.full(12, 0.02)}
    tilt = {("base_tilt", "roll"): np.array([0.03]), ("base_tilt", "pitch"): np.array([-0.02])}
    values = [("encoder_offset", offsets), ("base_tilt", tilt)]
    numbers = [(candidates.count(name, theta, MACHINE), len(theta)) for name, theta in values]
    gain = np.random.default_rng(0).normal(2.0, 0.1, (2, 60))
    gain[1] = gain[0] - 0.01  # half a per cent less: the same
    assert choice(gain, numbers) == (1, [False, True], [True, False])
    gain[1] = 0.8 * gain[0]  # but it must explain as much
    assert choice(gain, numbers)[0] == 0


@pytest.mark.parametrize(
    ("gains", "numbers", "chosen"),
    [
        ((0.523, 0.512), (8.0, 4.0), 1),  # the same: fewer joints come first
        ((0.523, 0.512), (4.0, 4.0), 0),  # as many: the better one
        ((0.523, 0.490), (8.0, 4.0), 0),  # an equal that does not mean the same
        ((0.523, 0.490), (12.0, 1.0), 0),  # and sets none aside, however few its joints
    ],
)
def test_of_equals_that_mean_the_same_the_one_at_fewer_joints_comes_first(
    gains: tuple[float, float], numbers: tuple[float, float], chosen: int
) -> None:
    gain = np.array(gains)[:, None] + np.random.default_rng(0).normal(0.0, 0.2, (2, 60))
    gain += np.array(gains)[:, None] - gain.mean(axis=1, keepdims=True)
    assert choice(gain, [(count, 1.0) for count in numbers]) == (chosen, [True, True], [False, False])


def test_of_equals_the_one_with_fewer_parameters_sets_the_others_aside() -> None:
    assert choice(np.full((2, 20), 0.5), [(4.0, 2.0), (4.0, 1.0)]) == (1, [False, True], [True, False])


@pytest.mark.parametrize(
    ("gains", "numbers", "chosen", "alias"),
    [
        ((0.11, 0.12), ((8.0, 1.0), (5.0, 4.0)), 1, (True, True)),  # a load at fewer links, masses at more: a set
        ((0.11, 0.12), ((1.0, 1.0), (1.0, 4.0)), 0, (True, True)),  # as many: fewer parameters come first
        ((0.11, 0.25), ((1.0, 1.0), (5.0, 4.0)), 1, (False, True)),  # clearly better
        ((0.25, 0.11), ((8.0, 1.0), (5.0, 4.0)), 0, (True, False)),  # clearly worse
    ],
)
def test_where_the_gap_is_small_what_is_easily_taken_for_another_is_named_with_it(
    gains: tuple[float, float], numbers: tuple[tuple[float, float], ...], chosen: int, alias: tuple[bool, bool]
) -> None:
    gain = np.array(gains)[:, None] + np.random.default_rng(0).normal(0.0, 0.01, 60)
    assert choice(gain, numbers, (False, True))[:2] == (chosen, list(alias))


def test_what_one_that_strains_is_easily_taken_for_is_tried_in_the_way_that_relieves_most() -> None:
    def way(effect: str, relief: float, **shape: float) -> Screened:
        shapes = {(effect, name): np.array([value]) for name, value in shape.items()}
        return Screened(Variant(effect, (), shapes), {}, 0.1, relief, 1.0)

    ways = [way("point_load", 0.05, z=0.1), way("link_mass", 0.07), way("point_load", 0.11, z=-0.2)]
    ways += [way("soft_mount", 0.02), way("cogging", 0.2), way("encoder_offset", 0.2), way("link_com", 0.09)]
    nominal = ("link_mass", "link_com", "encoder_offset")
    (found,) = rivals(ways, ["link_com", "link_mass"], nominal)
    assert found is ways[2]  # a soft mount relieves too little, cogging is not taken for a mass
    assert rivals(ways, ["viscous"], nominal) == []


@pytest.mark.parametrize("demand", [0.2, 0.5, 1.4])
def test_a_limit_of_the_torque_is_looked_for_below_what_was_asked_for(demand: float) -> None:
    """A limit of 0.9 of the peak does nothing in recordings that ask for a fifth of it."""
    asked = np.tile([0.3, demand, 0.1], 4)
    motion = Motion(np.zeros(12), -np.ones(12), np.ones(12), asked)
    probes = [p for v in library(MACHINE, motion) if v.effect == "torque_speed_limit" for p in v.probes]
    peaks = [1.0 + p.delta for p in probes if p.key == ("torque_speed_limit", "peak")]
    thighs = [peak[1] for peak in peaks if (peak < 1.0).sum() == 4 and peak[1] < 1.0]  # part by part
    assert len(thighs) == len(thresholds.TORQUE_SHARES)
    assert len({p for p in thighs if p < max(min(demand, 1.0), 0.2) + 1e-9}) >= (4 if demand > 1.0 else 1)
    assert max(thighs) <= 0.95 + 1e-9


def test_what_shares_a_value_moves_only_where_it_is() -> None:
    """A limit at the four thighs: a step of the fit must not pull the other joints along."""
    key = ("torque_speed_limit", "peak")
    theta = {key: np.tile([1.0, 0.7, 1.0], 4)}
    (probe,) = tolerances.probes(MACHINE, [key], theta)
    assert set(np.flatnonzero(probe.delta)) == {1, 4, 7, 10}
    layout = Layout.from_probes(MACHINE, [probe])
    after = tolerances.moved(theta, layout, [probe], np.array([-0.1]), MACHINE)[key]
    np.testing.assert_allclose(after, np.tile([1.0, 0.6, 1.0], 4))
    limits = tolerances.bounds(layout, [probe], theta, Freedom(DECLARED).also("torque_speed_limit"))
    np.testing.assert_allclose((limits.low, limits.high), ([-0.5], [0.3]))
    nowhere = tolerances.probes(MACHINE, [key], {})[0]
    assert np.all(nowhere.delta != 0.0)


def test_a_shape_moves_only_where_its_effect_leaves_its_tolerance() -> None:
    """The place of a load of 5 g, of which 10 g are tolerated, means next to nothing and would go anywhere."""
    mass = np.zeros(12)
    mass[[2, 5]] = 0.1, 0.005
    theta = {("point_load", "mass"): mass}
    columns = tolerances.probes(MACHINE, [("point_load", "mass"), ("point_load", "z")], theta)
    layout = Layout.from_probes(MACHINE, columns)
    limits = tolerances.bounds(layout, columns, theta, Freedom(DECLARED).also("point_load"))
    by_key = {
        name: {
            int(layout.joint[i]): (limits.low[i], limits.high[i]) for i in range(layout.size) if layout.probe[i] in at
        }
        for name, at in (("mass", (0, 1, 2)), ("z", (3, 4, 5)))
    }
    assert by_key["z"][2] == pytest.approx((-0.187, 0.613))
    assert all(by_key["z"][j] == (0.0, 0.0) for j in range(12) if j != 2)
    assert all(high > 0.5 for _, high in by_key["mass"].values())


def test_a_spring_is_looked_for_at_rest_angles_of_the_whole_range() -> None:
    motion = Motion(np.zeros(12), np.full(12, -0.7), np.full(12, 0.4), np.ones(12))
    rests = [
        v.shapes["parallel_stiffness", "rest"] for v in library(MACHINE, motion) if v.effect == "parallel_stiffness"
    ]
    np.testing.assert_allclose(sorted(float(r[0]) for r in rests), [-0.7, 0.0, 0.4])


@dataclass
class Settled:
    """A fitted state with one term, whose chi2 on held-out windows is known."""

    terms: tuple[str, ...]
    chi2: float
    value: float
    others: dict[str, tuple[float, float]] = field(default_factory=dict)
    tolerances: Any = DECLARED

    @property
    def theta(self) -> Theta:
        return {("link_mass", "scale"): np.full(12, self.value), ("armature", "added"): np.full(12, self.value - 1.0)}

    def without(self, name: str, instead: str) -> Settled:
        assert (name,) == self.terms
        return Settled((instead,), *self.others[instead])

    def converged(self, steps: int) -> Settled:
        return self

    def held_out(self, theta: Theta | None = None) -> np.ndarray:
        noise = np.random.default_rng(0).normal(0.0, 0.02, (40, 4))
        return np.exp(noise) * (10.0 if theta is not None else self.chi2)


def test_equals_of_a_term_that_is_replaced_stay_equals_if_they_do_as_well_as_what_replaces_it() -> None:
    state = Settled(("point_load",), 1.0, 1.0, {"link_mass": (1.001, 1.4), "armature": (1.5, 1.1)})
    aliases = {"point_load": ("point_load", "link_mass", "armature")}
    search: Any = SimpleNamespace(state=state, aliases=aliases, nominal={}, rng=np.random.default_rng(0))
    rest: Any = Settled(("link_com",), 1.0, 1.0)
    assert reduction.still_equal(search, "point_load", "link_com", rest) == ("link_mass",)
    state.others["link_mass"] = (1.001, 1.04)  # within its tolerance: it would not be missing
    assert reduction.still_equal(search, "point_load", "link_com", rest) == ()
    search.aliases = {}
    assert reduction.still_equal(search, "point_load", "link_com", rest) == ()
