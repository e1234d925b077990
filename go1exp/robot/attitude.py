"""Attitude for an IMU that reports none: the integrated gyro, corrected slowly by the accelerometer."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from go1exp.robot import GRAVITY


def levelled(
    t: np.ndarray, gyro: np.ndarray, acc: np.ndarray, *, seconds: float = 10.0, first: float = 0.5
) -> np.ndarray:
    """Return the attitude ``(T, 4)``, w-x-y-z, body to world, of a complementary filter (Mahony et al. 2008, eq. 32).

    Each step rotates by the gyro, and corrects the angle between measured and estimated vertical with time constant
    ``seconds``. Heading starts at zero and drifts with the gyro. The filter is causal, except for the start.

    Args:
        t: time stamps (T,), s.
        gyro: rad/s (T, 3).
        acc: m/s2 (T, 3), +9.81 in z when level and at rest.
        seconds: time constant with which an error of the vertical decays, s; the longer, the more the gyro counts.
        first: time at the start over which the mean acceleration gives the first vertical, s; one stride, because logs
            may begin in the middle of a walk.
    """
    up = acc[t <= t[0] + first].mean(axis=0)
    # Roll and pitch that bring the mean acceleration onto the vertical; the heading is not observable.
    roll, pitch = np.arctan2(up[1], up[2]), np.arctan2(-up[0], np.hypot(up[1], up[2]))
    rotation = Rotation.from_euler("ZYX", [0.0, pitch, roll])
    rotations = [rotation]
    for k in range(1, len(t)):
        vertical = rotation.as_matrix()[2]
        # the cross product turns the estimated vertical towards the measured one
        rate = gyro[k] + np.cross(acc[k] / GRAVITY, vertical) / seconds
        rotation = rotation * Rotation.from_rotvec(rate * (t[k] - t[k - 1]))
        rotations.append(rotation)
    return Rotation.concatenate(rotations).as_quat(scalar_first=True)


def vertical(quat: np.ndarray) -> np.ndarray:
    """Return the z axis of the world in the body frame, ``(T, 3)``, for attitudes w-x-y-z ``(T, 4)``."""
    return Rotation.from_quat(quat, scalar_first=True).as_matrix()[:, 2]
