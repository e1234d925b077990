"""Whether values of a cause may be the same at all joints: differences against their own errors."""

from __future__ import annotations

import numpy as np
import pytest

from go1exp.config.schema.registry import members
from go1exp.gap.search import thresholds, tolerances
from go1exp.gap.search.single_cause import differ
from go1exp.sim.effects.tolerances import declared

TOLERANCE = declared(("encoder_offset", "offset")).tolerance
WALK = 0.001 * np.array([9.5, 8.3, 9.6, 9.6, 9.6, 9.6, 11.4, 9.6, 6.9, 9.6, 9.7, 9.5])
"""Offsets like those that walks gave, rad."""

EVEN = np.ones(12)


def drawn(values: np.ndarray, sd: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return resampled values (200, J) with these errors."""
    return values + sd * np.random.default_rng(seed).standard_normal((200, len(values)))


def test_values_within_one_tolerance_are_alike_however_well_they_are_known() -> None:
    close = 0.009 + 0.0029 * np.linspace(0.0, 1.0, 12)
    assert not differ(close, drawn(close, 1e-7 * EVEN), TOLERANCE)


def test_a_larger_difference_counts_only_beyond_its_own_errors() -> None:
    assert np.ptp(WALK) > TOLERANCE
    assert not differ(WALK, drawn(WALK, 0.0009 * EVEN), TOLERANCE)
    assert differ(WALK, drawn(WALK, 0.0001 * EVEN), TOLERANCE)
    assert differ(WALK, np.tile(WALK, (200, 1)), TOLERANCE)


def test_a_joint_of_which_little_is_known_hides_no_others() -> None:
    values, sd = np.full(12, 0.009), 0.0002 * EVEN
    values[4], sd[4] = 0.02, 0.01
    assert not differ(values, drawn(values, sd), TOLERANCE)
    values[7] = 0.014
    assert differ(values, drawn(values, sd), TOLERANCE)


def test_errors_that_joints_share_are_none_of_a_difference() -> None:
    shared = 0.01 * np.random.default_rng(1).standard_normal((200, 1))
    assert differ(WALK, drawn(WALK, 0.0001 * EVEN) + shared, TOLERANCE)


def test_where_resamples_lie_does_not_matter_but_how_far_they_spread() -> None:
    moved = drawn(WALK, 0.0001 * EVEN) + 0.003 * np.arange(12)
    assert differ(WALK, moved, TOLERANCE)
    assert not differ(WALK, drawn(WALK, 0.0009 * EVEN) + 0.003 * np.arange(12), TOLERANCE)


@pytest.mark.parametrize("spread", [0.0, 1.0], ids=["one value", "a tolerance apart"])
def test_causes_that_are_alike_are_refused_no_more_often_than_said(spread: float) -> None:
    rng = np.random.default_rng(2)
    sd = 0.001 * rng.uniform(0.3, 3.0, 12)
    true = 0.009 + spread * TOLERANCE * (np.arange(12) % 2)
    trials = [differ(true + sd * rng.standard_normal(12), drawn(true, sd, k), TOLERANCE) for k in range(300)]
    assert np.mean(trials) <= thresholds.SHARED_LEVEL + 0.02


def test_what_one_fault_may_give_to_all_joints_is_known_of_the_effects_themselves() -> None:
    alike = {name for name in members("effect") if tolerances.identification(name).uniform}
    assert alike == {"strength", "kp_scale", "link_mass", "encoder_offset"}
