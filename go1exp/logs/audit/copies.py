"""Columns that hold another quantity: a target that is the angle, a torque that is the command, a derived speed.

Two sensors never agree to the last digit. What was computed from a channel repeats its noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
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
TAPS = 9  # angles from which a derived speed is sought, its own row in the middle

Prediction = tuple[np.ndarray, float]
"""A channel (T,) computed from an angle, NaN where unknown, and by how much noise of the angle counts in it."""


def copies(log: Log) -> Iterator[Finding]:
    """Find columns that repeat another, speeds that are differences of the angle, and torques that are the PD law."""
    copied = set[str]()
    for pair in combinations(log.quantity, 2):
        # The one that may be a copy comes first.
        for f in _equal(log, *sorted(pair, key=lambda c: log.quantity[c] not in ("q_target", "tau_est"))):
            copied.add(f.channel)
            yield f
    for joint in log.joints:
        for name, share, message in _derived(log, joint):
            if share > limits.DERIVED and name not in copied:
                copied.add(name)
                verdict = _weight(log, (log.quantity[name], ""))
                yield finding("copy", name, verdict, share, "", f"{message} in {share:.1%} of the rows that change")


def _weight(log: Log, kinds: tuple[str, str]) -> Verdict:
    """Return how bad a copy is: a torque, or a target without a gain, spoils no other channel."""
    idle = kinds[0] == "q_target" and log.recording.meta.kp is not None and not any(log.recording.meta.kp)
    return "suspect" if kinds in (("tau_est", "tau_cmd"), ("tau_est", ""), ("qd", "")) or idle else "bad"


# ---------------------------------------------------------------------- equal columns


def _equal(log: Log, name: str, other: str) -> Iterator[Finding]:
    """Report columns that are equal in rows where they change; what may be a target or a torque also a row apart."""
    kinds = log.quantity[name], log.quantity[other]
    if "t" in kinds or (kinds[0] == kinds[1] and kinds[0] in COMMANDS) or any(k.startswith("base_") for k in kinds):
        return  # joints may have one command, and a simulator's truth may be its reading
    related = kinds in MEANING
    ideal = not all(log.sensor_noise[c] for c in (name, other) if log.quantity[c] not in COMMANDS)
    if ideal and not related:
        return
    a, b = (log.recording.channels[c].astype(float, copy=False) for c in (name, other))
    span = min(log.spans[name], log.spans[other])
    rounding = 0.51 * max(log.steps.get(c, 0.0) for c in (name, other)) if related else 0.0
    close = min(max(rounding, 1e-6 * span), 2e-3 * span)
    for late in (0, 1, -1) if related else (0,):
        share, count = _shared(a, b, late, log.on, close)
        if share > limits.COPIED and count >= limits.ENOUGH * (1.0 if share < limits.DERIVED else 0.2):
            row = f" of the row {'before' if late > 0 else 'after'}" if late else ""
            why = MEANING.get(kinds, "one of the two holds another quantity")
            message = f"equals {other}{row} in {share:.1%} of the rows in which they change: {why}"
            verdict = "ok" if ideal and kinds == ("tau_est", "tau_cmd") else _weight(log, kinds)
            yield finding("copy", name, verdict, share, "", message)
            return
    if kinds == ("q_target", "q"):
        yield from _rounded(log, name, other, a, b)


def _rounded(log: Log, name: str, other: str, a: np.ndarray, b: np.ndarray) -> Iterator[Finding]:
    """Report targets ``a`` (T,) that are angles ``b`` (T,) of the same or an earlier row, rounded.

    Rows count in which the angle moves by many times the rounding: an actuator would have to follow its target within
    a tenth of a row to pass for a copy, or to be ahead of it.
    """
    close = min(max(0.51 * log.target_steps[name], 1e-6 * log.spans[other]), 2e-3 * log.spans[other])
    for late in range(limits.LAW_ROWS):
        earlier = np.roll(b, late)
        near = np.abs(a - earlier) <= close
        if np.count_nonzero(near) <= limits.ROUNDED * limits.ENOUGH:
            continue  # most pairs: too few, wherever the angle moves fast
        fast = np.abs(np.roll(earlier, -1) - np.roll(earlier, 1)) > limits.FAST_STEPS * close
        fast[: late + 1] = fast[-1:] = False
        fast &= log.on
        share = float(np.mean(near[fast])) if fast.sum() >= limits.ENOUGH else 0.0
        if share > limits.ROUNDED:
            rows = f" of {late} rows before" if late else " of the same row"
            message = f"equals {other}{rows} up to rounding in {share:.1%} of the rows in which it moves fast"
            why = MEANING["q_target", "q"]
            yield finding("copy", name, _weight(log, ("q_target", "q")), share, "", f"{message}: {why}")
            return


def _shared(a: np.ndarray, b: np.ndarray, late: int, on: np.ndarray, close: float) -> tuple[float, int]:
    """Return the share, and the number, of the ``on`` rows (T,) where two columns change to values that are close.

    ``b`` is taken ``late`` rows later, -1 to 1.
    """
    every = max(1, len(a) // limits.COPY_ROWS)
    near = np.abs(a[1:-1:every] - b[1 - late : len(b) - 1 - late : every]) <= close
    if np.count_nonzero(near) < limits.COPIED / 2 * len(near):
        return 0.0, 0  # most pairs, by a part of their rows
    b = np.roll(b, late)
    changes, other = (np.append(False, np.diff(x) != 0.0) & on for x in (a, b))
    count = int((changes & other & (np.abs(a - b) <= close)).sum())
    return count / max(1, int((changes | other).sum())), count


# ---------------------------------------------------------------------- columns computed from another


@dataclass(frozen=True)
class _Source:
    """A channel ``x`` (T,) from which others may have been computed, its noise, and the rows (T,) in which it changes.

    Without noise there is nothing to look for: what is computed from it looks as if measured.
    """

    x: np.ndarray
    noise: float
    rows: np.ndarray

    @staticmethod
    def from_log(log: Log, channel: str) -> _Source:
        x = log.recording.channels[channel]
        return _Source(x, log.sensor_noise[channel], np.append(False, np.diff(x) != 0.0) & log.on)

    def repeated(self, y: np.ndarray, predictions: Iterable[Prediction], step: float = 0.0) -> float:
        """Return the share of rows in which ``y`` (T,), of steps ``step``, is nearer to a prediction than noise.

        A share that is too small for a finding, or of a smoother ``y``, which cannot hold the noise, is 0.
        """
        shares = [0.0]
        for predicted, gain in predictions:
            whole, noise = np.isfinite(predicted), self.noise * gain
            known = self.rows & whole
            close = max(limits.SAME_NOISE * noise, 0.51 * step if step < noise else 0.0)
            if known.sum() < limits.ENOUGH or np.ptp(y[known]) == 0.0:
                continue
            share = float(np.mean(np.abs(y[known] - predicted[known]) < close))
            if share > limits.DERIVED and _roughness(y[whole]) > 0.5 * _roughness(predicted[whole]):
                shares.append(share)
        return max(shares)


def _derived(log: Log, joint: str) -> Iterator[tuple[str, float, str]]:
    """Yield columns of a joint, in which share of the rows each repeats the noise of another, and what that means."""
    names = [joint_channel(kind, joint) for kind in ("q", "qd", "q_target", "tau_est", "tau_cmd")]
    q, qd, target, tau, command = (log.recording.channels.get(name) for name in names)
    one = np.ones((len(log.t), 1))
    if command is not None and tau is not None and (torque := _Source.from_log(log, names[3])).noise:
        share = torque.repeated(command, [_fitted(command, tau[:, None], one)])
        yield names[3], share, f"is {names[4]} up to a factor ({COMMANDED})"
    if q is None or not (angle := _Source.from_log(log, names[0])).noise:
        return
    if target is not None:
        share = angle.repeated(target, [_fitted(target, q[:, None], one)])
        yield names[2], share, f"is {names[0]} up to a factor and an offset"
    if qd is not None:
        share = angle.repeated(qd, _slopes(log.t, q, qd), log.steps[names[1]])
        yield names[1], share, f"was computed from {names[0]}, whose noise it repeats"
    if tau is not None and target is not None and abs(signals.correlation(q, target)) < limits.ALIKE:
        others = np.column_stack([target, one, *([] if qd is None else [qd])])
        sooner = [np.roll(tau, -late) for late in range(limits.LAW_ROWS)]
        shares = [angle.repeated(y, [_fitted(y, q[:, None], others)], log.steps[names[3]]) for y in sooner]
        yield names[3], max(shares), f"is a linear law of {names[2]} and {names[0]} ({COMMANDED})"


def _fitted(y: np.ndarray, angles: np.ndarray, others: np.ndarray) -> Prediction:
    """Fit most of a channel (T,), all but what is clipped, by ``angles`` (T, K) and ``others`` (T, L), linearly."""
    inputs = np.column_stack([angles, others])
    use = np.flatnonzero(np.isfinite(inputs).all(axis=1))
    use = use[:: max(1, len(use) // limits.COPY_ROWS)]
    known, wanted = inputs[use], y[use]
    best = np.ones(len(use), dtype=bool)
    for _ in range(3):
        factors = np.linalg.lstsq(known[best], wanted[best], rcond=None)[0]
        off = np.abs(known @ factors - wanted)
        best = off <= np.quantile(off, limits.FITTED)
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


def _roughness(x: np.ndarray) -> float:
    """Return the median size of third differences of a channel (T,), of which smooth motion has next to none."""
    return float(np.median(np.abs(np.diff(x, 3))))
