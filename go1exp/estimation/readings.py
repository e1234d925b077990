"""One reading of all sensors as a row of numbers: the filter's only input, in one order everywhere."""

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
axes), joint angles rad, velocities rad/s and torques N m, foot forces N. What the settings do not use may be NaN."""


class Status(IntEnum):
    """What the filter did with a sample."""

    OK = 0
    STARTED = 1
    """The first good sample: speed is taken as zero within ``initial_speed``, the place as the origin."""
    RESTARTED = 2
    """It came after a gap longer than ``longest_gap``: the place is kept, speed and feet are learnt anew."""
    LATE = 3
    """Not newer than the last one; it was left out. The tenth in a row restarts: then the clock had jumped."""
    INVALID = 4
    """Not finite, beyond any sensor's range, or no rotation; it was left out."""


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
    """Return one sample ``(51,)``; what is left out is NaN."""
    row = np.full(WIDTH, np.nan)
    row[T], row[QUAT], row[GYRO], row[ACC], row[Q] = t, quat, gyro, acc, q
    for place, values in ((QD, qd), (TAU, tau), (FOOT_FORCE, foot_force)):
        if values is not None:
            row[place] = values
    return row
