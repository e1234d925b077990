"""The bounded solver of the gap's linear models."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from go1exp.gap.search import tolerances


def limits(low: float, high: float, weight: float, size: int) -> tolerances.Bounds:
    ones = np.ones(size)
    return tolerances.Bounds(low * ones, high * ones, 0.0 * ones, weight * ones)


def test_it_is_bounded_least_squares() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        columns, wanted = rng.standard_normal((40, 8)), rng.standard_normal(40)
        some = limits(-0.1, 0.15, 2.0, 8)
        x = tolerances.solve(columns.T @ columns, columns.T @ wanted, some)
        rows = np.vstack([columns, np.sqrt(2.0) * np.eye(8)])
        slow = lsq_linear(rows, np.concatenate([wanted, np.zeros(8)]), (-0.1, 0.15), tol=1e-12).x
        np.testing.assert_allclose(x, slow, atol=1e-6)


def test_what_may_not_move_stays_and_the_rest_makes_up_for_it() -> None:
    rng = np.random.default_rng(1)
    columns, wanted, fixed = rng.standard_normal((40, 6)), rng.standard_normal(40), np.array([0.0, 0.07])
    some = limits(-0.1, 0.15, 0.0, 6)
    some.low[:2] = some.high[:2] = fixed
    x = tolerances.solve(columns.T @ columns, columns.T @ wanted, some)
    np.testing.assert_array_equal(x[:2], fixed)
    slow = lsq_linear(columns[:, 2:], wanted - columns[:, :2] @ fixed, (-0.1, 0.15), tol=1e-12).x
    np.testing.assert_allclose(x[2:], slow, atol=1e-6)
    some.low[:] = some.high[:] = 0.02
    np.testing.assert_allclose(tolerances.solve(columns.T @ columns, columns.T @ wanted, some), 0.02)


def test_columns_that_say_the_same_but_for_rounding_are_no_crash() -> None:
    """Their products, summed in float32, can be indefinite by more than the prior holds."""
    matrix = 1e8 * np.array([[1.0, 1.0 + 5e-8, 0.0], [1.0 + 5e-8, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.linalg.eigvalsh(matrix).min() < -1.0
    x = tolerances.solve(matrix, 1e8 * np.array([0.3, 0.3, 0.2]), limits(-1.0, 1.0, 1e-6, 3))
    np.testing.assert_allclose([x[0] + x[1], x[2]], [0.3, 0.2], atol=1e-5)


def test_what_is_indefinite_for_another_reason_is_said() -> None:
    with pytest.raises(np.linalg.LinAlgError, match="by far more than their rounding"):
        tolerances.solve(np.array([[1.0, 2.0], [2.0, 1.0]]), np.zeros(2), limits(-1.0, 1.0, 1e-9, 2))
