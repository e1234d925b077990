"""Counters that wrap: readings that jump by their full range and go on from its other end."""

from __future__ import annotations

import numpy as np

import go1exp.logs.audit.limits as limits

Turns = tuple[np.ndarray, float]
"""Turns (T,) of the counter to be added to each reading, mostly 0, and the range of the counter."""


def wrapped_angle(t: np.ndarray, x: np.ndarray, fastest: float) -> Turns | None:
    """Return how angles (T,) wrap; None if they do not, or if anything else jumps.

    Every jump faster than ``fastest``, rad/s, must lead from one end of all readings to the other. And what is read in
    one turn must lie beyond what is read in another, as spikes and offsets do not.
    """
    steps, span = np.diff(x), float(np.ptp(x))
    jumps = np.abs(steps) > fastest * np.diff(t)
    if jumps.sum() < 2 or np.abs(steps[jumps]).min() < limits.WRAPPED * span:
        return None
    largest = float(np.abs(steps[~jumps]).max(initial=0.0))
    usual = float(np.median(np.abs(steps[~jumps]))) if not jumps.all() else 0.0
    whole = float(np.median(np.abs(steps[jumps]))) + usual
    turns = np.append(0.0, -np.cumsum(np.where(jumps, np.sign(steps), 0.0)))
    values, counts = np.unique(turns, return_counts=True)
    turns, values = turns - values[np.argmax(counts)], values - values[np.argmax(counts)]
    y = x + turns * whole
    ends = np.array([[y[turns == k].min(), y[turns == k].max()] for k in values])
    apart = np.all(ends[1:, 0] > ends[:-1, 1] - 2.0 * largest)
    return (turns, whole) if apart and np.ptp(y) > limits.MOVES * largest else None


def wrapped_speed(x: np.ndarray, slope: np.ndarray) -> Turns | None:
    """Return how speeds (T,) wrap; None if they do not.

    Such speeds jump by more than a half of their range where they begin to be off the ``slope`` (T,) of the angle, they
    are off by whole ranges, never by about a half, and the slope is then outside all that is read.
    """
    span = float(np.ptp(x))
    if span == 0.0:
        return None
    turns = np.round((slope - x) / span)
    wrong = turns != 0.0
    if wrong.sum() < limits.LOST_ROWS:
        return None
    whole = float(np.median((slope - x)[wrong] / turns[wrong]))
    near = np.abs(slope - x - turns * whole) < limits.HALF_RANGE * whole
    sudden = np.abs(np.diff(x))[np.diff(turns) != 0.0] > 0.5 * span
    outside = (slope[wrong] < x.min()) | (slope[wrong] > x.max())
    exact = min(float(a.mean()) for a in (near, near[wrong], sudden, outside)) > limits.EXACT
    return (turns, whole) if exact and abs(whole / span - 1.0) < limits.SAME_RANGE else None
