"""Samples that their neighbours rule out: rows of zeros, spikes, jumps faster than any joint."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import go1exp.logs.audit.limits as limits
import go1exp.logs.audit.signals as signals
from go1exp.logs.audit.report import Finding
from go1exp.logs.audit.signals import finding
from go1exp.logs.recording import JOINT_QUANTITIES, VECTORS, Recording, joint_channels
from go1exp.robot import JOINTS, VELOCITY_LIMIT

SHOWN = 5
"""Rows that a message lists."""

ZEROS = "are zeros between values far from zero"
"""What is wrong with rows that a logger filled."""


@dataclass(frozen=True)
class Impossible:
    """Rows (T,) bool that cannot be right, and a finding for each kind and channel."""

    rows: np.ndarray
    findings: tuple[Finding, ...]


def impossible(recording: Recording) -> Impossible:
    """Find samples that no motion explains, in a recording whose clock increases and whose values are finite."""
    rows, findings = np.zeros(len(recording.t), dtype=bool), []
    if len(rows) >= limits.ENOUGH:
        for channel, wrong, what in _wrong(recording):
            rows |= wrong
            share = float(wrong.mean())
            which = np.flatnonzero(wrong)
            listed = ", ".join(map(str, which[:SHOWN])) + (
                f" and {len(which) - SHOWN} more" if len(which) > SHOWN else ""
            )
            message = f"{len(which)} of {len(rows)} rows ({share:.2%}) {what}; rows from 0: {listed}"
            findings.append(finding("impossible", channel, "bad", share, "", message))
    return Impossible(rows, tuple(findings))


def without(recording: Recording, rows: np.ndarray) -> Recording:
    """Return a recording without some ``rows`` (T,) bool; the notes say how many were left out."""
    note = f"{int(rows.sum())} of {len(rows)} rows were impossible and are left out."
    meta = replace(recording.meta, notes=" ".join(filter(None, (recording.meta.notes, note))))
    return Recording(meta, {name: values[~rows] for name, values in recording.channels.items()})


def _wrong(recording: Recording) -> Iterator[tuple[str, np.ndarray, str]]:
    """Yield channel, rows (T,) bool, and what is wrong with them."""
    names = {q: joint_channels(q, recording.meta.joints) for q in JOINT_QUANTITIES if q not in ("q_target", "tau_cmd")}
    names |= {q: list(VECTORS[q]) for q in ("imu_gyro", "imu_acc")}
    t = recording.t
    for quantity, columns in names.items():
        if not set(columns) <= set(recording.channels):
            continue
        values = recording.block(*columns)
        zeros = _zeros(t, values, at_ends=quantity == "q")
        if quantity == "qd":  # a coarse encoder at rest reads zero, too
            slope = np.gradient(recording.joint("q"), t, axis=0) if recording.has("q") else np.zeros_like(values)
            zeros &= np.any(np.abs(slope) > limits.TURNS, axis=1)
        elif quantity == "tau_est":  # of actuators that are off
            zeros &= False
        if zeros.any():
            yield (columns[0] if len(columns) == 1 else quantity), zeros, ZEROS
        lone = np.zeros(values.shape, dtype=bool)
        if quantity == "q":  # spikes first: one that is left by an ordinary step would part what follows from the rest
            lone = np.stack([_lone_zeros(x, ~zeros) for x in values.T], axis=1)
            out = np.stack([_outliers(t, x, ~zeros & ~lost) for x, lost in zip(values.T, lone.T, strict=True)], axis=1)
            sound = ~zeros & ~lone.any(axis=1) & ~out.any(axis=1)
        for k, name in enumerate(columns):
            if lone[:, k].any():
                yield name, lone[:, k], ZEROS
            if quantity == "q":
                jumps = np.zeros(len(t), dtype=bool)
                jumps[sound] = _jumps(t[sound], values[sound, k], _fastest(recording, k))
                if jumps.any():
                    speed = np.abs(np.diff(values[:, k]) / np.diff(t)).max()
                    yield name, jumps, f"are apart from the others by jumps, at up to {speed:.3g} rad/s"
                wrong = out[:, k]
            elif quantity == "qd" and recording.has("q"):
                wrong = _spikes(t, values[:, k], limits.REVERSED) | _alone(t, values[:, k])
                slope = np.gradient(recording.joint("q")[:, k], t)
                wrong &= np.abs(values[:, k] - slope) > 0.7 * _returned(values[:, k])
            else:
                span = max(float(np.ptp(np.quantile(values[:, k], (0.005, 0.995)))), 1e-9)
                far = np.abs(values[:, k] - np.median(values[:, k])) / span
                wrong = (far > limits.SPANS) & _spikes(t, values[:, k], 0.0) | (far > 2.0) & _alone(t, values[:, k])
            wrong = wrong & ~zeros & ~lone[:, k]
            if wrong.any():
                yield name, wrong, "are spikes that the readings before and after rule out"


def _fastest(recording: Recording, joint: int) -> float:
    """Return a velocity beyond that of a joint, rad/s."""
    name = recording.meta.joints[joint]
    if recording.meta.robot == "go1" and name in JOINTS:
        return 2.0 * VELOCITY_LIMIT[JOINTS.index(name) % 3]
    return limits.FASTEST


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
        wrong = _spikes(t[left], x, least) | _alone(t[left], x)
        if not wrong.any():
            break
        left[np.flatnonzero(left)[wrong]] = False
    return sound & ~left


def _spikes(t: np.ndarray, x: np.ndarray, least: float) -> np.ndarray:
    """Return samples (T,) bool that go out and back by more than ``least`` and the usual, as no smooth motion does."""
    out = _returned(x)
    return (out > max(least, limits.UNUSUAL * float(np.quantile(out, 0.9)))) & (_off(t, x) > 0.5 * out)


def _alone(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return samples (T,) bool that are off alone: by more than usual, than their neighbours, and than at a bend."""
    off, steps = _off(t, x), np.abs(np.diff(x))
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
    """Return how far each sample (T,) lies from the cubic through its four neighbours; 0 at the ends.

    Where neighbours are missing the cubic is less exact, so there it counts for less.
    """
    at, near = t[2:-2], np.stack([t[:-4], t[1:-3], t[3:-1], t[4:]])
    others = ([j for j in range(4) if j != k] for k in range(4))
    weights = np.stack([np.prod((at - near[j]) / (near[k] - near[j]), axis=0) for k, j in enumerate(others)])
    wide = np.prod(np.abs(near - at), axis=0) / (4.0 * float(np.median(np.diff(t))) ** 4)
    cubic = np.sum(weights * np.stack([x[:-4], x[1:-3], x[3:-1], x[4:]]), axis=0)
    return np.pad(np.abs(x[2:-2] - cubic) / np.maximum(wide, 1.0), 2)


def _lone_zeros(x: np.ndarray, sound: np.ndarray) -> np.ndarray:
    """Return which ``sound`` samples (T,) are exactly 0 between values far from it, more often than x changes its sign.

    Of a course through zero few samples are exactly 0.
    """
    rows, y = np.zeros(len(x), dtype=bool), x[sound]
    short = [(a, b) for a, b in signals.stretches(y == 0.0) if a > 0 and b < len(y) and b - a <= limits.LOST_ROWS]
    lost = np.zeros(len(y), dtype=bool)
    for a, b in short:
        lost[a:b] = min(abs(y[a - 1]), abs(y[b])) > limits.LOST_STEPS * _step(y)
    rest = np.sign(y[~lost])
    if lost.sum() >= limits.LOST_ROWS and lost.sum() > 0.25 * np.count_nonzero(rest[1:] != rest[:-1]):
        rows[np.flatnonzero(sound)[lost]] = True
    return rows


def _zeros(t: np.ndarray, values: np.ndarray, at_ends: bool) -> np.ndarray:
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
