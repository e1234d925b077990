"""Attitude for an IMU that reports none: the gyro, levelled slowly by the accelerometer."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

GRAVITY = 9.81
"""m/s2"""


def levelled(
    t: np.ndarray, gyro: np.ndarray, acc: np.ndarray, *, seconds: float = 10.0, first: float = 0.5
) -> np.ndarray:
    """Return the attitude ``(T, 4)``, w-x-y-z, body to world, of a complementary filter (Mahony et al. 2008, eq. 32).

    Each step turns by the gyro, and by the angle between measured and known vertical over ``seconds``. Heading starts
    at zero and drifts with the gyro. What lies before a sample alone decides it, but for the start.

    Args:
        t: time stamps (T,), s.
        gyro: rad/s (T, 3).
        acc: m/s2 (T, 3), +9.81 in z when level and at rest.
        seconds: time in which an error of the vertical decays; longer trusts the gyro more.
        first: the time at the start whose mean acceleration gives the first vertical, s; a stride, as logs may begin in
            the middle of a walk.
    """
    up = acc[t <= t[0] + first].mean(axis=0)
    roll, pitch = np.arctan2(up[1], up[2]), np.arctan2(-up[0], np.hypot(up[1], up[2]))
    rotation = Rotation.from_euler("ZYX", [0.0, pitch, roll])
    rotations = [rotation]
    for k in range(1, len(t)):
        vertical = rotation.as_matrix()[2]
        rate = gyro[k] + np.cross(acc[k] / GRAVITY, vertical) / seconds
        rotation = rotation * Rotation.from_rotvec(rate * (t[k] - t[k - 1]))
        rotations.append(rotation)
    return Rotation.concatenate(rotations).as_quat(scalar_first=True)


def vertical(quat: np.ndarray) -> np.ndarray:
    """Return the world's z axis in the body's, ``(T, 3)``, of attitudes w-x-y-z ``(T, 4)``."""
    w, x, y, z = quat.T
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
