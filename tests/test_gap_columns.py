"""Columns of the linear model that are learned from steps, or borrowed, in place of measured ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from go1exp.gap.comparison import compare, robot_from
from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import GapSettings
from go1exp.gap.score.likelihood import log_chi2
from go1exp.gap.score.linear import Layout, Table, borrowed, corrected
from go1exp.gap.search import state as search_state
from go1exp.gap.search import tolerances
from go1exp.gap.search.fit import descend, fit
from go1exp.gap.search.state import State
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


def test_a_corrected_model_says_what_the_step_did_and_keeps_what_it_did_not_try(hung: State) -> None:
    linear = hung.linear({}, hung.splits.train)
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


def test_a_step_of_nothing_teaches_nothing(hung: State) -> None:
    linear = hung.linear({}, hung.splits.train)
    layout = Layout.from_probes(hung.machine, linear.probes)
    same = corrected(linear, layout, np.zeros(layout.size), np.ones(layout.size), linear.residual)
    np.testing.assert_array_equal(same.columns, linear.columns)


def test_borrowed_columns_are_those_that_were_measured_in_the_units_of_now(hung: State) -> None:
    linear = hung.linear({}, hung.splits.train)
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


def test_columns_that_learn_come_as_far_as_columns_that_stay(hung: State) -> None:
    linear = hung.linear({}, hung.splits.train)
    (stays,) = fit(hung.scorer, [hung.model({})], linear, 4, hung.dt)
    learns = descend(hung.scorer, hung.model({}), linear, 4, hung.dt)
    assert stays.chi2 is not None
    assert learns.chi2 is not None
    assert float(log_chi2(learns.chi2).mean()) <= float(log_chi2(stays.chi2).mean()) + 0.003


def test_a_settled_model_keeps_columns_as_they_were_measured(hung: State) -> None:
    once = hung.converged(1)
    np.testing.assert_array_equal(once.table.columns, hung.linear({}, hung.splits.train).columns)
    residual = hung.linear(once.theta, hung.splits.train).residual
    np.testing.assert_allclose(once.table.residual, residual, atol=1e-3 * np.abs(residual).max())


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
