"""Samples that their neighbours rule out: rows of zeros, spikes, jumps faster than any joint."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

import go1exp.logs.audit.limits as limits
import go1exp.logs.audit.signals as signals
from go1exp.logs.audit.excursions import excursions
from go1exp.logs.audit.report import Finding
from go1exp.logs.audit.signals import finding
from go1exp.logs.audit.wraps import wrapped_angle, wrapped_speed
from go1exp.logs.recording import VECTORS, Recording, joint_channel, joint_channels
from go1exp.robot import JOINTS, VELOCITY_LIMIT

SHOWN = 5  # rows that a message lists
ZEROS = "are zeros between values far from zero"  # what is wrong with rows that a logger filled

LEAVE = "depart from the targets before and after for one row, and no measurement responds"

WRAPS = "are off by whole turns of a counter that wraps at its range of {:.3g} {}: unwrap them"

SPIKES = "are spikes that the readings before and after rule out"

Wrong = tuple[str, np.ndarray, str]
"""Channel, rows (T,) bool that cannot be right, of which there may be none, and what is wrong with them."""


@dataclass(frozen=True)
class Impossible:
    """Rows (T,) bool that cannot be right, a finding for each kind and channel, and what unwrapping leaves."""

    rows: np.ndarray
    findings: tuple[Finding, ...]
    unwrapped: Recording


def impossible(recording: Recording) -> Impossible:
    """Find samples that no motion explains, in a recording whose clock increases and whose values are finite."""
    rows, findings = np.zeros(len(recording.t), dtype=bool), []
    if len(rows) < limits.ENOUGH:
        return Impossible(rows, (), recording)
    recording, wraps = _unwrapped(recording)
    for channel, wrong, what in (*wraps, *_wrong(recording)):
        if wrong.any():
            rows |= wrong
            share, which = float(wrong.mean()), np.flatnonzero(wrong)
            rest = f" and {len(which) - SHOWN} more" if len(which) > SHOWN else ""
            message = f"{len(which)} of {len(rows)} rows ({share:.2%}) {what}; rows from 0: "
            message += ", ".join(map(str, which[:SHOWN])) + rest
            findings.append(finding("impossible", channel, "bad", share, "", message))
    return Impossible(rows, tuple(findings), recording)


def without(recording: Recording, rows: np.ndarray) -> Recording:
    """Return a recording without some ``rows`` (T,) bool; the notes say how many were left out."""
    note = f"{int(rows.sum())} of {len(rows)} rows were impossible and are left out."
    meta = replace(recording.meta, notes=" ".join(filter(None, (recording.meta.notes, note))))
    return Recording(meta, {name: values[~rows] for name, values in recording.channels.items()})


# ---------------------------------------------------------------------- quantity by quantity


def _wrong(recording: Recording) -> Iterator[Wrong]:
    t, joints = recording.t, recording.meta.joints
    angles = recording.joint("q") if recording.has("q") else None
    if angles is not None:
        yield from _wrong_angles(recording, angles)
    if recording.has("qd"):
        names, speeds = joint_channels("qd", joints), recording.joint("qd")
        if angles is None:
            yield from _wrong_readings(t, names, speeds)
        else:
            yield from _wrong_speeds(t, names, speeds, np.gradient(angles, t, axis=0))
    if recording.has("q_target"):
        read = [joint_channels(name, joints) for name in ("q", "qd", "tau_est") if recording.has(name)]
        for k, name in enumerate(joint_channels("q_target", joints)):
            answers = [recording.channels[names[k]] for names in read]
            target = recording.channels[name]
            yield name, excursions(t, target, _returned(target), answers), LEAVE
    if recording.has("tau_est"):  # zeros are those of actuators that are off
        yield from _wrong_readings(t, joint_channels("tau_est", joints), recording.joint("tau_est"))
    for quantity in ("imu_gyro", "imu_acc"):
        if set(VECTORS[quantity]) <= set(recording.channels):
            values = recording.block(*VECTORS[quantity])
            zeros = _zero_rows(t, values)
            yield quantity, zeros, ZEROS
            yield from _wrong_readings(t, VECTORS[quantity], values, ~zeros)


def _unwrapped(recording: Recording) -> tuple[Recording, list[Wrong]]:
    """Return a recording whose angles and speeds do not wrap, and which rows did."""
    t, channels, wraps = recording.t, dict(recording.channels), list[Wrong]()
    for k, joint in enumerate(recording.meta.joints if recording.has("q") else ()):
        name, speed, target = (joint_channel(quantity, joint) for quantity in ("q", "qd", "q_target"))
        q = channels[name]
        if angle := wrapped_angle(t, q, _fastest(recording, k)):
            turns, span = angle
            wraps.append((name, turns != 0.0, WRAPS.format(span, "rad")))
            q = q + turns * span
            if target in channels:  # says which turn is none
                q = q + span * np.round(np.median(channels[target] - q) / span)
            channels[name] = q
        if speed in channels and (rate := wrapped_speed(channels[speed], np.gradient(q, t))):
            turns, span = rate
            wraps.append((speed, turns != 0.0, WRAPS.format(span, "rad/s")))
            channels[speed] = channels[speed] + turns * span
    return Recording(recording.meta, channels) if wraps else recording, wraps


def _wrong_angles(recording: Recording, q: np.ndarray) -> Iterator[Wrong]:
    t, names = recording.t, joint_channels("q", recording.meta.joints)
    zeros = _zero_rows(t, q, at_ends=True)
    yield names[0] if len(names) == 1 else "q", zeros, ZEROS
    lost = np.stack([_lone_zeros(x, ~zeros) for x in q.T], axis=1)
    # Spikes before jumps: one that is left by an ordinary step would part what follows from the rest.
    spikes = np.stack([_outliers(t, x, ~zeros & ~gone) for x, gone in zip(q.T, lost.T, strict=True)], axis=1)
    sound = ~zeros & ~lost.any(axis=1) & ~spikes.any(axis=1)
    for k, name in enumerate(names):
        yield name, lost[:, k], ZEROS
        jumps = np.zeros(len(t), dtype=bool)
        jumps[sound] = _jumps(t[sound], q[sound, k], _fastest(recording, k))
        speed = np.abs(np.diff(q[:, k]) / np.diff(t)).max()
        yield name, jumps, f"are apart from the others by jumps, at up to {speed:.3g} rad/s"
        yield name, spikes[:, k], SPIKES


def _wrong_speeds(t: np.ndarray, names: Sequence[str], qd: np.ndarray, slopes: np.ndarray) -> Iterator[Wrong]:
    """Yield what is wrong with speeds (T, J) beside the ``slopes`` (T, J) of the angles."""
    turns = np.any(np.abs(slopes) > limits.TURNS, axis=1)
    zeros = _zero_rows(t, qd) & turns  # a coarse encoder at rest reads zero, too
    yield names[0] if len(names) == 1 else "qd", zeros, ZEROS
    for name, x, slope in zip(names, qd.T, slopes.T, strict=True):
        # An impact turns a joint within a sample, too, but the angles show half of it.
        off = np.abs(x - slope)
        least = 0.7 * _returned(x) + limits.SURE * 1.4826 * float(np.median(off))
        spikes = _spikes(t, x, limits.REVERSED) & (off > least)
        yield name, spikes & ~zeros, SPIKES


def _wrong_readings(
    t: np.ndarray, names: Sequence[str], values: np.ndarray, sound: np.ndarray | bool = True
) -> Iterator[Wrong]:
    """Yield the ``sound`` rows in which readings (T, K) that may have impacts are far outside their usual range."""
    for name, x in zip(names, values.T, strict=True):
        out = _returned(x)
        usual = x[out <= limits.UNUSUAL * float(np.quantile(out, 0.9))]  # many spikes widen the range of all rows
        far, farther = (np.abs(x - np.median(x)) / _span(y) for y in (x, usual))
        off = _off(t, x)
        alone = _alone(x, off)
        spikes = ((farther > limits.SPANS) & (_reversed(x, off, 0.0) | alone)) | ((far > 2.0) & alone)
        yield name, spikes & sound, SPIKES


def _span(x: np.ndarray) -> float:
    """Return the range of 99 % of the values (T,)."""
    return max(float(np.ptp(np.quantile(x, (0.005, 0.995)))), 1e-9)


def _fastest(recording: Recording, joint: int) -> float:
    """Return a velocity beyond that of a joint, rad/s."""
    name = recording.meta.joints[joint]
    if recording.meta.robot == "go1" and name in JOINTS:
        return 2.0 * VELOCITY_LIMIT[JOINTS.index(name) % 3]
    return limits.FASTEST


# ---------------------------------------------------------------------- spikes


def _returned(x: np.ndarray) -> np.ndarray:
    """Return by how much each sample (T,) departs from both neighbours in one direction; 0 where it does not."""
    d = np.diff(x)
    out = np.zeros(len(x))
    out[1:-1] = np.where(d[:-1] * d[1:] < 0, np.minimum(np.abs(d[:-1]), np.abs(d[1:])), 0.0)
    return out


def _outliers(t: np.ndarray, q: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """Return which ``sound`` angles (T,), rad, are spikes, also those that show only where others are left out."""
    left, least = sound.copy(), limits.REVERSED * float(np.median(np.diff(t)))
    while left.sum() > limits.ENOUGH:
        x = q[left]
        wrong = _spikes(t[left], x, least)
        if not wrong.any():
            break
        left[np.flatnonzero(left)[wrong]] = False
    return sound & ~left


def _spikes(t: np.ndarray, x: np.ndarray, least: float) -> np.ndarray:
    """Return samples (T,) bool that go out and back by more than ``least`` and the usual, or are off alone."""
    off = _off(t, x)
    return _reversed(x, off, least) | _alone(x, off)


def _reversed(x: np.ndarray, off: np.ndarray, least: float) -> np.ndarray:
    """Return samples (T,) bool that go out and back by more than ``least`` and the usual, as no smooth motion does."""
    out = _returned(x)
    return (out > max(least, limits.UNUSUAL * float(np.quantile(out, 0.9)))) & (off > 0.5 * out)


def _alone(x: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return samples (T,) bool that are ``off`` alone: more than usual, than their neighbours, and than at a bend."""
    steps = np.abs(np.diff(x))
    noise = max(float(np.quantile(off[off > 0.0], 0.9)) if off.any() else 0.0, _step(x) / np.sqrt(12.0))
    rows = (_returned(x) > 0.0) & (off > max(limits.UNUSUAL * noise, float(np.quantile(steps, 0.95))))
    rows[1:-1] &= off[1:-1] > 0.8 * np.maximum(steps[1:], steps[:-1])
    rows[1:-1] &= off[1:-1] > 1.3 * np.maximum(off[2:], off[:-2])
    return rows


def _step(x: np.ndarray) -> float:
    """Return the smallest change between two samples; 0 if nothing changes."""
    steps = np.abs(np.diff(x))
    return float(np.min(steps[steps > 1e-12], initial=np.inf)) if steps.max(initial=0.0) > 1e-12 else 0.0


def _off(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return how far each sample (T,) is from the cubic through its four neighbours; less where any is missing."""
    at, near = t[2:-2], np.stack([t[:-4], t[1:-3], t[3:-1], t[4:]])
    others = ([j for j in range(4) if j != k] for k in range(4))
    weights = np.stack([np.prod((at - near[j]) / (near[k] - near[j]), axis=0) for k, j in enumerate(others)])
    wide = np.prod(np.abs(near - at), axis=0) / (4.0 * float(np.median(np.diff(t))) ** 4)
    cubic = np.sum(weights * np.stack([x[:-4], x[1:-3], x[3:-1], x[4:]]), axis=0)
    return np.pad(np.abs(x[2:-2] - cubic) / np.maximum(wide, 1.0), 2)


def _lone_zeros(x: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """Return which ``sound`` samples (T,) are 0 between values far from it, more often than x changes its sign."""
    rows, y = np.zeros(len(x), dtype=bool), x[sound]
    short = [(a, b) for a, b in signals.stretches(y == 0.0) if a > 0 and b < len(y) and b - a <= limits.LOST_ROWS]
    lost = np.zeros(len(y), dtype=bool)
    for a, b in short:
        lost[a:b] = min(abs(y[a - 1]), abs(y[b])) > limits.LOST_STEPS * _step(y)
    rest = np.sign(y[~lost])
    if lost.sum() >= limits.LOST_ROWS and lost.sum() > 0.25 * np.count_nonzero(rest[1:] != rest[:-1]):
        rows[np.flatnonzero(sound)[lost]] = True
    return rows


def _zero_rows(t: np.ndarray, values: np.ndarray, at_ends: bool = False) -> np.ndarray:
    """Return rows (T,) bool of ``values`` (T, J) that are exactly 0, entered and left by an unusual jump.

    At the ends of a recording one jump is enough for angles. Speeds and torques may begin at zero.
    """
    rows = np.zeros(len(values), dtype=bool)
    zero = np.all(values == 0.0, axis=1)
    if not zero.any() or zero.mean() > 0.5:
        return rows
    moved = np.abs(np.diff(values, axis=0))
    inner = ~(zero[1:] | zero[:-1])
    if not inner.any():
        return rows
    usual = limits.ZERO_JUMP * np.quantile(moved[inner], 0.95, axis=0) + 1e-6
    if at_ends:  # a single row is known by less: what lies between its neighbours is not zero
        off = np.stack([_off(t, x) for x in values.T], axis=1)
        noise = np.array([np.quantile(x[x > 0.0], 0.9) if x.any() else 0.0 for x in off.T])
        rows |= zero & np.any(off > limits.UNUSUAL * noise + 1e-6, axis=1)
    runs = signals.stretches(zero)
    for a, b in runs:
        ends = [moved[i] for i in (a - 1, b - 1) if 0 <= i < len(moved)]
        rows[a:b] |= len(ends) > (not at_ends) and all(np.any(end > usual) for end in ends)
    return rows


def _jumps(t: np.ndarray, x: np.ndarray, fastest: float) -> np.ndarray:
    """Return rows (T,) bool that are parted from most others by changes faster than ``fastest``.

    Between such changes lie pieces. Each continues the earlier pieces that it can be reached from most slowly; those of
    fewer rows than the largest such chain are wrong.
    """
    cuts = np.flatnonzero(np.abs(np.diff(x)) > fastest * np.diff(t)) + 1
    rows = np.zeros(len(x), dtype=bool)
    if not len(cuts) or len(cuts) > 0.2 * len(x):
        return rows
    chains: list[list[tuple[int, int]]] = []
    for a, b in zip([0, *cuts], [*cuts, len(x)], strict=True):
        speeds = [abs(x[a] - x[c[-1][1] - 1]) / (t[a] - t[c[-1][1] - 1]) for c in chains]
        if speeds and min(speeds) <= fastest:
            chains[int(np.argmin(speeds))].append((a, b))
        else:
            chains.append([(a, b)])
    largest = max(chains, key=lambda c: sum(b - a for a, b in c))
    for chain in chains:
        for a, b in chain if chain is not largest else []:
            rows[a:b] = True
    return rows
