"""Checks of commands against what the joints did: order, sign, delay."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import uniform_filter1d

import go1exp.logs.audit.limits as limits
import go1exp.logs.audit.signals as signals
from go1exp.logs.audit.delay import Delay, delays
from go1exp.logs.audit.log import Log, finding
from go1exp.logs.audit.report import Finding, Verdict
from go1exp.logs.recording import joint_channel

SMOOTH = 0.2
"""s of smoothing: order and sign are judged below about 3 Hz, where a joint follows its target at any gains."""
LONGEST_LAG = 0.12
"""s by which a joint may trail its target (chosen: longer than the response of any drive under position control)."""
LONGEST_TRAIL = 0.3
"""s; the same for a soft position servo."""


def order_and_sign(log: Log) -> Iterator[Finding]:
    """Check that each joint follows its own target better than that of another, with the right sign and unit."""
    if not (log.recording.has("q_target") and log.recording.has("q")) or not _enough(log):
        return
    target, q = _matches_inputs(log)
    match = _lagged_correlation(log, target, q)
    partner = signals.mixed_up(match)
    for j, joint in enumerate(log.joints):
        if j in partner:
            other = log.joints[partner[j]]
            message = f"moves with q_{other} (correlation {match[j, partner[j]]:.2f}), not with its own joint"
            message += f" ({match[j, j]:.2f}): "
            swap = partner[partner[j]] == j
            message += f"{joint} and {other} are swapped" if swap else f"what is called {other} is the joint it drives"
            yield finding("order", joint_channel("q_target", joint), "bad", match[j, partner[j]], "", message)
        elif match[j, j] < -limits.CLEARLY:
            message = f"goes against q_target_{joint} (correlation {match[j, j]:.2f}): a sign is flipped"
            yield finding("sign", joint_channel("q", joint), "bad", match[j, j], "", message)
        elif match[j, j] > limits.CLEARLY:
            yield from _other_unit(joint, float(np.std(q[:, j]) / np.std(target[:, j])))


def _other_unit(joint: str, times: float) -> Iterator[Finding]:
    """Report an angle that moves ``times`` as far as its target, if that looks like degrees in one of the two.

    Nothing moves so much farther than its target. So much less far moves a joint that is blocked, too.
    """
    degrees = 180.0 / np.pi
    cases: tuple[tuple[float, Verdict, str], ...] = ((times, "bad", "q"), (1.0 / times, "suspect", "q_target"))
    for factor, verdict, which in cases:
        if degrees / limits.FARTHER < factor < degrees * limits.FARTHER:
            message = f"moves {times:.3g} times as far as q_target_{joint}: {which}_{joint} looks like degrees"
            message += "" if which == "q" else f", or q_{joint} was taken for degrees"
            yield finding("units", joint_channel("q", joint), verdict, times, "", message)


def _enough(log: Log) -> bool:
    return log.on.sum() >= max(2 * limits.ENOUGH, limits.LEAST_TIME / log.dt)


def _matches_inputs(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Return targets and angles (T, J), smoothed and without their mean.

    While the drives are off, both keep their last values: a free joint does not follow its target.
    """
    n = log.samples(SMOOTH)
    held = np.maximum.accumulate(np.where(log.on, np.arange(len(log.t)), 0))
    target, q = (uniform_filter1d(log.recording.joint(name)[held], n, axis=0) for name in ("q_target", "q"))
    return target - target.mean(axis=0), q - q.mean(axis=0)


def _lagged_correlation(log: Log, target: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the correlation (J, J) of each target (rows) with each joint (columns), at the lag where it is largest.

    "Largest" is by absolute value. A pair of which one does not move has 0.
    """
    best = np.zeros((target.shape[1], q.shape[1]))
    live = np.outer(np.ptp(target, axis=0) > limits.STILL_ANGLE, np.ptp(q, axis=0) > limits.STILL_ANGLE)
    for lag in range(0, log.samples(LONGEST_LAG) + 1, log.samples(0.01)):
        a, b = target[: len(target) - lag], q[lag:]
        a, b = a - a.mean(axis=0), b - b.mean(axis=0)
        spread = np.outer(np.linalg.norm(a, axis=0), np.linalg.norm(b, axis=0))
        match = np.where(live, a.T @ b / np.maximum(spread, 1e-12), 0.0)
        best = np.where(np.abs(match) > np.abs(best), match, best)
    return best


def timing(log: Log) -> tuple[list[Finding], dict[str, Delay]]:
    """Check the delay of each joint; return the delays, too, by the name of the ``q`` column."""
    if log.command is None or not log.recording.has("q") or not _enough(log):
        return [], {}
    if log.dt < limits.LEAST_STEP:  # of such a clock nothing can be told, and its grid would fill the memory
        return [], {}
    q = log.recording.joint("q")
    estimates = delays(log.t, log.recording.joint(log.command), q, log.on)
    known = {j: d for j, d in zip(log.joints, estimates, strict=True) if d is not None}
    findings = []
    middle = float(np.median([d.time for d in known.values()])) if known else 0.0
    threshold = limits.DELAY + log.dt
    # An error of two standard deviations is allowed before a delay is reported.
    late = {j: d for j, d in known.items() if abs(d.time) - 2 * d.error > threshold}
    for joint, d in known.items():
        name = joint_channel("q", joint)
        shown = f"answers {log.command} after {d.time * 1e3:.1f} ± {d.error * 1e3:.1f} ms"
        apart = abs(d.time - middle) - 2 * d.error > limits.DELAY_SPREAD and len(known) > 2
        if joint in late and d.time > 0:
            findings.append(finding("delay", name, "suspect", d.time * 1e3, "ms", f"{shown}: delay or clock offset"))
        elif joint in late:
            message = f"{shown}, before it is given: a clock offset, or a command logged late"
            findings.append(finding("delay", name, "suspect", d.time * 1e3, "ms", message))
        elif apart:
            message = f"{shown}, the other joints after {middle * 1e3:.1f} ms: delay or clock offset of this one"
            findings.append(finding("delay", name, "suspect", d.time * 1e3, "ms", message))
    if known and not findings:
        low, high = (f(d.time for d in known.values()) * 1e3 for f in (min, max))
        message = f"{len(known)} of {len(log.joints)} joints answer after {low:.1f} to {high:.1f} ms"
        findings.append(finding("delay", "q", "ok", middle * 1e3, "ms", message))
    findings += _trailing(log, [j for j in log.joints if j not in known])
    return findings, {joint_channel("q", joint): d for joint, d in known.items()}


def _trailing(log: Log, joints: list[str]) -> Iterator[Finding]:
    """Report by how much joints of unknown delay trail their targets: delay and response of the drive together."""
    if log.command != "q_target" or not joints:
        return
    n, most = log.samples(0.05), log.samples(LONGEST_TRAIL)
    trail = {}
    for joint in joints:
        pair = (log.recording.channels[joint_channel(name, joint)] for name in ("q_target", "q"))
        a, b = (np.gradient(uniform_filter1d(x, n)) for x in pair)
        # row k of the view: the joint k samples later than its target
        a, b = a[: len(a) - most], np.lib.stride_tricks.sliding_window_view(b, len(a) - most)
        spread = np.linalg.norm(a) * np.linalg.norm(b, axis=1)
        match = np.divide(b @ a, spread, out=np.zeros_like(spread), where=spread > 0)
        if match.max() > limits.CLEARLY and 0 < np.argmax(match) < most:
            trail[joint] = float(np.argmax(match)) * log.dt * 1e3
    if trail:
        low, high = min(trail.values()), max(trail.values())
        verb, by = ("trails its target" if len(trail) == 1 else "trail their targets"), f"{low:.3g}"
        by += f" to {high:.3g}" if f"{high:.3g}" != by else ""
        message = f"{', '.join(trail)} {verb} by {by} ms, delay and drive together; "
        yield finding("trail", "q", "ok", high, "ms", message + "the motion does not tell them apart")
