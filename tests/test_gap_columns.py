"""Columns of the linear model: learned, borrowed, and what their errors are taken for in the last fit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from go1exp.gap.comparison import compare, robot_from
from go1exp.gap.replay.rows import Probe, Theta
from go1exp.gap.result import GapSettings
from go1exp.gap.score.likelihood import Scorer, log_chi2
from go1exp.gap.score.linear import Layout, Table, borrowed, corrected, unbiased_grams
from go1exp.gap.search import state as search_state
from go1exp.gap.search import thresholds, tolerances
from go1exp.gap.search.certainty import opposite, resampled_values, semidefinite
from go1exp.gap.search.fit import descend, fit
from go1exp.gap.search.state import State, begun
from go1exp.sim.effects.tolerances import DECLARED
from tests.laboratory import recorded

FRICTION = ("coulomb", "bound")
THETA: Theta = {FRICTION: np.full(12, 0.2)}


@pytest.fixture(scope="module")
def hung() -> State:
    """A robot with friction of 0.2 N m, and a model that may have it."""
    hidden = ["effect=coulomb", "effect.coulomb.bound=0.2"]
    rig, logs = recorded(["seconds=2", "excitation=[chirp,steps]", "gains=[[20,0.5],[35,0.6]]", *hidden])
    settings = GapSettings(stride_s=0.4, window_s=0.2)
    comparison = compare(list(logs), robot_from(rig.robot), settings)
    parts = comparison.split(np.random.default_rng(0))
    return State(comparison.scorer, parts, settings, comparison.dt, terms=("coulomb",))


@pytest.fixture(scope="module")
def linear(hung: State) -> Table:
    """The linear model about the nominal values."""
    return hung.linear({}, hung.splits.train)


def test_a_corrected_model_says_what_the_step_did_and_keeps_what_it_did_not_try(hung: State, linear: Table) -> None:
    layout = Layout.from_probes(hung.machine, linear.probes)
    rng = np.random.default_rng(1)
    step = np.where(rng.random(layout.size) < 0.3, rng.standard_normal(layout.size), 0.0)
    _, unit = tolerances.unknowns(layout, linear.probes, {}, hung.tolerances)
    after = linear.residual + rng.standard_normal(linear.residual.shape).astype(np.float32)
    learned = corrected(linear, layout, step * unit, unit, after)
    for g, at in enumerate(layout.index):
        fall = learned.columns[:, g] @ (step * unit)[at]
        np.testing.assert_allclose(fall, (linear.residual - after)[:, g], atol=2e-3 * np.abs(linear.residual).max())
        untried = step[at] == 0.0
        np.testing.assert_array_equal(learned.columns[:, g][..., untried], linear.columns[:, g][..., untried])
        sideways = np.where(untried, 0.0, rng.standard_normal(len(at)))
        sideways -= step[at] * (sideways @ step[at]) / (step[at] @ step[at])  # in units of tolerances
        change = (learned.columns - linear.columns)[:, g] @ (sideways * unit[at])
        assert np.abs(change).max() < 1e-2
    assert learned.residual is after
    same = corrected(linear, layout, np.zeros(layout.size), np.ones(layout.size), linear.residual)
    np.testing.assert_array_equal(same.columns, linear.columns)


def test_borrowed_columns_are_those_that_were_measured_in_the_units_of_now(hung: State, linear: Table) -> None:
    probes = tolerances.probes(hung.machine, hung.keys, THETA)
    twice = replace(hung.scorer, scale=2.0 * hung.scorer.scale)
    near = borrowed(linear, twice, THETA, probes, {FRICTION}, hung.dt)
    measured = replace(hung, scorer=twice).linear(THETA, hung.splits.train)
    fresh = np.array([p.key == FRICTION for p in probes])
    assert 0 < fresh.sum() < len(probes)
    np.testing.assert_array_equal(near.residual, measured.residual)
    np.testing.assert_allclose(near.columns[..., fresh], measured.columns[..., fresh], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(near.columns[..., ~fresh], 0.5 * linear.columns[..., ~fresh], rtol=1e-5)


def test_a_quantity_that_is_not_compared_has_columns_of_zero(hung: State) -> None:
    scale = hung.scorer.scale.copy()
    scale[:, 1] = np.inf
    angles = replace(hung, scorer=replace(hung.scorer, scale=scale))
    linear = angles.linear({}, hung.splits.train)
    near = borrowed(linear, angles.scorer, {}, linear.probes, set(), hung.dt)
    np.testing.assert_array_equal(near.columns, linear.columns)


def test_columns_that_learn_come_as_far_as_columns_that_stay(hung: State, linear: Table) -> None:
    (stays,) = fit(hung.scorer, [hung.model({})], linear, 4, hung.dt)
    learns = descend(hung.scorer, hung.model({}), linear, 4, hung.dt)
    assert stays.chi2 is not None
    assert learns.chi2 is not None
    assert float(log_chi2(learns.chi2).mean()) <= float(log_chi2(stays.chi2).mean()) + 0.003


def test_a_settled_model_keeps_columns_as_they_were_measured(hung: State, linear: Table) -> None:
    once = hung.converged(1)
    np.testing.assert_array_equal(once.table.columns, linear.columns)
    residual = hung.linear(once.theta, hung.splits.train).residual
    np.testing.assert_allclose(once.table.residual, residual, atol=1e-3 * np.abs(residual).max())


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_a_settled_model_is_as_good_whatever_its_first_columns_were(
    hung: State, monkeypatch: pytest.MonkeyPatch
) -> None:
    nominal = replace(hung, terms=()).converged(3)
    assert nominal.nominal is not None
    begun = replace(nominal, terms=("coulomb",), theta=dict(THETA))
    borrows = begun.converged(4)
    monkeypatch.setattr(search_state, "borrowed", None)  # and none is asked for
    measures = replace(begun, nominal=None).converged(4)
    ours, theirs = (float(log_chi2(s.held_out()).mean()) for s in (borrows, measures))
    assert ours == pytest.approx(theirs, abs=0.02)
    assert borrows.theta[FRICTION] == pytest.approx(measures.theta[FRICTION], abs=0.02)


def test_what_cannot_come_near_its_rival_is_given_up(hung: State, monkeypatch: pytest.MonkeyPatch) -> None:
    full = replace(hung, theta=dict(THETA)).converged(2)
    kept = frozenset(("coulomb", j) for j in range(12))
    rounds: list[int] = []
    measured = State.linear

    def counted(self: State, theta: Theta, windows: np.ndarray) -> Table:
        rounds.append(len(windows))
        return measured(self, theta, windows)

    monkeypatch.setattr(State, "linear", counted)
    hopeless = full.keeping(kept).converged(3, rival=full)
    assert not rounds
    assert hopeless.held_out().mean() > 2.0 * full.held_out().mean()
    again = full.converged(3, rival=full)
    assert again.held_out().mean() == pytest.approx(full.held_out().mean(), rel=0.05)


# ---------------------------------------------------------------------- the last fit


HIDDEN_S = 0.005
ALL = np.ones(2, dtype=bool)
QUICK = GapSettings(stride_s=0.4, window_s=0.2, effects=("command_delay",), bootstraps=40)


def delays(monkeypatch: pytest.MonkeyPatch, finer: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the delay (J,) and its resamples (B, J), s, of a robot whose drives obey late, stepped finely."""
    monkeypatch.setattr(thresholds, "FINER_STEPS", finer)
    hidden = ["effect=command_delay", f"effect.command_delay.delay={HIDDEN_S}", "physics_dt=0.000125"]
    rig, logs = recorded(["seconds=2", "excitation=[steps]", "gains=[[20,0.5],[35,0.6],[35,1.2]]", *hidden])
    rng = np.random.default_rng(0)
    comparison = compare(list(logs), robot_from(rig.robot), QUICK)
    parts = comparison.split(rng)
    search = begun(comparison.scorer, parts, comparison.settings, comparison.dt, rng)
    key = ("command_delay", "delay")
    theta: Theta = {key: np.full(12, HIDDEN_S)}
    state = replace(search.state, terms=("command_delay",), theta=theta).converged(1)
    fitted, drawn = resampled_values(replace(search, state=state))
    return fitted[key], drawn[key]


def tables(residual: np.ndarray, *columns: np.ndarray) -> tuple[Scorer, list[Table]]:
    """Return a scorer of windows (W, 1, n) whose initial state is known, and a table of each columns."""
    count, _, samples = residual.shape
    score = cast(Scorer, SimpleNamespace(state=np.zeros((count, 1, samples, 1))))
    return score, [Table(np.arange(count), (), residual, c, {}, np.ones((count, 1, 1))) for c in columns]


def test_errors_of_columns_tell_nothing() -> None:
    """Two columns that are the same but for errors look as if their difference were known; without these it is not."""
    rng = np.random.default_rng(0)
    true = np.repeat(rng.standard_normal((40, 1, 300, 1)), 2, axis=-1)
    columns = [true + 0.3 * rng.standard_normal(true.shape) for _ in range(2)]
    score, (one, other) = tables(rng.standard_normal((40, 1, 300)), *columns)
    biased = one.grams(score).sum(0)[0]
    unbiased = unbiased_grams(score, one, other, np.ones(2), ALL).sum(0)[0]
    along, against = np.array([1.0, 1.0, 0.0]), np.array([1.0, -1.0, 0.0])
    errors = 40 * 300 * 2 * 0.3**2
    assert against @ biased @ against == pytest.approx(errors, rel=0.05)
    assert abs(against @ unbiased @ against) < 0.05 * errors
    assert along @ unbiased @ along == pytest.approx(4 * np.sum(true[..., 0] ** 2), rel=0.02)
    np.testing.assert_allclose(unbiased, unbiased.T)


def test_a_column_that_differs_nearly_altogether_stays_known() -> None:
    """A small change of a dead band acts or does not: what two of them share says too little of what is known."""
    rng = np.random.default_rng(2)
    smooth, acts = rng.standard_normal((10, 1, 200, 1)), rng.standard_normal((10, 1, 200, 1))
    columns = (np.concatenate([smooth, share * acts], axis=-1) for share in (1.0, 0.05))
    score, (one, other) = tables(rng.standard_normal((10, 1, 200)), *columns)
    products = unbiased_grams(score, one, other, np.ones(2), ALL).sum(0)[0]
    assert products[0, 0] == pytest.approx(np.sum(smooth**2), rel=1e-3)
    assert products[1, 1] == pytest.approx(np.sum((0.525 * acts) ** 2), rel=1e-3)


@pytest.mark.parametrize(("elsewhere", "kept"), [(1.0, False), (0.01, True)])
def test_windows_with_jumps_say_nothing_unless_nothing_else_does(elsewhere: float, kept: bool) -> None:
    """In two of ten windows a stop is met a step later or not: a jump in both columns that no change of it explains."""
    rng = np.random.default_rng(3)
    smooth = rng.standard_normal((10, 1, 200, 2))
    smooth[2:, ..., 0] *= elsewhere  # the column that is needed
    residual = rng.standard_normal((10, 1, 200))
    jump = np.zeros_like(smooth)
    jump[:2] = 0.5 * rng.standard_normal((2, 1, 200, 1))
    score, (one, other) = tables(residual, smooth + jump, smooth - jump)
    products = unbiased_grams(score, one, other, np.ones(2), np.array([True, False]))
    assert products[:2].any() == kept
    plain = np.concatenate([smooth, residual[..., None]], axis=-1)[2:, 0]
    np.testing.assert_allclose(products[2:, 0], np.swapaxes(plain, 1, 2) @ plain, rtol=1e-3, atol=1e-2)
    unasked = unbiased_grams(score, one, other, np.ones(2), np.zeros(2, dtype=bool))
    assert not unasked[:2].any()


def test_a_matrix_loses_its_negative_eigenvalues_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    root = rng.standard_normal((5, 9))
    positive = root @ root.T
    np.testing.assert_allclose(semidefinite(positive), positive)
    wrong = positive - 1.2 * np.linalg.eigvalsh(positive)[0] * np.eye(5)
    wrong[4], wrong[:, 4] = 0.0, 0.0  # a value that nothing shows
    values = np.linalg.eigvalsh(semidefinite(wrong))
    assert values.min() > -1e-12 * values.max()
    assert not semidefinite(wrong)[4].any()


def test_the_other_change_is_the_other_way_where_there_is_room_and_shapes_keep_theirs() -> None:
    """A friction of 0 has no room below; the phase of a cogging torque has no tolerance."""
    present: Theta = {("coulomb", "bound"): np.r_[0.0, np.full(11, 0.3)], ("cogging", "phase"): np.full(12, 0.5)}
    given = [Probe(("coulomb", "bound"), 0, np.full(12, 0.005)), Probe(("cogging", "phase"), 0, np.full(12, 0.02))]
    model = cast(State, SimpleNamespace(tolerances=DECLARED, theta=present))
    friction, phase = opposite(model, given)
    np.testing.assert_allclose(friction.delta, np.r_[0.0025, np.full(11, -0.005)])
    np.testing.assert_allclose(phase.delta, given[1].delta)


@pytest.mark.slow("go1exp/gap/", "go1exp/sim/effects/", "go1exp/sim/env/plant.py", "go1exp/sim/physics/")
def test_what_the_step_errs_by_is_taken_for_no_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps of 1 ms make commands that jump act late, so a fit at them takes a delay for shorter than it is."""
    fine, drawn = delays(monkeypatch, 4)
    coarse, _ = delays(monkeypatch, 1)
    assert np.median(coarse) < HIDDEN_S
    assert abs(np.median(fine) - HIDDEN_S) < 0.6 * abs(np.median(coarse) - HIDDEN_S)
    low, high = np.quantile(drawn, (0.025, 0.975), axis=0)
    assert np.mean((low <= HIDDEN_S) & (high >= HIDDEN_S)) >= 0.9
