"""Smooth motion of a recording, for inverse dynamics: angle, velocity and acceleration without the encoder's steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from go1exp.gap.actuator_net.settings import FitError
from go1exp.logs.recording import Recording

ORDER = 3
"""Order of the polynomial: the lowest whose second derivative may change within the window."""

WINDOW = 0.06
"""s; passes motion to about 20 Hz (half amplitude at 1.2 / window for this order) and removes noise above (chosen)."""


@dataclass(frozen=True, eq=False)
class SmoothMotion:
    """Motion at the recording's time stamps: q rad, qd rad/s, qdd rad/s^2, each ``(T, J)``.

    NaN in the half window at either end, where the polynomial would extrapolate: ``windows`` leaves such rows out.
    """

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


def smooth_motion(recording: Recording, window: float = WINDOW) -> SmoothMotion:
    """Differentiate the measured angles with a Savitzky-Golay filter (third order, symmetric: no lag).

    The angles are resampled linearly to the median step of the clock, filtered, and read off at the recording's own
    time stamps. Only ``q`` is used: the ``qd`` of a drive has already been filtered.

    Args:
        recording: any with ``q``.
        window: length of the filter, s.

    Raises:
        FitError: if the window holds fewer than ORDER + 2 samples or the recording is shorter than it.
        RecordingError: if there is no ``q``.
    """
    t, q = recording.t, recording.joint("q")
    step = float(np.median(np.diff(t))) if len(t) > 1 else window
    length = 2 * round(window / step / 2) + 1
    grid = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-9) + 1)
    if length < ORDER + 2 or len(grid) < length:
        raise FitError(
            f"{recording.meta.episode}: a window of {window:g} s is {length} samples of {len(grid)}; it must hold at "
            f"least {ORDER + 2} and fit into the recording"
        )
    even = np.stack([np.interp(grid, t, column) for column in q.T], axis=1)
    half = length // 2 * step
    edge = half - step / 1000  # so that rounding of the clock removes no sample
    inner = (t >= grid[0] + edge) & (t <= grid[-1] - edge)
    derivatives = []
    for order in range(3):
        smooth = savgol_filter(even, length, ORDER, deriv=order, delta=step, axis=0)
        back = np.stack([np.interp(t, grid, column) for column in smooth.T], axis=1)
        derivatives.append(np.where(inner[:, None], back, np.nan))
    return SmoothMotion(*derivatives)
