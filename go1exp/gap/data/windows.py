"""Recordings cut into short windows: what to replay, what to compare it with, and how noisy it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from go1exp.gap.result import GapSettings
from go1exp.recording import Recording, RecordingError

PAST_S = 0.064
"""Commands before a window that are kept, s: the longest command delay that an effect may have, and a little."""

FIT_S = 0.014
"""Half width of the smoothing that gives a window's first state, s, where samples are not too far apart for it."""

FIT_SAMPLES = 2.2
"""Least half width of that smoothing in samples."""

START_SD = (1.0e-3, 0.1)
"""Least uncertainty of a window's first state, rad and rad/s (chosen: several times what smoothing leaves)."""

GAP = 2.5
"""A step of the clock beyond this many periods is a hole that no window may have."""

QUANTITIES = ("q", "qd", "tau_est")
THIRD = 20.0
"""Variance of the third difference of unit white noise: 1 + 9 + 9 + 1."""

BLOCK_QUANTILE = 0.907
"""30 % quantile of the root mean square of 50 third differences of white noise over its expectation (20000 draws)."""


@dataclass(frozen=True)
class Windows:
    """W windows of at most n samples of C quantities of J joints; what is missing has weight 0.

    Attributes:
        joints: their names.
        quantities: names of the C quantities.
        period: the logger's, s.
        episode: (W,) index of the recording.
        begin: (W,) time of the first state by the recording's clock, s.
        origin: (W,) time at which the recording begins, by the same clock, s.
        q: (W, J) first state, rad.
        qd: (W, J) rad/s.
        qdd: (W, J) rad/s2.
        q_sd: (W, J) its standard deviation.
        qd_sd: (W, J)
        kp: (W, J) gains.
        kd: (W, J)
        t: (W, n) times of the samples since the first state, s.
        y: (W, n, C, J) what was measured.
        scale: (W, C, J) standard deviation of its noise.
        valid: (W, n) bool.
        edges: per window, times (E,) since the first state and targets (E, J) in force from each on.
        switches: per window, times (E,) and whether the drives are on from each on.
        length: time to replay, s.
    """

    joints: tuple[str, ...]
    quantities: tuple[str, ...]
    period: float
    episode: np.ndarray
    begin: np.ndarray
    origin: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    q_sd: np.ndarray
    qd_sd: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    t: np.ndarray
    y: np.ndarray
    scale: np.ndarray
    valid: np.ndarray
    edges: tuple[tuple[np.ndarray, np.ndarray], ...]
    switches: tuple[tuple[np.ndarray, np.ndarray], ...]
    length: float

    def __len__(self) -> int:
        return len(self.episode)

    @property
    def elapsed(self) -> np.ndarray:
        """(W,) time of the first state since the episode began, s."""
        return self.begin - self.origin

    @property
    def of_joints(self) -> int:
        """How many of the quantities, the first ones, are the joints'."""
        return len(self.quantities)

    @property
    def base_sd(self) -> np.ndarray:
        """(W, B) standard deviations of a free base's first state; B is 0 for one that is held."""
        return np.empty((len(self), 0))

    @property
    def channels(self) -> tuple[tuple[str, int, int], ...]:
        """Name, quantity and place of every reading."""
        return tuple((f"{q}_{j}", c, i) for c, q in enumerate(self.quantities) for i, j in enumerate(self.joints))

    def by_quantity(self, values: np.ndarray) -> dict[str, float]:
        """Return the median of values (W, C, J) by quantity."""
        return {name: float(np.median(values[:, c])) for c, name in enumerate(self.quantities)}

    def unknown(self, y: np.ndarray) -> list[np.ndarray]:
        """Return changes of the readings ``y`` (W, n, C, J) per standard deviation of what sensors may be off by."""
        return []

    def loads(self) -> np.ndarray | None:
        """Return which joints' legs carry weight (W, n, J) bool; None for a robot that is held."""
        return None


def even_clock(recording: Recording) -> np.ndarray:
    """Return the times (T,) at which samples were taken, s.

    A logger's stamp may be late by the bus although the sample was taken on time; then the stamps jitter and the motion
    does not. Whether it does is read from the speeds: with stamps that are true, an angle departs from its neighbours
    by speed times departure of the stamp.
    """
    t = recording.t
    period = float(np.median(np.diff(t)))
    number = np.concatenate([[0.0], np.cumsum(np.round(np.diff(t) / period))])  # from one stamp to the next: no drift
    period, offset = np.polyfit(number, t, 1)
    late = t - (offset + period * number)
    if len(t) < 20 or np.abs(late).max() < 1e-7 or np.any(np.diff(number) < 1) or np.abs(late).max() > 0.5 * period:
        return t
    q, qd = recording.joint("q"), recording.joint("qd")
    whole = np.flatnonzero((np.diff(number, 2) == 0) & (np.diff(number)[:-1] == 1)) + 1
    bend = q[whole] - 0.5 * (q[whole - 1] + q[whole + 1])
    shift = (late[whole] - 0.5 * (late[whole - 1] + late[whole + 1]))[:, None] * qd[whole]
    fast = np.abs(qd[whole]) > 1.0
    # Curvature has the sign of the acceleration, that of the jitter any.
    true_jitter = (bend * shift)[fast].sum() / max(float((shift**2)[fast].sum()), 1e-12)
    return t if true_jitter > 0.5 else offset + period * number


def noise(recordings: Sequence[Recording], quantity: str) -> np.ndarray:
    """Return the noise of a quantity (J,), as standard deviation: from third differences where the robot moves least.

    Where values have steps so coarse that a resting joint shows none of its noise, a uniform error of one step counts.
    """
    return noise_of([r.joint(quantity) for r in recordings])


def noise_of(series: Sequence[np.ndarray]) -> np.ndarray:
    """Return the noise of several episodes' readings (T, J), in the way of :func:`noise`."""
    blocks, steps = [], []
    for values in series:
        third = np.diff(values, 3, axis=0)
        count = len(third) // 50
        if count:
            cut = third[: 50 * count].reshape(count, 50, -1)
            blocks.append(np.sqrt(np.mean(cut**2, axis=1) / THIRD))
        change = np.abs(np.diff(values, axis=0))
        steps.append([float(np.min(c[c > 1e-12], initial=np.inf)) for c in change.T])
    found = np.quantile(np.concatenate(blocks), 0.3, axis=0) / BLOCK_QUANTILE
    step = np.min(steps, axis=0)
    return np.maximum(found, np.where(np.isfinite(step), step, 0.0) / np.sqrt(12.0)).clip(1e-9)


def _start(
    t: np.ndarray, q: np.ndarray, qd: np.ndarray, at: float, sd: np.ndarray, half: float = FIT_S
) -> tuple[np.ndarray, ...]:
    """Fit a cubic about an instant; return angle, speed, acceleration, and the misfit in units of noise (J,)."""
    near = np.abs(t - at) <= half
    x = t[near] - at
    one, zero = np.ones_like(x), np.zeros_like(x)
    angle, speed = np.stack([one, x, x**2, x**3], 1), np.stack([zero, one, 2 * x, 3 * x**2], 1)
    w = np.array([1.0 / np.median(sd[0]), 1.0 / np.median(sd[1])])
    design = np.concatenate([angle * w[0], speed * w[1]])
    seen = np.concatenate([q[near] * w[0], qd[near] * w[1]])
    found = np.linalg.lstsq(design, seen, rcond=None)[0]
    misfit = np.sqrt(np.mean((design @ found - seen) ** 2, axis=0))
    return found[0], found[1], 2.0 * found[2], misfit


def _changes(t: np.ndarray, values: np.ndarray, lo: float, hi: float) -> tuple[np.ndarray, np.ndarray]:
    """Return when (E,) and to what (E, ...) a held signal changes between two times, the first in force at ``lo``."""
    first = max(int(np.searchsorted(t, lo + 1e-9, side="right")) - 1, 0)
    last = int(np.searchsorted(t, hi, side="right"))
    part = values[first:last]
    moved = np.ones(len(part), dtype=bool)
    moved[1:] = np.any((part[1:] != part[:-1]).reshape(len(part) - 1, -1), axis=1)
    return t[first:last][moved], part[moved]


def bridged(t: np.ndarray, target: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times and targets with a row for every single lost sample, and the times of those that hide a step.

    A target that changes with every sample changed at the lost one too; taking it for held there makes it late by a
    sample, which is a gap of its own. Whether a target that stepped did so at the lost sample or after, nobody knows.
    """
    lost = np.flatnonzero(np.abs(np.diff(t) / period - 2.0) < 0.5)
    lost = lost[(lost >= 1) & (lost + 2 < len(t))]
    before, last, first, after = (target[lost + k] for k in (-1, 0, 1, 2))
    flows = (last - before) * (after - first) > 0
    middle = np.where(flows, 0.5 * (last + first), last)
    hidden = t[lost][np.any((last != first) & ~flows, axis=1)]
    return np.insert(t, lost + 1, 0.5 * (t[lost] + t[lost + 1])), np.insert(target, lost + 1, middle, axis=0), hidden


def cut(
    recordings: Sequence[Recording],
    settings: GapSettings,
    doubt: Callable[[int, float], float] = lambda number, at: 0.0,
) -> Windows:
    """Cut recordings of one robot into windows.

    A window begins where the motion is smooth, within a third of a stride of where it should, since its first state
    comes from smoothing. Windows with holes are left out. ``doubt`` adds to the misfit of a first state of recording
    ``number`` at time ``at``, s; where it is infinite none begins.
    """
    joints = recordings[0].meta.joints
    quantities = QUANTITIES if settings.torque and all(r.has("tau_est") for r in recordings) else QUANTITIES[:2]
    sd = np.stack([noise(recordings, name) for name in quantities])
    clocks = [even_clock(r) for r in recordings]
    period = float(np.median([np.median(np.diff(t)) for t in clocks]))
    half = max(FIT_S, FIT_SAMPLES * period)
    rows: list[dict[str, Any]] = []
    long = settings.burn_s + settings.window_s
    most = int(np.ceil(settings.window_s / period)) + 1
    for number, (r, t) in enumerate(zip(recordings, clocks, strict=True)):
        y = np.stack([r.joint(name) for name in quantities], axis=1)
        target = r.joint("q_target")
        stamps, asked, hidden = bridged(t, target, period)
        on = r.channels.get("torque_enable", np.ones(len(t), dtype=bool)).astype(bool)
        holes = np.concatenate([t[:-1][np.diff(t) > GAP * period], hidden])
        at = t[0] + PAST_S
        while at + settings.stride_s / 3 + long < t[-1]:
            tries = at + np.linspace(0.0, settings.stride_s / 3, 9)
            tries = t[np.searchsorted(t, tries)]
            fits = [_start(t, y[:, 0], y[:, 1], float(s), sd, half) for s in tries]
            misfits = [f[3].max() + doubt(number, float(s)) for f, s in zip(fits, tries, strict=True)]
            best = int(np.argmin(misfits))
            begin, (q, qd, qdd, misfit) = float(tries[best]), fits[best]
            at += settings.stride_s
            if not np.isfinite(misfits[best]) or np.any((holes > begin - PAST_S) & (holes < begin + long)):
                continue
            inside = np.flatnonzero((t >= begin + settings.burn_s - 1e-9) & (t <= begin + long + 1e-9))[:most]
            rows.append(
                {
                    "episode": number,
                    "begin": begin,
                    "origin": t[0],
                    "q": q,
                    "qd": qd,
                    "qdd": qdd,
                    "q_sd": START_SD[0] * np.maximum(misfit, 1.0),
                    "qd_sd": START_SD[1] * np.maximum(misfit, 1.0),
                    "kp": np.asarray(r.meta.kp, dtype=float),
                    "kd": np.asarray(r.meta.kd, dtype=float),
                    "t": _padded(t[inside] - begin, most),
                    "y": _padded(y[inside], most),
                    "valid": _padded(np.ones(len(inside), dtype=bool), most),
                    "edges": _since(begin, _changes(stamps, asked, begin - PAST_S, begin + long)),
                    "switches": _since(begin, _changes(t, on, begin - PAST_S, begin + long)),
                }
            )
    if not rows:
        raise RecordingError(
            f"no window of {settings.burn_s:g} + {settings.window_s:g} s fits into these recordings; record longer ones"
        )
    plain = {key: np.stack([row[key] for row in rows]) for key in rows[0] if key not in ("edges", "switches")}
    return Windows(
        joints=joints,
        quantities=quantities,
        period=period,
        scale=np.broadcast_to(sd, (len(rows), *sd.shape)).copy(),
        edges=tuple(row["edges"] for row in rows),
        switches=tuple(row["switches"] for row in rows),
        length=long + 1e-9,
        **plain,
    )


def _since(begin: float, changes: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return changes[0] - begin, changes[1]


def _padded(values: np.ndarray, rows: int) -> np.ndarray:
    """Repeat the last row up to ``rows``; False for flags."""
    missing = rows - len(values)
    fill = np.zeros_like(values[-1:]) if values.dtype == bool else values[-1:]
    return np.concatenate([values, np.repeat(fill, missing, axis=0)]) if missing else values


def averaged(changes: tuple[np.ndarray, np.ndarray], times: np.ndarray) -> np.ndarray:
    """Return the means (K, ...) of a held signal over the even steps that begin at ``times`` (K,).

    That is second order in the step for changes between steps too, as the plant lets a change at the beginning of a
    step count for half of it.
    """
    at, values = changes
    place = (at - times[0]) / (times[1] - times[0])
    index = np.searchsorted(place, np.arange(len(times)) + 1e-6, side="right") - 1
    found = np.array(values[index.clip(0)], dtype=float)
    step = np.floor(place + 1e-6).astype(int)
    share = 1.0 - (place - step)
    for k in np.flatnonzero((step >= 0) & (step < len(times)) & (place - step > 1e-6)):
        if k:  # the first is in force from the beginning
            found[step[k]] += share[k] * (values[k] - values[k - 1])
    return found


def held(changes: tuple[np.ndarray, np.ndarray], times: np.ndarray) -> np.ndarray:
    """Return the values (K, ...) of a held signal at even ``times`` (K,); it changes at the nearest of them."""
    index = np.searchsorted(changes[0], times + 0.49 * (times[1] - times[0]), side="right") - 1
    return np.asarray(changes[1][index.clip(0)])
