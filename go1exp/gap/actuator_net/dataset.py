"""Recordings -> rows of (history window, torque), split by episode and never by sample.

Each row belongs to one sample of the recording; its target is the torque of that sample. Its taps go back from the time
of that sample in steps of ``period``, on the recording's own clock, which may be irregular: measured channels are
interpolated linearly between the two samples around a tap, commands are those in force at it (zero-order hold).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.signal import savgol_filter

from go1exp.base.wording import counted
from go1exp.config.schema.registry import unknown_name
from go1exp.gap.actuator_net.settings import FitError
from go1exp.logs.recording import Recording, as_json
from go1exp.sim.actuator.actuator_net import InputName, Target

JointTorque = Callable[[Recording], np.ndarray]
"""Recording -> torque at its joints ``(T, J)``, N m, in the order of ``meta.joints``; NaN where it is not known."""

GAP = 5.0
"""A window is left out if it spans a step of the clock longer than this many periods (of taps or of samples, whichever
is longer; chosen: the motion within such a gap is not in the recording)."""

EDGE = 1e-6
"""s; a command logged this much after a tap counts as in force at it, so that rounding of the clock has no effect."""


@dataclass(frozen=True, eq=False)
class Rows:
    """R rows of some episodes and joints."""

    x: np.ndarray  # features ``(R, F)``
    y: np.ndarray  # target torque ``(R,)``, N m
    joint: np.ndarray  # index of the joint ``(R,)``
    episode: np.ndarray  # index in the list of recordings ``(R,)``
    t: np.ndarray  # time stamp ``(R,)``, s
    speed: np.ndarray  # joint velocity ``(R,)``, rad/s; NaN where it was not recorded
    since_reversal: np.ndarray  # time to the nearest change of the velocity's sign ``(R,)``, s; inf where there is none
    command: np.ndarray  # the command as a torque ``(R,)``, N m: ``tau_cmd``, else kp e; NaN where neither is known
    pd: np.ndarray  # kp e - kd qd ``(R,)``, N m; NaN where gains or channels are unknown

    def __len__(self) -> int:
        return len(self.y)

    def take(self, which: np.ndarray) -> Rows:
        """Return the rows that a mask or an index array picks."""
        return Rows(**{f.name: getattr(self, f.name)[which] for f in fields(self)})


def concatenate(parts: Sequence[Rows]) -> Rows:
    """Put rows one after the other."""
    return Rows(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Rows)})


def windows(
    recordings: Sequence[Recording],
    inputs: tuple[InputName, ...],
    history: int,
    period: float,
    target: Target = "tau_est",
    joint_torque: JointTorque | None = None,
    smoothing: float | None = None,
) -> Rows:
    """Cut recordings into rows; see the module for how.

    With ``smoothing`` (s) angle and speed of the inputs come from ``smooth_motion`` over that window. In simulation a
    net gets motion without noise; a net that was trained on noisy speeds has learnt small weights for them, which blurs
    friction.

    Rows are left out if their window reaches before the start of the recording, over a gap of its clock, or into a time
    in which ``torque_enable`` is false, or if their target is not finite. RecordingError if a recording has no such
    channel; names it. FitError if the target needs a ``joint_torque`` and there is none.
    """
    if target == "joint_torque" and joint_torque is None:
        raise FitError(
            "target joint_torque: needs the robot's inverse dynamics (a function of a recording); none given"
        )
    parts = []
    for index, recording in enumerate(recordings):
        if target == "joint_torque" and joint_torque is not None:
            torque = joint_torque(recording)
        else:
            torque = recording.joint("tau_est")
        measured = {q: recording.joint(q) for q in ("q", "qd") if recording.has(q)}
        if smoothing is not None:
            motion = smooth_motion(recording, smoothing)
            measured |= {"q": motion.q, "qd": motion.qd}
        parts.append(_episode(recording, measured, index, inputs, history, period, torque))
    return concatenate(parts)


def _episode(
    recording: Recording,
    measured: Mapping[str, np.ndarray],
    index: int,
    inputs: tuple[InputName, ...],
    history: int,
    period: float,
    torque: np.ndarray,
) -> Rows:
    t, joints = recording.t, len(recording.meta.joints)
    if torque.shape != (len(t), joints):
        raise FitError(
            f"{recording.meta.episode}: joint_torque must be of shape {(len(t), joints)}, not {torque.shape}"
        )
    whole = np.flatnonzero(_whole(recording, t - period * (history - 1), period))
    taps = t[whole, None] - period * np.arange(history)
    held = np.maximum(np.searchsorted(t, taps + EDGE, side="right") - 1, 0)
    signals = [_signal(recording, measured, name, taps, held) for name in inputs]  # each (W, H, J)
    x = np.concatenate(signals, axis=1)  # (W, F, J): input by input, newest tap first
    qd = recording.joint("qd") if recording.has("qd") else np.full((len(t), joints), np.nan)
    reversal = np.stack([_since_reversal(t, qd[:, j]) for j in range(joints)], axis=1)
    command, pd = _references(recording)
    parts = []
    for j in range(joints):
        known = np.isfinite(torque[whole, j]) & np.isfinite(x[:, :, j]).all(axis=1)
        keep = whole[known]
        joint, episode = np.full(len(keep), j), np.full(len(keep), index)
        y, speed, since, com, ideal = (values[keep, j] for values in (torque, qd, reversal, command, pd))
        parts.append(Rows(x[known, :, j], y, joint, episode, t[keep], speed, since, com, ideal))
    return concatenate(parts)


def _signal(
    recording: Recording, measured: Mapping[str, np.ndarray], name: InputName, taps: np.ndarray, held: np.ndarray
) -> np.ndarray:
    """Return one input at every tap, (T, H, J)."""
    if name == "tau_cmd":
        return recording.joint("tau_cmd")[held]
    quantity = {"velocity": "qd", "position": "q", "position_error": "q"}[name]
    values = measured[quantity] if quantity in measured else recording.joint(quantity)
    at_taps = np.stack([np.interp(taps, recording.t, column) for column in values.T], axis=2)
    return recording.joint("q_target")[held] - at_taps if name == "position_error" else at_taps


def _whole(recording: Recording, oldest: np.ndarray, period: float) -> np.ndarray:
    """Return which rows (T,) have their whole window in the recording, without a gap and with actuators on."""
    t = recording.t
    first = np.searchsorted(t, oldest + EDGE, side="right") - 1  # last sample at or before the oldest tap
    inside = oldest >= t[0] - EDGE
    longest = GAP * max(period, float(np.median(np.diff(t))) if len(t) > 1 else period)
    # Cumulative counts: a window is free of gaps if the count at both its ends is equal.
    bad_steps = np.concatenate([[0], np.cumsum(np.diff(t) > longest)])
    off = ~recording.channels["torque_enable"] if "torque_enable" in recording.channels else np.zeros(len(t), bool)
    off_before = np.concatenate([[0], np.cumsum(off)])  # [i]: number of samples before i that are off
    start, row = np.maximum(first, 0), np.arange(len(t))
    return np.asarray(inside & (bad_steps[row] == bad_steps[start]) & (off_before[row + 1] == off_before[start]))


def _since_reversal(t: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return the time (T,), s, between each sample and the nearest sign change of qd; a zero keeps the last sign."""
    sign = np.sign(qd)
    moving = np.flatnonzero(sign != 0)
    if len(moving) == 0 or not np.isfinite(qd).all():
        return np.full(len(t), np.inf)
    turns = t[moving[1:][np.diff(sign[moving]) != 0]]
    if len(turns) == 0:
        return np.full(len(t), np.inf)
    # nearest of the turn before and the turn after each sample
    after = np.clip(np.searchsorted(turns, t), 1, len(turns) - 1) if len(turns) > 1 else np.zeros(len(t), int)
    return np.asarray(np.minimum(np.abs(turns[after] - t), np.abs(turns[after - 1] - t)))


def _references(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return the command as a torque, and the PD law, (T, J) each; NaN where unknown."""
    meta = recording.meta
    unknown = np.full((len(recording.t), len(meta.joints)), np.nan)
    command, pd = unknown, unknown
    if meta.kp is not None and recording.has("q_target") and recording.has("q"):
        command = np.array(meta.kp) * (recording.joint("q_target") - recording.joint("q"))
        if meta.kd is not None and recording.has("qd"):
            pd = command - np.array(meta.kd) * recording.joint("qd")
    return (recording.joint("tau_cmd") if recording.has("tau_cmd") else command), pd


# ---------------------------------------------------------------------- episodes


@dataclass(frozen=True)
class Split:
    """Names of the episodes for training, for deciding when to stop, and held out for the report."""

    train: tuple[str, ...]
    validation: tuple[str, ...]
    held_out: tuple[str, ...]


def split(
    recordings: Sequence[Recording], holdout: float | tuple[str, ...], validation: float | tuple[str, ...], seed: int
) -> Split:
    """Divide whole episodes among the three parts; an episode and its repeats (``repeat_of``) stay together.

    A number (0.2) takes this share of the clusters of repeats, at least one, in an order drawn with ``seed``; held-out
    episodes are drawn before those for validation. A named episode takes its repeats with it. FitError if a name is
    unknown or occurs twice, or nothing is left to train on.
    """
    names = [recording.meta.episode for recording in recordings]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise FitError(f"episodes must have different names; {', '.join(twice)} occurs more than once")
    clusters = _clusters(recordings)
    order = np.random.default_rng(seed).permutation(len(clusters))
    shuffled = [clusters[i] for i in order]
    chosen: dict[str, set[str]] = {"holdout": set(), "validation": set()}
    # Names first: a share is drawn from the episodes that are not named.
    requests: list[tuple[str, float | tuple[str, ...]]] = [("holdout", holdout), ("validation", validation)]
    for key, request in sorted(requests, key=lambda pair: isinstance(pair[1], float)):
        taken = set().union(*chosen.values())
        if isinstance(request, float):
            free = [cluster for cluster in shuffled if not cluster & taken]
            chosen[key] = set().union(*free[: max(1, round(request * len(clusters)))])
            continue
        unknown = [unknown_name(key, name, names, "episode") for name in request if name not in names]
        if unknown:
            raise FitError("\n".join(unknown))
        chosen[key] = set().union(*(c for c in clusters if c & set(request)))
        both = sorted(chosen[key] & taken)
        if both:
            raise FitError(f"{key}: {', '.join(both)} repeats an episode of the other part")
    rest = [name for name in names if name not in set().union(*chosen.values())]
    if not (rest and chosen["holdout"] and chosen["validation"]):
        raise FitError(
            f"{counted(len(names), 'episode')} in {counted(len(clusters), 'group')} of repeats cannot be split into"
            " training, validation and held-out ones; record at least three that repeat no other, or name fewer for"
            " holdout and validation"
        )
    return Split(
        tuple(rest),
        tuple(n for n in names if n in chosen["validation"]),
        tuple(n for n in names if n in chosen["holdout"]),
    )


def _clusters(recordings: Sequence[Recording]) -> list[set[str]]:
    """Return sets of episodes that repeat each other, in the order of their first; the original may be missing."""
    order = {r.meta.episode: i for i, r in enumerate(recordings)}
    merged: list[set[str]] = []
    for r in recordings:
        link = {r.meta.episode, r.meta.repeat_of or r.meta.episode}
        touching = [cluster for cluster in merged if cluster & link]
        merged = [cluster for cluster in merged if not cluster & link] + [link.union(*touching)]
    return sorted((c & set(order) for c in merged), key=lambda cluster: min(order[name] for name in cluster))


def fingerprint(recording: Recording) -> str:
    """Return the SHA-256 of a recording: its metadata as JSON, then its columns by name, as float64 bytes."""
    # Sorted by name and always float64, so that neither column order nor file format changes the hash.
    digest = hashlib.sha256(as_json(recording.meta))
    for name in sorted(recording.channels):
        digest.update(name.encode() + b"\0")
        digest.update(np.ascontiguousarray(recording.channels[name], dtype=np.float64).tobytes())
    return digest.hexdigest()


# ---------------------------------------------------------------------- smooth motion, for inverse dynamics

ORDER = 3  # order of the polynomial: the lowest whose second derivative may change within the window

WINDOW = 0.06
"""s; passes motion to about 20 Hz (half amplitude at 1.2 / window for this order) and removes noise above (chosen)."""


@dataclass(frozen=True, eq=False)
class SmoothMotion:
    """Motion at time stamps: q rad, qd rad/s, qdd rad/s^2, each ``(T, J)``; NaN in the half window at either end."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


def smooth_motion(recording: Recording, window: float = WINDOW) -> SmoothMotion:
    """Differentiate the measured angles with a Savitzky-Golay filter of ``window`` s (third order, symmetric: no lag).

    The angles are resampled linearly to the median step of the clock, filtered, and read off at the recording's own
    time stamps. Only ``q`` is used: the ``qd`` of an actuator has already been filtered. FitError if the window holds
    fewer than ORDER + 2 samples or the recording is shorter than it. RecordingError if there is no ``q``.
    """
    t, q = recording.t, recording.joint("q")
    step = float(np.median(np.diff(t))) if len(t) > 1 else window
    length = 2 * round(window / step / 2) + 1
    grid = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-9) + 1)
    if length < ORDER + 2 or len(grid) < length:
        raise FitError(
            f"{recording.meta.episode}: a window of {window:g} s is {length} samples of {len(grid)}; it must hold at "
            f"least {ORDER + 2} and fit into the recording"
        )
    even = np.stack([np.interp(grid, t, column) for column in q.T], axis=1)
    half = length // 2 * step
    edge = half - step / 1000  # so that rounding of the clock removes no sample
    inner = (t >= grid[0] + edge) & (t <= grid[-1] - edge)
    derivatives = []
    for order in range(3):
        smooth = savgol_filter(even, length, ORDER, deriv=order, delta=step, axis=0)
        back = np.stack([np.interp(t, grid, column) for column in smooth.T], axis=1)
        derivatives.append(np.where(inner[:, None], back, np.nan))
    return SmoothMotion(*derivatives)
