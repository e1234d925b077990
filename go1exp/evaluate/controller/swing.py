"""Feet in the air: where they go and how they get there."""

from __future__ import annotations

import numpy as np

from go1exp import robot
from go1exp.evaluate.controller.settings import SwingSettings

SIDES = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, -1.0], [-1.0, 1.0]])
"""(4, 2) signs of x and y of the legs."""

HIPS = SIDES * [robot.HIP_OFFSET[0], robot.HIP_OFFSET[1] + robot.LINK_LENGTHS[0]]
"""(4, 2) points of the trunk below which feet stand: the hips' axes with the abduction offset, trunk frame, m."""

ACROSS = HIPS[:, ::-1] * [-1.0, 1.0]
"""(4, 2) how these points move where the trunk turns by 1 rad/s, m/s."""


def footholds(
    settings: SwingSettings,
    velocity: np.ndarray,
    command: tuple[float, float, float],
    left: np.ndarray,
    stance: float,
    legs: np.ndarray,
) -> np.ndarray:
    """Return where feet are to stand (n, 2), from the trunk's origin, m; all in the axes of the robot's heading.

    Below the hip, where that will be half-way through the coming stance (Raibert 1986), and further out by
    ``velocity_gain`` times what the robot is too fast.

    Args:
        settings: ``velocity_gain``.
        velocity: (3,) of the trunk, m/s.
        command: commanded velocity, m/s, m/s, rad/s.
        left: (n,) time until each foot is to stand, s.
        stance: time that it will stand, s.
        legs: (n,) their numbers.
    """
    vx, vy, _ = velocity.tolist()
    x, y, yaw = command
    hips = HIPS[legs]
    moving = yaw * ACROSS[legs] + [vx, vy]
    too_fast = settings.velocity_gain * np.array([vx - x, vy - y])
    return np.asarray(hips + moving * (left + 0.5 * stance)[:, None] + too_fast)


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
    left = share * (1.0 - share)
    blend, rate = share * share * (3.0 - 2.0 * share), 6.0 / duration * left
    ahead = end - start
    place, velocity = start + blend[:, None] * ahead, rate[:, None] * ahead
    place[:, 2] += 16.0 * height * left * left
    velocity[:, 2] += 32.0 * height / duration * left * (1.0 - 2.0 * share)
    return place, velocity


def solved(jacobians: np.ndarray, vectors: np.ndarray, damping: float = 1e-3) -> np.ndarray:
    """Return joint changes (n, 3, k) that move feet by the columns of ``vectors`` (n, 3, k): damped least squares."""
    transposed = jacobians.transpose(0, 2, 1)
    square = jacobians @ transposed + damping**2 * np.eye(3)
    return np.asarray(transposed @ np.linalg.solve(square, vectors))
