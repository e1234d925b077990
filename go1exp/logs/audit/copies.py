"""Columns that hold another quantity: a target that is the angle, a torque that is the command, a derived speed.

Two sensors never agree to the last digit. What was computed from a channel repeats its noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import combinations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

import go1exp.logs.audit.limits as limits
import go1exp.logs.audit.signals as signals
from go1exp.logs.audit.report import Finding, Verdict
from go1exp.logs.audit.signals import COMMANDS, Log, finding
from go1exp.logs.recording import joint_channel

COMMANDED = "it is the commanded torque and says nothing of the actuator"
MEANING = {
    ("q_target", "q"): "the measured angle is in the place of the target",
    ("tau_est", "tau_cmd"): COMMANDED,
}
"""What a copy of the second quantity in a column of the first one means."""
TAPS = 9
"""Angles from which a derived speed is sought, its own row in the middle."""

Prediction = tuple[np.ndarray, float]
"""A channel (T,) computed from an angle, NaN where unknown, and by how much noise of the angle counts in it."""


def copies(log: Log) -> Iterator[Finding]:
    """Find columns that repeat another, speeds that are differences of the angle, and torques that are the PD law."""
    copied = set[str]()
    for first, second in combinations(log.quantity, 2):
        for f in _equal(log, *sorted((first, second), key=lambda c: log.quantity[c] not in ("q_target", "tau_est"))):
            copied.add(f.channel)
            yield f
    for joint in log.joints:
        for name, share, message in _derived(log, joint):
            if share > limits.DERIVED and name not in copied:
                copied.add(name)
                verdict = _weight(log, (log.quantity[name], ""))
                yield finding("copy", name, verdict, share, "", f"{message} in {share:.1%} of the rows that change")


def _derived(log: Log, joint: str) -> Iterator[tuple[str, float, str]]:
    """Yield columns of a joint, in which share of the rows each repeats the noise of another, and what that means."""
    names = [joint_channel(kind, joint) for kind in ("q", "qd", "q_target", "tau_est", "tau_cmd")]
    q, qd, target, tau, command = (log.recording.channels.get(name) for name in names)
    one = np.ones((len(log.t), 1))
    if command is not None and tau is not None and (floor := _floor(log, names[3])):
        share = _repeated(log, command, [_fitted(command, tau[:, None], one)], floor, tau, 0.0)
        yield names[3], share, f"is {names[4]} up to a factor ({COMMANDED})"
    if q is None or not (floor := _floor(log, names[0])):
        return  # without noise of the angle, what is computed from it looks as if measured
    if target is not None:
        share = _repeated(log, target, [_fitted(target, q[:, None], one)], floor, q, 0.0)
        yield names[2], share, f"is {names[0]} up to a factor and an offset"
    if qd is not None:
        share = _repeated(log, qd, _slopes(log.t, q, qd), floor, q, log.steps[names[1]])
        yield names[1], share, f"was computed from {names[0]}, whose noise it repeats"
    if tau is not None and target is not None and abs(signals.correlation(q, target)) < limits.ALIKE:
        others = np.column_stack([target, one, *([] if qd is None else [qd])])
        laws = [_fitted(np.roll(tau, -late), q[:, None], others) for late in range(limits.LAW_ROWS)]
        shares = [
            _repeated(log, np.roll(tau, -late), [law], floor, q, log.steps[names[3]]) for late, law in enumerate(laws)
        ]
        yield names[3], max(shares), f"is a linear law of {names[2]} and {names[0]} ({COMMANDED})"


def _equal(log: Log, name: str, other: str) -> Iterator[Finding]:
    """Report columns that are equal in rows where they change; what may be a target or a torque also a row apart."""
    kinds = log.quantity[name], log.quantity[other]
    if "t" in kinds or (kinds[0] == kinds[1] and kinds[0] in COMMANDS) or any(k.startswith("base_") for k in kinds):
        return  # joints may have one command, and a simulator's truth may be its reading
    ideal = not all(_floor(log, c) for c in (name, other) if log.quantity[c] not in COMMANDS)
    if ideal and kinds not in MEANING:
        return
    a, b = (log.recording.channels[c].astype(float) for c in (name, other))
    span, related = float(min(np.ptp(a), np.ptp(b))), kinds in MEANING
    rounding = 0.51 * max(log.steps.get(c, 0.0) for c in (name, other)) if related else 0.0
    close = min(max(rounding, 1e-6 * span), 2e-3 * span)
    part = slice(1, -1, max(1, len(a) // limits.COPY_ROWS))
    for late in (0, 1, -1) if related else (0,):
        moved = np.roll(b, late)
        if np.mean(np.abs(a[part] - moved[part]) <= close) < limits.COPIED / 2:
            continue  # most pairs, by a part of their rows
        each = [np.append(False, np.diff(x) != 0.0) for x in (a, moved)]
        either, both = (each[0] | each[1]) & log.on, each[0] & each[1] & log.on
        same = both & (np.abs(a - moved) <= close)
        share = float(same.sum() / max(1, either.sum()))
        if share > limits.COPIED and same.sum() >= limits.ENOUGH * (1.0 if share < limits.DERIVED else 0.2):
            row = f" of the row {'before' if late > 0 else 'after'}" if late else ""
            why = MEANING.get(kinds, "one of the two holds another quantity")
            message = f"equals {other}{row} in {share:.1%} of the rows in which they change: {why}"
            ideal_drive = ideal and kinds == ("tau_est", "tau_cmd")
            yield finding("copy", name, "ok" if ideal_drive else _weight(log, kinds), share, "", message)
            return


def _weight(log: Log, kinds: tuple[str, str]) -> Verdict:
    """Return how bad a copy is: a torque, or a target without a gain, spoils no other channel."""
    idle = kinds[0] == "q_target" and log.recording.meta.kp is not None and not any(log.recording.meta.kp)
    return "suspect" if kinds in (("tau_est", "tau_cmd"), ("tau_est", ""), ("qd", "")) or idle else "bad"


def _floor(log: Log, channel: str) -> float:
    """Return the noise of a measured column with its quantisation; 0 in an ideal simulation."""
    floor = float(np.hypot(log.noise(channel), log.steps[channel] / np.sqrt(12.0)))
    return floor if floor > limits.IDEAL * float(np.ptp(log.recording.channels[channel])) else 0.0


def _fitted(y: np.ndarray, angles: np.ndarray, others: np.ndarray) -> Prediction:
    """Fit most of a channel (T,), all but what is clipped, by ``angles`` (T, K) and ``others`` (T, L), linearly."""
    inputs = np.column_stack([angles, others])
    use = np.flatnonzero(np.isfinite(inputs).all(axis=1))
    use = use[:: max(1, len(use) // limits.COPY_ROWS)]
    best = use
    for _ in range(3):
        factors = np.linalg.lstsq(inputs[best], y[best], rcond=None)[0]
        off = np.abs(inputs[use] @ factors - y[use])
        best = use[off <= np.quantile(off, limits.FITTED)]
    return inputs @ factors, float(np.linalg.norm(factors[: angles.shape[1]]))


def _slopes(t: np.ndarray, q: np.ndarray, qd: np.ndarray) -> Iterator[Prediction]:
    """Yield speeds (T,) that the angles give: by differences over the clock, and by the best linear filter."""
    step = np.diff(q) / np.diff(t)
    dt = float(np.median(np.diff(t)))
    yield np.append(np.nan, step), np.sqrt(2.0) / dt
    yield np.append(step, np.nan), np.sqrt(2.0) / dt
    yield np.gradient(q, t), np.sqrt(0.5) / dt
    half = TAPS // 2
    around = np.full((len(q), TAPS), np.nan)
    around[half:-half] = sliding_window_view(q, TAPS)
    yield _fitted(qd, around, np.column_stack([np.ones(len(q)), np.append(0.0, qd[:-1])]))


def _repeated(
    log: Log, y: np.ndarray, predictions: Iterable[Prediction], floor: float, source: np.ndarray, step: float
) -> float:
    """Return in which share of rows ``y`` (T,) is nearer to a prediction than the noise of its source allows.

    Args:
        log: of the channels.
        y: channel (T,).
        predictions: from ``source``; the best one counts.
        floor: noise of ``source``.
        source: channel (T,) from which ``y`` may have been computed; rows count in which it changes.
        step: quantisation of ``y``.
    """
    rows = np.append(False, np.diff(source) != 0.0) & log.on
    shares = [0.0]
    for predicted, gain in predictions:
        whole, noise = np.isfinite(predicted), floor * gain
        known = rows & whole
        close = max(limits.SAME_NOISE * noise, 0.51 * step if step < noise else 0.0)
        as_rough = _roughness(y[whole]) > 0.5 * _roughness(predicted[whole])  # otherwise the noise is not in y
        if known.sum() >= limits.ENOUGH and np.ptp(y[known]) > 0.0 and as_rough:
            shares.append(float(np.mean(np.abs(y[known] - predicted[known]) < close)))
    return max(shares)


def _roughness(x: np.ndarray) -> float:
    """Return the median size of third differences of a channel (T,), of which smooth motion has next to none."""
    return float(np.median(np.abs(np.diff(x, 3))))
