"""Targets that leave those beside them for a single row and are back at once, and that no joint obeys."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

import go1exp.logs.audit.limits as limits


def excursions(t: np.ndarray, target: np.ndarray, out: np.ndarray, answers: Iterable[np.ndarray]) -> np.ndarray:
    """Return which targets (T,), rad, at ``t`` (T,), s, cannot have been commanded.

    A policy may step its targets by any size at every row. So a row counts only where the targets beside it are quiet,
    where it is short and others are held, or where it lies far outside all others.

    Args:
        t: clock (T,), s.
        target: targets of a joint (T,), rad.
        out: by how much each departs from both neighbours in one direction (T,), rad.
        answers: readings (T,) of that joint, of which none may answer.
    """
    dt = float(np.median(np.diff(t)))
    steps = np.abs(np.diff(target))
    back = np.pad(np.abs(target[2:] - target[:-2]), 1)
    whole = np.pad(t[2:] - t[:-2] < 3.0 * dt, 1)
    able = whole & (out > limits.REVERSED * dt)
    rows = able & (_in_quiet(steps, out, back) | _between_held(target, out, dt) | _far_outside(target, out, back))
    few = limits.LEFT[0] <= rows.sum() <= limits.LEFT[1] * len(t)
    return rows if few and not _obeyed(t, target, rows, answers) else np.zeros(len(t), dtype=bool)


def _in_quiet(steps: np.ndarray, out: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return which targets (T,) leave by far more than they else step (T - 1,), and by more than those beside them."""
    if not steps.any():
        return np.zeros(len(out), dtype=bool)
    padded = np.pad(steps, 4)  # step k is number k + 4, between rows k and k + 1; a row's own are k - 1 and k
    beside = np.max([padded[k : k + len(out)] for k in (0, 1, 2, 5, 6, 7)], axis=0)
    usual = limits.LEFT_STEPS * float(np.quantile(steps[steps > 0.0], 0.95))
    return (out > usual) & (np.maximum(beside, back) < limits.LEFT_REST * out)


def _between_held(target: np.ndarray, out: np.ndarray, dt: float) -> np.ndarray:
    """Return which targets (T,) last for a row of less time than a command takes, where others are held for rows."""
    edges = np.flatnonzero(np.diff(target)) + 1
    lengths = np.diff([0, *edges, len(target)])
    if not (lengths > 1).any():
        return np.zeros(len(target), dtype=bool)
    rows = np.zeros(len(target), dtype=bool)
    if dt > limits.SHORT_STEP or np.quantile(lengths[lengths > 1], 0.1) < limits.HELD_ROWS:
        return rows
    single = np.zeros(len(target), dtype=bool)
    single[np.append(0, edges)[lengths == 1]] = True
    rows[1:-1] = single[1:-1] & (target[2:] == target[:-2])
    if rows.sum() >= limits.LEFT[0]:  # the same at the end of what was held
        rows |= single & (out > 0.5 * float(np.median(out[rows])))
    return rows


def _far_outside(target: np.ndarray, out: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return which targets (T,) lie outside all usual ones by far, and those before and after not."""
    low, high = np.quantile(target, (0.02, 0.98))
    least = max(limits.LEFT_RANGE[0], limits.LEFT_RANGE[1] * float(high - low))
    beyond = np.maximum(target - high, low - target)
    return (beyond > least) & (back < 0.5 * out)


def _obeyed(t: np.ndarray, target: np.ndarray, rows: np.ndarray, answers: Iterable[np.ndarray]) -> bool:
    """Return whether readings (T,) follow the direction in which targets (T,) leave in ``rows`` (T,)."""
    which = np.flatnonzero(rows)
    way = np.sign(target[which] - target[which - 1])
    most = max(1, round(limits.TORQUE_LAG / float(np.median(np.diff(t)))))
    for x in answers:
        for lag in range(most + 1):
            change = x[1 + lag :] - x[: len(x) - 1 - lag]  # from the row before to ``lag`` rows after each row
            inside = which + lag < len(x)
            error = float(np.std(change)) / np.sqrt(max(1, inside.sum()))
            if inside.any() and np.mean(way[inside] * change[which[inside] - 1]) > limits.OBEYED * error > 0.0:
                return True
    return False
