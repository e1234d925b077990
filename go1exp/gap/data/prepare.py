"""What makes recordings comparable: what is kept and chosen, and speeds and clocks where they are missing."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import savgol_filter

from go1exp.gap.result import GapSettings
from go1exp.logs.recording import Recording

SMOOTH = 5
"""Samples of the parabola whose slope is the speed where none was recorded, or none that can be trusted."""

CLOCK_SPEED = 0.5
"""Speed, rad/s, from which a moving joint tells the time."""

CLOCK_ROWS = 401
"""Rows around a step over which the clock hardly changes its rate."""

MOST_WINDOWS = 360
"""Windows beyond which more would only cost time; they are then spread over all recordings."""

MOST_STEPS = 250_000
"""The same as physics steps of all windows, times joints of a group: some minutes of work."""

HINT = "give the robot of the logs: model=NAME or model=FILE.yaml (go1exp list model, docs/own_robot.md)"
"""What to do where logs are of another robot than the model."""

TELLING = ("delay", "torque")
"""Checks of the audit that a missing effect may fail; they say nothing against the log."""


@dataclass(frozen=True)
class Ready:
    """Recordings that can be compared with a robot.

    Attributes:
        recordings: in the robot's order of joints, with gains, commands and speeds.
        settings: with windows that suit the robot, as far apart as their number asks.
        ignored: quantities that are present and not compared.
        warnings: what was chosen, a sentence each.
    """

    recordings: tuple[Recording, ...]
    settings: GapSettings
    ignored: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def clock_of_speeds(t: np.ndarray, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return times (T,), s, at which angles (T, J) change as speeds (T, J) say; those of ``t`` where nothing moves.

    Each step is the least-squares ratio of change to mean speed over all joints, drawn to that of the seconds around it
    as if one joint moved there at ``CLOCK_SPEED``. A factor common to all speeds goes into the clock.
    """
    change, mean = np.diff(q, axis=0), 0.5 * (qd[1:] + qd[:-1])
    top, bottom = (change * mean).sum(1), (mean**2).sum(1)
    step, whole = np.diff(t), np.ones(min(CLOCK_ROWS, len(t) - 1))
    near = [np.convolve(x, whole, "same") for x in (top, bottom, step * CLOCK_SPEED**2)]
    about = (near[0] + near[2]) / (near[1] + CLOCK_SPEED**2 * np.convolve(np.ones_like(step), whole, "same"))
    steps = (top + about * CLOCK_SPEED**2) / (bottom + CLOCK_SPEED**2)
    return np.concatenate([t[:1], t[0] + np.cumsum(steps.clip(0.3 * about, 3.0 * about))])


def noise_in_time(recordings: Sequence[Recording]) -> np.ndarray:
    """Return the noise of the angles (J,), rad, where samples are uneven in time: about quartics through nine of them.

    The median of root mean squares over all places, as such a robot may never be at rest.
    """
    size, degree = 9, 4
    noises = []
    for r in recordings:
        t, q = (sliding_window_view(x, size, axis=0)[::3] for x in (r.t, r.joint("q")))
        x = (t - t.mean(1, keepdims=True)) / np.ptp(t, axis=1)[:, None]
        basis = np.linalg.qr(x[..., None] ** np.arange(degree + 1))[0]  # P 9 5
        rest = q - np.einsum("pab,pjb->pja", basis, np.einsum("pab,pja->pjb", basis, q))
        noises.append(np.sqrt((rest**2).sum(2) / (size - degree - 1)))
    return np.asarray(np.median(np.concatenate(noises), axis=0)).clip(1e-9)


def slope(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the speed (T,), rad/s, of angles (T,) at times (T,): of a parabola through a few samples around each."""
    size = min(SMOOTH, len(q) - (1 - len(q) % 2))
    if size < 3:
        return np.zeros_like(q)
    change, step = (savgol_filter(x, size, 2, deriv=1) for x in (q, t))
    return np.asarray(change / step)


def spaced(recordings: Sequence[Recording], settings: GapSettings, joints: int) -> tuple[GapSettings, list[str]]:
    """Return settings with so many windows as cost no more than minutes, and what there is to say about it."""
    total = sum(float(r.t[-1] - r.t[0]) for r in recordings)
    most = MOST_STEPS * settings.physics_dt / (settings.burn_s + settings.window_s) / joints
    stride = max(settings.stride_s, total / min(most, MOST_WINDOWS))
    if stride == settings.stride_s:
        return settings, []
    warning = f"Of {total:.0f} s, {settings.window_s:g} s in every {stride:.3g} s are compared."
    return dataclasses.replace(settings, stride_s=stride), [warning]
