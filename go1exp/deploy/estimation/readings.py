"""One sample of all sensors as a row of numbers, the only input of the filter."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

T = 0
QUAT = slice(1, 5)
GYRO = slice(5, 8)
ACC = slice(8, 11)
Q = slice(11, 23)
QD = slice(23, 35)
TAU = slice(35, 47)
FOOT_FORCE = slice(47, 51)
WIDTH = 51
"""Columns of a sample: time s, attitude w-x-y-z (trunk to world), gyro rad/s, specific force m/s2 (both in the trunk's
axes), joint angles rad, velocities rad/s and torques N m, foot forces N. Columns that are not used may be NaN."""


class Status(IntEnum):
    """What the filter did with a sample."""

    OK = 0
    STARTED = 1
    """The first valid sample: speed is zero within ``initial_speed``, position is the origin."""
    RESTARTED = 2
    """It came after a gap longer than ``longest_gap``: the position is kept, speed and feet are initialised again."""
    LATE = 3
    """Not newer than the last one; it was left out. The tenth in a row restarts the filter: the clock has jumped."""
    INVALID = 4
    """Not finite, beyond the range of any sensor, or not a unit quaternion; it was left out."""


def sample(
    t: float,
    quat: np.ndarray,
    gyro: np.ndarray,
    acc: np.ndarray,
    q: np.ndarray,
    qd: np.ndarray | None = None,
    tau: np.ndarray | None = None,
    foot_force: np.ndarray | None = None,
) -> np.ndarray:
    """Return one sample ``(51,)``; arguments that are not given become NaN."""
    row = np.full(WIDTH, np.nan)
    row[T], row[QUAT], row[GYRO], row[ACC], row[Q] = t, quat, gyro, acc, q
    for place, values in ((QD, qd), (TAU, tau), (FOOT_FORCE, foot_force)):
        if values is not None:
            row[place] = values
    return row
