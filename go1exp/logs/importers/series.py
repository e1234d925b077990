"""Series of readings on one topic: whether two are of one robot, and whether one is of several robots in turn."""

from __future__ import annotations

import numpy as np

HOLE = 1.5  # step, in median ones, from which a message is missing (chosen: between one step and two)
NEAR = 3.0  # departures of a series from its own neighbours, by which another series of the same robot may depart
REVERSED = 12.0  # rad/s; no joint turns out and back so fast within one reading (as in the audit, which loads SciPy)
BACK = 0.2  # share of a jump that may be left after the way back (chosen)
TURNS = 0.05  # share of the readings that must jump back before they are of several robots (chosen; fewer are spikes)


def between(clock: np.ndarray, times: np.ndarray) -> bool:
    """Return whether most ``times`` (K,) lie between regular steps of a ``clock`` (N,), where none is missing."""
    if len(clock) < 3:
        return False
    after = np.searchsorted(clock, times)
    inside = (after > 0) & (after < len(clock))
    after = np.clip(after, 1, len(clock) - 1)
    gap = clock[after] - clock[after - 1]
    return bool(np.mean(inside & (gap < HOLE * np.median(np.diff(clock)))) > 0.5)


def one_motion(clock: np.ndarray, x: np.ndarray, times: np.ndarray, y: np.ndarray) -> bool:
    """Return whether readings ``y`` (K, J) at ``times`` (K,) are of the motion of ``x`` (N, J) at ``clock`` (N,).

    They are if they lie about as near to the line between the readings of x beside them as every second of those does.
    """
    inside = (times >= clock[0]) & (times <= clock[-1])
    if len(clock) < 3 or not inside.any():
        return False
    spread = _off_line(clock[::2], x[::2], clock[1::2], x[1::2])
    return _off_line(clock, x, times[inside], y[inside]) <= NEAR * spread + 1e-9


def _off_line(clock: np.ndarray, x: np.ndarray, times: np.ndarray, y: np.ndarray) -> float:
    """Return the mean distance of ``y`` (K, J) at ``times`` (K,) from the line through ``x`` (N, J)."""
    line = np.stack([np.interp(times - clock[0], clock - clock[0], column) for column in x.T], axis=1)
    return float(np.linalg.norm(y - line, axis=1).mean())


def taking_turns(t: np.ndarray, x: np.ndarray) -> tuple[float, int, float]:
    """Return the share of readings ``x`` (T, J) at ``t`` (T,), s, that jump and are back, and joint and median of it.

    The share is 0 where fewer jump than where several robots are read in turn.
    """
    if len(t) < 3 or t[-1] <= t[0]:
        return 0.0, 0, 0.0
    steps = np.abs(np.diff(x, axis=0))
    step = np.maximum(np.diff(t), (t[-1] - t[0]) / (len(t) - 1))  # stamps of several publishers may nearly agree
    fast = steps > REVERSED * step[:, None]
    jumps = fast[1:] & fast[:-1] & (np.abs(x[2:] - x[:-2]) < BACK * steps[1:])
    share = float(np.mean(jumps.sum(axis=1) >= min(2, x.shape[1])))  # a single joint may be misread
    joint = int(jumps.sum(axis=0).argmax())
    return (share, joint, float(np.median(steps[1:, joint][jumps[:, joint]]))) if share >= TURNS else (0.0, 0, 0.0)
