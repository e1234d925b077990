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
        zeros = _zeros(values, at_ends=quantity == "q")
        if quantity == "qd":  # a coarse encoder at rest reads zero, too
            slope = np.gradient(recording.joint("q"), t, axis=0) if recording.has("q") else np.zeros_like(values)
            zeros &= np.any(np.abs(slope) > limits.TURNS, axis=1)
        elif quantity == "tau_est":  # of actuators that are off
            zeros &= False
        if zeros.any():
            yield (columns[0] if len(columns) == 1 else quantity), zeros, "are zeros between values far from zero"
        if quantity == "q":  # spikes first: one that is left by an ordinary step would part what follows from the rest
            least = limits.REVERSED * float(np.median(np.diff(t)))
            out = np.stack([_spikes(x, least) for x in values.T], axis=1) & ~zeros[:, None]
            sound = ~zeros & ~out.any(axis=1)
        for k, name in enumerate(columns):
            if quantity == "q":
                jumps = np.zeros(len(t), dtype=bool)
                jumps[sound] = _jumps(t[sound], values[sound, k], _fastest(recording, k))
                if jumps.any():
                    speed = np.abs(np.diff(values[:, k]) / np.diff(t)).max()
                    yield name, jumps, f"are apart from the others by jumps, at up to {speed:.3g} rad/s"
                wrong = out[:, k]
            elif quantity == "qd" and recording.has("q"):
                wrong = _spikes(values[:, k], limits.REVERSED) & ~zeros
                slope = np.gradient(recording.joint("q")[:, k], t)
                wrong &= np.abs(values[:, k] - slope) > 0.7 * _returned(values[:, k])
            else:
                middle, span = np.median(values[:, k]), np.ptp(np.quantile(values[:, k], (0.005, 0.995)))
                far = np.abs(values[:, k] - middle) > limits.SPANS * max(float(span), 1e-9)
                wrong = far & _spikes(values[:, k], 0.0) & ~zeros
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


def _spikes(x: np.ndarray, least: float) -> np.ndarray:
    """Return samples (T,) bool that go out and back by more than ``least`` and the usual, as no smooth motion does."""
    out = _returned(x)
    return (out > max(least, limits.UNUSUAL * float(np.quantile(out, 0.9)))) & (_off(x) > 0.5 * out)


def _off(x: np.ndarray) -> np.ndarray:
    """Return how far each sample (T,) lies from the cubic through its four neighbours; 0 at the ends."""
    off = np.zeros(len(x))
    off[2:-2] = np.abs(x[2:-2] - (4.0 * (x[1:-3] + x[3:-1]) - x[:-4] - x[4:]) / 6.0)
    return off


def _zeros(values: np.ndarray, at_ends: bool) -> np.ndarray:
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
        off = np.stack([_off(x) for x in values.T], axis=1)
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
