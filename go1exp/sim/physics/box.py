"""MuJoCo's solver of quadratic programs within bounds."""

from __future__ import annotations

import mujoco
import numpy as np


def minimum(matrix: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the minimum (n,) of x' A x / 2 + slope' x within bounds (``mju_boxQP``, a projected Newton method).

    Args:
        matrix: A (n, n), positive definite.
        slope: at x = 0 (n,).
        low: bounds (n,), below ``high`` each.
        high: bounds (n,).

    Raises:
        LinAlgError: if there is none.
    """
    size = len(slope)
    x, factor, free = np.zeros(size).clip(low, high), np.zeros((size, size + 7)), np.zeros(size, dtype=np.int32)
    if size and mujoco.mju_boxQP(x, factor, free, matrix, slope, low, high) < 0:
        raise np.linalg.LinAlgError("MuJoCo found no minimum within bounds")
    return x
