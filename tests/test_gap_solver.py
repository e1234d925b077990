"""``go1exp.gap``: the statistics against brute force, and the solver on a robot whose secret we know."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import lsq_linear

import go1exp.logs.excitations  # noqa: F401  (registers every excitation)
from go1exp.cli.record import RIG
from go1exp.config.compose import compose
from go1exp.gap.comparison import compare
from go1exp.gap.data.cutting import even_clock, noise_of
from go1exp.gap.data.windows import held, splits
from go1exp.gap.replay.replayer import padded
from go1exp.gap.replay.rows import Probe
from go1exp.gap.result import EXIT_CODES, GapResult, GapSettings
from go1exp.gap.robots.go1 import SuspendedGo1, suspended
from go1exp.gap.score.likelihood import gram
from go1exp.gap.score.linear import Layout, predicted
from go1exp.gap.search import significance, stepwise, thresholds, tolerances
from go1exp.gap.search.fit import Model, scores
from go1exp.gap.search.significance import max_t
from go1exp.gap.search.state import Search
from go1exp.gap.search.tolerances import Bounds, Freedom, solve
from go1exp.gap.stages.explain import explain
from go1exp.logs.record import simulate
from go1exp.logs.recording import Meta, Recording
from go1exp.sim.effects.tolerances import DECLARED
from go1exp.sim.task import parse_parts
from tests import made
from tests.laboratory import recorded

QUICK = GapSettings(
    stride_s=0.4,
    window_s=0.2,
    effects=("coulomb", "viscous", "stribeck", "command_delay"),
    shortlist=3,
    iterations=2,
    max_terms=1,
    bootstraps=20,
    overlays=1,
)


def robot(*overrides: str) -> tuple[simulate.Rig, list[Recording]]:
    """Record a hung robot: three gain sets, a chirp each, 3.5 s."""
    gains = "gains=[[20,0.5],[35,0.6],[35,1.2]]"
    rig, found = recorded(["physics_dt=0.0005", "seconds=3.5", "excitation=[chirp]", gains, *overrides])
    return rig, list(found)


# ---------------------------------------------------------------------- statistics


def test_a_gram_matrix_is_that_of_the_full_covariance() -> None:
    rng = np.random.default_rng(0)
    columns, state = rng.standard_normal((2, 3, 40, 4)), 5.0 * rng.standard_normal((2, 3, 40, 6))
    found = gram(columns, state)
    for w in range(2):
        for g in range(3):
            a, s = columns[w, g], state[w, g]
            expected = a.T @ np.linalg.inv(np.eye(40) + s @ s.T) @ a
            np.testing.assert_allclose(found[w, g], expected, atol=1e-10)


def test_a_wrong_first_state_costs_nothing_where_it_is_uncertain() -> None:
    rng = np.random.default_rng(1)
    state = 1e3 * rng.standard_normal((1, 1, 200, 6))
    residual = rng.standard_normal((1, 1, 200, 1))
    off = residual + 1e-3 * state @ rng.standard_normal((6, 1))
    np.testing.assert_allclose(gram(off, state), gram(residual, state), rtol=1e-4)
    plain = np.zeros_like(state)
    assert gram(off, plain)[0, 0, 0, 0] > 1.5 * gram(residual, plain)[0, 0, 0, 0]


def test_normal_equations_promise_what_the_model_gives() -> None:
    rng = np.random.default_rng(2)
    joints = np.ones(12)
    probes = [Probe(("coulomb", "bound"), 0, joints), Probe(("base_tilt", "roll"), None, np.ones(1))]
    machine = SuspendedGo1(simulate_config())
    layout = Layout.from_probes(machine, probes)
    assert layout.size == 5
    np.testing.assert_array_equal(layout.joint, [0, 3, 6, 9, -1])
    columns, state = rng.standard_normal((3, 4, 30, 2)), np.zeros((3, 4, 30, 1))
    residual = rng.standard_normal((3, 4, 30))
    grams = gram(np.concatenate([columns, residual[..., None]], axis=-1), state)
    x = rng.standard_normal(5)
    left = residual - np.einsum("wgmp,gp->wgm", columns, x[layout.index])
    np.testing.assert_allclose(predicted(grams, layout, x), (left**2).sum(-1))
    matrix, right = layout.total(grams)
    total = x @ matrix @ x - 2 * right @ x + (residual**2).sum()
    assert total == pytest.approx((left**2).sum())


def simulate_config() -> Any:
    parts, _ = parse_parts(compose("record", []), RIG)
    return parts["robot"]


def limits(low: float, high: float, weight: float, size: int) -> Bounds:
    ones = np.ones(size)
    return Bounds(low * ones, high * ones, 0.0 * ones, weight * ones)


@pytest.mark.parametrize("bound", [0.1, np.inf])
def test_a_bounded_fit_is_bounded_least_squares(bound: float) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        columns, wanted, centre = (rng.standard_normal(shape) for shape in ((40, 8), 40, 8))
        some = replace(limits(-bound, 1.5 * bound, 2.0, 8), centre=centre)
        x = solve(columns.T @ columns, columns.T @ wanted, some)
        rows = np.vstack([columns, np.sqrt(2.0) * np.eye(8)])
        whole = np.concatenate([wanted, np.sqrt(2.0) * centre])
        np.testing.assert_allclose(x, lsq_linear(rows, whole, (-bound, 1.5 * bound), tol=1e-12).x, atol=1e-6)


def test_what_may_not_move_stays_and_the_rest_makes_up_for_it() -> None:
    rng = np.random.default_rng(1)
    columns, wanted, fixed = rng.standard_normal((40, 6)), rng.standard_normal(40), np.array([0.0, 0.07])
    some = limits(-0.1, 0.15, 0.0, 6)
    some.low[:2] = some.high[:2] = fixed
    x = solve(columns.T @ columns, columns.T @ wanted, some)
    np.testing.assert_array_equal(x[:2], fixed)
    slow = lsq_linear(columns[:, 2:], wanted - columns[:, :2] @ fixed, (-0.1, 0.15), tol=1e-12).x
    np.testing.assert_allclose(x[2:], slow, atol=1e-6)
    some.low[:] = some.high[:] = 0.02
    np.testing.assert_allclose(solve(columns.T @ columns, columns.T @ wanted, some), 0.02)


def test_columns_that_say_the_same_but_for_rounding_are_no_crash() -> None:
    """Their products, summed in float32, can be indefinite by more than the prior holds."""
    matrix = 1e8 * np.array([[1.0, 1.0 + 5e-8, 0.0], [1.0 + 5e-8, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.linalg.eigvalsh(matrix).min() < -1.0
    x = solve(matrix, 1e8 * np.array([0.3, 0.3, 0.2]), limits(-1.0, 1.0, 1e-6, 3))
    np.testing.assert_allclose([x[0] + x[1], x[2]], [0.3, 0.2], atol=1e-5)
    with pytest.raises(np.linalg.LinAlgError, match="by far more than their rounding"):
        solve(np.array([[1.0, 2.0], [2.0, 1.0]]), np.zeros(2), limits(-1.0, 1.0, 1e-9, 2))


def test_max_t_calls_nothing_significant_more_often_than_it_says() -> None:
    rng = np.random.default_rng(4)
    shared = rng.standard_normal((400, 1, 24))  # candidates resemble each other
    gains = shared + rng.standard_t(3, size=(400, 8, 24))
    smallest = np.array([max_t(gain, rng, flips=400).min() for gain in gains])
    assert np.mean(smallest < 0.05) < 0.08
    assert np.mean(smallest < 0.5) == pytest.approx(0.5, abs=0.1)
    moved = gains[0] + 3.0 * (np.arange(8) == 2)[:, None]
    found = max_t(moved, rng)
    assert found[2] < 0.001
    assert np.all(np.delete(found, 2) > 0.01)


def test_max_t_sees_what_one_group_gains_and_still_says_how_often_that_is_chance() -> None:
    rng = np.random.default_rng(5)
    gains = rng.standard_t(3, size=(400, 4, 48))
    smallest = np.array([max_t(gain, rng, groups=4, flips=400).min() for gain in gains])
    assert np.mean(smallest < 0.05) < 0.08
    assert np.mean(smallest < 0.5) == pytest.approx(0.5, abs=0.1)
    one = np.zeros(48)
    one[2::4] = 1.5  # of the third group of each window
    alone, together = (np.array([max_t(gain[:1] + one, rng, groups=g)[0] for gain in gains[:60]]) for g in (4, 1))
    assert np.mean(alone < 0.01) > 2.0 * np.mean(together < 0.01) > 0.0


def test_what_does_as_well_gains_nearly_as_much_or_most_of_it_with_a_difference_that_may_be_chance() -> None:
    chance = np.resize([3.0, -3.0], 40)
    gain = np.ones((5, 40))
    gain[1:] = np.array([0.985, 0.8, 0.8, 0.6])[:, None] + np.array([0.0, 0.0, 1.0, 1.0])[:, None] * chance
    # The best; the same; worse in each window; worse in half of them; as unsure, but far less.
    assert significance.equals(gain, 0, np.random.default_rng(0)).tolist() == [True, True, False, True, False]


@pytest.mark.parametrize("windows", [1, 4000], ids=["of many episodes one window", "of one episode many windows"])
def test_a_bootstrap_draws_episodes_with_replacement_and_then_their_windows(windows: int) -> None:
    episode = np.arange(4000) // windows
    drawn = significance.resampled(episode, np.random.default_rng(0))
    assert len(drawn) == 4000
    assert len(np.unique(drawn)) / 4000 == pytest.approx(1.0 - np.exp(-1.0), abs=0.02)


def meta(episode: str, excitation: str, kd: float, repeat_of: str | None = None) -> Meta:
    about: dict[str, Any] = {"episode": episode, "excitation": excitation, "repeat_of": repeat_of}
    return made.meta(("a",), kp=(20.0,), kd=(kd,), **about)


def test_episodes_that_have_a_like_are_held_out_whole() -> None:
    names = [(e, kd, seed) for e in ("chirp", "steps") for kd in (0.5, 1.0) for seed in "ab"]
    metas = [meta(f"{e}{kd}{s}", e, kd) for e, kd, s in names] + [meta("again", "chirp", 0.5, "chirp0.5a")]
    episode = np.repeat(np.arange(9), 7)
    found = splits(metas, episode, 0.1, np.random.default_rng(0))
    parts = [set(episode[p]) for p in (found.train, found.select, found.confirm)]
    assert set.union(*parts) == set(range(9))
    assert any({0, 8} <= p for p in parts)
    kinds = [{(metas[e].excitation, metas[e].kd) for e in p} for p in parts]
    cut = {metas[e].episode for e in parts[0] & parts[1]}
    assert cut == set(found.alone)
    assert len(cut) == 1  # the like of the one that is kept for the last check
    assert len(kinds[0]) == len(kinds[1]) == 4


def test_episodes_without_a_like_are_cut_into_stretches() -> None:
    metas = [meta(f"{k}", "chirp", float(k)) for k in range(3)]
    episode = np.repeat(np.arange(3), 12)
    found = splits(metas, episode, 0.2, np.random.default_rng(0))
    assert found.alone == ("0", "1", "2")
    assert len(found.train) == len(found.select) == 18
    assert not len(found.confirm)
    assert not set(found.train) & set(found.select)
    assert all(set(episode[p]) == {0, 1, 2} for p in (found.train, found.select))
    assert set(np.diff(np.flatnonzero(np.diff(np.isin(np.arange(12), found.select))))) == {3}


def test_a_motion_of_which_there_is_one_is_not_kept_whole_for_the_last_check() -> None:
    """Its kind would be judged by models that never saw it: drives off, say, where all others have them on."""
    metas = [meta(f"{k}", "chirp", float(k)) for k in range(3)] + [meta("off", "torque_off", 9.0)]
    for seed in range(20):
        found = splits(metas, np.repeat(np.arange(4), 12), 0.2, np.random.default_rng(seed))
        assert len(found.confirm) == 12
        assert 3 not in set(np.repeat(np.arange(4), 12)[found.confirm])
    alike = [meta(f"{k}", f"motion{k}", 1.0) for k in range(5)]
    episode = np.repeat(np.arange(5), 12)
    found = splits(alike, episode, 0.2, np.random.default_rng(0))
    assert len(found.confirm) == 12  # every fifth stretch, of all
    assert len(found.shared) == 4
    assert all(set(episode[p]) == set(range(5)) for p in (found.train, found.select))
    assert sorted([*found.train, *found.select, *found.confirm]) == list(range(60))


def test_one_long_episode_lends_stretches_to_the_last_check() -> None:
    found = splits([meta("all", "chirp", 1.0)], np.zeros(60, dtype=int), 0.2, np.random.default_rng(0))
    assert len(found.confirm) == 12
    assert found.shared == ("all",)
    assert abs(len(found.train) - len(found.select)) <= 3
    assert not len(splits([meta("all", "chirp", 1.0)], np.zeros(60, dtype=int), 0.0, np.random.default_rng(0)).confirm)


# ---------------------------------------------------------------------- windows


def test_batches_are_little_larger_than_what_is_asked_and_of_few_sizes() -> None:
    asked = range(1, 1025)
    made = [padded(rows) for rows in asked]
    assert all(rows <= size <= max(1.25 * rows, rows + 7) for rows, size in zip(asked, made, strict=True))
    assert all(size % 8 == 0 for size in made)
    assert len(set(made)) < 30


def test_a_held_signal_changes_at_the_nearest_step() -> None:
    changes = (np.array([0.0, 0.0100004, 0.02]), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(held(changes, np.array([0.0, 0.005, 0.01, 0.015, 0.02])), [1, 1, 2, 2, 3])


@pytest.fixture(scope="module")
def plain() -> tuple[simulate.Rig, list[Recording]]:
    return robot()


def test_noise_and_clock_are_those_of_the_logger(plain: tuple[simulate.Rig, list[Recording]]) -> None:
    _, recordings = plain
    np.testing.assert_allclose(noise_of([r.joint("q") for r in recordings]), 2e-4, rtol=0.08)
    np.testing.assert_allclose(noise_of([r.joint("qd") for r in recordings]), 0.02, rtol=0.08)
    assert np.std(np.diff(recordings[0].t)) > 5e-5  # its stamps are late, its samples are not
    even = np.diff(even_clock(recordings[0]))
    np.testing.assert_allclose(even, 0.002, atol=1e-6)


@pytest.mark.parametrize("lateness", [0.0003, 0.0008])
def test_stamps_late_by_up_to_a_period_leave_the_clock_even(
    lateness: float, plain: tuple[simulate.Rig, list[Recording]]
) -> None:
    """Of 0.8 ms some stamps come after the middle between two samples, so that rows seem lost and repeated."""
    _, (recording, *_) = plain
    even = even_clock(recording)
    late = np.minimum(np.abs(lateness * np.random.default_rng(0).standard_normal(len(even))), 0.0019)
    found = even_clock(replace(recording, channels={**recording.channels, "t": even + late}))
    assert np.mean(late > 0.001) > (0.1 if lateness == 0.0008 else 0.0)
    np.testing.assert_allclose(np.diff(found), 0.002, atol=2e-6)
    np.testing.assert_allclose(found - even, late.mean(), atol=2e-4)
    after = np.arange(len(even)) >= 900  # behind a hole of 10.4 periods
    holed = even_clock(replace(recording, channels={**recording.channels, "t": even + late + 0.0188 * after}))
    steps = np.diff(holed)
    np.testing.assert_allclose(np.delete(steps, 899), 0.002, atol=3e-6)
    assert steps[899] == pytest.approx(0.0208, abs=0.002)


@pytest.mark.parametrize("lost", [0.05, 0.15])
def test_lost_rows_leave_the_clock_even(lost: float, plain: tuple[simulate.Rig, list[Recording]]) -> None:
    _, (recording, *_) = plain
    even, rng = even_clock(recording), np.random.default_rng(1)
    kept, late = rng.random(len(even)) >= lost, np.abs(2e-4 * rng.standard_normal(len(even)))
    channels = {name: values[kept] for name, values in recording.channels.items()}
    found = even_clock(replace(recording, channels=channels | {"t": (even + late)[kept]}))
    np.testing.assert_allclose(found - even[kept], late.mean(), atol=5e-5)


# ---------------------------------------------------------------------- from end to end


def run(rig: simulate.Rig, recordings: list[Recording]) -> GapResult:
    told: list[float] = []
    result = explain(recordings, rig.robot, QUICK, lambda what, share: told.append(share))
    assert told == sorted(told)
    assert told[-1] == 1.0
    json.dumps(result.as_dict(), allow_nan=False)
    assert result.exit_code == EXIT_CODES[result.verdict]
    return result


def test_a_model_that_is_right_has_no_gap(plain: tuple[simulate.Rig, list[Recording]]) -> None:
    result = run(*plain)
    assert result.verdict == "no gap"
    assert result.named == ()
    assert abs(result.excess["null"]) < 0.05
    assert result.floors is not None
    assert result.floors.numerical["q"] < 1e-4


def test_a_clock_need_not_start_at_zero(plain: tuple[simulate.Rig, list[Recording]]) -> None:
    """What changes in the course of an episode counts from its beginning, not from when the logger was switched on."""
    rig, found = plain
    late = [replace(r, channels={**r.channels, "t": r.t + 1000.0}) for r in found]
    weaker = {("strength_drift", "rate"): np.full(12, 0.05)}
    chi2 = []
    for logs in (found, late):
        comparison = compare(logs, suspended(rig.robot), QUICK)
        windows = comparison.windows
        np.testing.assert_allclose(windows.elapsed, windows.begin - 1000.0 * (logs is late), atol=2e-3)
        chi2.append(scores(comparison.scorer, [weaker], np.arange(len(windows)), 0.001)[0])
    assert chi2[0].mean() > 2.0
    np.testing.assert_allclose(chi2[1], chi2[0], rtol=1e-3)


@pytest.mark.parametrize(
    ("p", "share", "before", "shown"),
    [(0.005, 0.2, 2.0, True), (0.05, 0.8, 2.0, True), (0.05, 0.7, 2.0, False), (0.05, 0.8, 0.05, False)],
    ids=["significant", "few windows, most of the gap", "not most of it", "no gap"],
)
def test_few_windows_are_enough_for_what_removes_most_of_a_gap(
    p: float, share: float, before: float, shown: bool
) -> None:
    assert significance.shown(np.array([p, 0.2]), np.array([share, 1.0]), before, QUICK).tolist() == [shown, False]
    strict = replace(QUICK, alpha=1e-4)
    assert not significance.shown(np.array([p, 0.2]), np.array([share, 1.0]), before, strict).any()


def test_what_strains_most_is_tried_with_its_rivals() -> None:
    relief = {"armature": 900.0, "link_mass": 200.0, "strength": 100.0}
    values = 900.0 / (2.0 * thresholds.ACTIVE_BOUND)
    assert tolerances.active_bounds(relief, values, []) == ["armature"]
    assert tolerances.active_bounds(relief, 3.0 * values, []) == []
    assert tolerances.active_bounds(relief, values, ["armature"]) == []  # 200 is too little
    assert tolerances.active_bounds(relief | {"link_mass": 601.0}, values, []) == ["armature", "link_mass"]
    assert tolerances.active_bounds(relief | {"armature": 3000.0, "link_mass": 900.0}, values, []) == ["armature"]
    assert tolerances.active_bounds({}, values, []) == []


@pytest.mark.parametrize(("third", "expected"), [(1.0, ["viscous", "kd_scale"]), (300.0, [])])
def test_candidates_that_leave_next_to_nothing_are_fitted_to_their_end(
    monkeypatch: pytest.MonkeyPatch, third: float, expected: list[str]
) -> None:
    """A speed gain that was left at 1.2 times the noise was called worse than viscous friction at 1.0."""
    rounds: list[str] = []

    def further(scorer: object, models: list[Model], table: object, iterations: int, dt: float) -> list[Model]:
        rounds.extend(m.name for m in models)
        return [replace(m, theta={("coulomb", "bound"): np.ones(12)}) for m in models]

    monkeypatch.setattr(stepwise, "fit", further)
    left = {"viscous": 1.0, "lag": 90.0, "kd_scale": 1.2 * third}
    may = Freedom(DECLARED, frozenset())
    models = [Model(name, {}, may, (), np.full((8, 4), chi2)) for name, chi2 in left.items()]
    search: Any = SimpleNamespace(settings=QUICK, state=SimpleNamespace(scorer=None, table=None), dt=1e-3)
    candidates = stepwise.fitted_on(search, models)
    assert [m.name for m in candidates] == [*left]
    assert rounds == expected
    assert [m.name for m in candidates if m.theta] == expected


@pytest.mark.parametrize(
    ("left", "asked"),
    [
        (0.05, [("leaning", True)]),  # no gap: only what strains a tolerance
        (0.2, [("screened", False), ("leaning", True)]),
        (0.7, [("screened", False)]),  # the model is wrong: tolerances do not make up for it
    ],
)
def test_where_little_is_left_and_nothing_alone_removes_it_what_strains_a_tolerance_is_asked(
    left: float, asked: list[tuple[str, bool]], monkeypatch: pytest.MonkeyPatch
) -> None:
    judged, model = [], Model("base_tilt", {}, Freedom(DECLARED, frozenset()), ())

    def evaluate(
        search: Search, fitted: list[str], state: Any, train: Any, select: Any, small: bool
    ) -> tuple[Search, Model | None, None]:
        judged.append((*fitted, small))
        return search, (model if fitted == ["leaning"] else None), None

    monkeypatch.setattr(stepwise, "screened_by", lambda search: [])
    monkeypatch.setattr(stepwise, "fitted_candidates", lambda search, screened: ["screened"])
    monkeypatch.setattr(stepwise, "at_active_bounds", lambda search, screened: (search, ["leaning"]))
    monkeypatch.setattr(stepwise, "held_out_test", evaluate)
    monkeypatch.setattr(stepwise, "accept", lambda search, accepted: (search, accepted is model))
    state: Any = SimpleNamespace(terms=(), relaxed=(), train_chi2=None, settings=GapSettings())
    chi2 = np.full((8, 4), 1.0 + left)
    search = Search(state, np.random.default_rng(0), lambda what, share: None, chi2, signal={"coulomb": 1.0})
    search, accepted = stepwise.advance(search)
    assert judged == asked
    assert (accepted, search.marginal) == (asked[-1][1], asked[-1][1])  # a strained term must be clear of doubt


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_hidden_friction_is_named_where_it_is() -> None:
    rig, recordings = robot("effect=coulomb", "effect.coulomb.bound=[0.0,0.0,0.3]")
    plain, _ = parse_parts(compose("record", []), RIG)
    assert plain["robot"] == rig.robot  # the model is not told
    result = run(rig, recordings)
    assert result.verdict == "explained"
    (found,) = result.named
    assert found.effect == "coulomb"
    assert set(found.joints) == {f"{leg}_calf" for leg in ("FR", "FL", "RR", "RL")}
    np.testing.assert_allclose(list(found.params["bound"].values()), 0.3, rtol=0.1)
    assert result.excess["box"] > 1.0
    assert result.excess["final"] < 0.2
    assert dict(result.waterfall)["within tolerances"] == result.excess["box"]  # all of a report by the same floors
    assert result.closed > 0.95
    assert "coulomb" in result.sentence
    (row,) = [c for c in result.candidates if c.status == "accepted"]
    assert row.p < 0.01


def test_logs_that_cannot_be_compared_are_refused(plain: tuple[simulate.Rig, list[Recording]]) -> None:
    rig, recordings = plain
    channels = {k: v for k, v in recordings[0].channels.items() if not k.startswith("qd_")}
    result = explain([Recording(recordings[0].meta, channels)], rig.robot, QUICK)
    assert result.verdict == "bad log"
    assert "no qd" in result.sentence
