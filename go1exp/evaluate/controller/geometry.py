"""Rotations of one body, quick: some numbers at a time are faster without NumPy."""

from __future__ import annotations

import math

import numpy as np


def matrix(quat: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) of a unit quaternion (4,), w-x-y-z."""
    w, x, y, z = quat.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def skew(w: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) whose product with r (3,) is the cross product of w (3,) and r."""
    x, y, z = w.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def heading(yaw: float) -> np.ndarray:
    """Return the rotation (3, 3) by ``yaw``, rad, about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def wrapped(angle: float) -> float:
    """Return an angle between -pi and pi, rad."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return the angles of R = R_z(yaw) R_y(pitch) R_x(roll), rad."""
    down = max(-1.0, min(1.0, float(rotation[2, 0])))
    return (
        math.atan2(rotation[2, 1], rotation[2, 2]),
        -math.asin(down),
        math.atan2(rotation[1, 0], rotation[0, 0]),
    )
