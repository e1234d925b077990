"""Feet in the air: where they go and how they get there."""

from __future__ import annotations

import numpy as np

from go1exp import robot

HIPS = np.array([[x * robot.HIP_OFFSET[0], y * (robot.HIP_OFFSET[1] + robot.LINK_LENGTHS[0]), 0.0]
                 for x, y in ((1, -1), (1, 1), (-1, -1), (-1, 1))])  # fmt: skip
"""(4, 3) points of the trunk below which feet stand: hip axes with the abduction offset, trunk frame, m."""


def way(
    start: np.ndarray, end: np.ndarray, height: float, share: np.ndarray, duration: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return place (n, 3), m, and velocity (n, 3), m/s, of feet on their way.

    Horizontally a cubic from rest to rest; vertically the same plus a bump 16 s^2 (1 - s)^2.

    Args:
        start: (n, 3) where each foot left the ground, m.
        end: (n, 3) where it is to stand, m.
        height: of the bump, m.
        share: (n,) of the swing that has passed, 0 to 1.
        duration: of the swing, s.
    """
    s = np.clip(share, 0.0, 1.0)[:, None]
    blend, rate = s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s) / duration
    place, velocity = start + blend * (end - start), rate * (end - start)
    s = s[:, 0]
    place[:, 2] += height * 16.0 * (s * (1.0 - s)) ** 2
    velocity[:, 2] += height * 32.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / duration
    return place, velocity


def solved(jacobians: np.ndarray, vectors: np.ndarray, damping: float = 1e-3) -> np.ndarray:
    """Return joint changes (n, 3, k) that move feet by the columns of ``vectors`` (n, 3, k): damped least squares."""
    transposed = jacobians.transpose(0, 2, 1)
    square = jacobians @ transposed + damping**2 * np.eye(3)
    return np.asarray(transposed @ np.linalg.solve(square, vectors))
