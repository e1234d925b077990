"""Recordings cut into windows: where they begin, in what state, and how noisy their readings are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from go1exp.gap.data.windows import PAST_S, Windows
from go1exp.gap.result import GapSettings
from go1exp.logs.recording import Recording, RecordingError

FIT_S = 0.014
"""Half width of the smoothing that gives a window's initial state, s, where samples are not too far apart for it."""

FIT_SAMPLES = 2.2  # least half width of that smoothing in samples

START_SD = (1.0e-3, 0.1)
"""Least uncertainty of a window's initial state, rad and rad/s (chosen: several times what smoothing leaves)."""

GAP = 2.5  # a step of the clock beyond this many periods is a hole that no window may have

QUANTITIES = ("q", "qd", "tau_est")
FOLLOWED = 0.05  # share of a stamp's lateness by which the even clock moves: a period 1 % off costs a fifth of one

THIRD = 20.0  # variance of the third difference of unit white noise: 1 + 9 + 9 + 1

BLOCK_QUANTILE = 0.907
"""30 % quantile of the root mean square of 50 third differences of white noise over its expectation (20000 draws)."""


def even_clock(recording: Recording) -> np.ndarray:
    """Return the times (T,) at which samples were taken, s.

    A logger's stamp may be late by the bus although the sample was taken on time; then the stamps jitter and the motion
    does not. Whether it does is read from the speeds: with stamps that are true, an angle departs from its neighbours
    by speed times departure of the stamp.
    """
    t = recording.t
    period = float(np.median(np.diff(t)))
    for apart in (k for k in (10, 50) if 4 * k <= len(t)):  # steps over which lateness hardly counts, and lost rows do
        spans = t[apart:] - t[:-apart]
        period = float(np.median(spans / np.round(spans / period)))
    number = _numbered(t, period)
    period, offset = np.polyfit(number, t, 1)
    jitter = t - (offset + period * number)
    usual = float(np.quantile(np.abs(jitter), 0.9))
    if len(t) < 20 or np.abs(jitter).max() < 1e-7 or usual > 0.5 * period:
        return t
    q, qd = recording.joint("q"), recording.joint("qd")
    whole = np.flatnonzero((np.diff(number, 2) == 0) & (np.diff(number)[:-1] == 1)) + 1
    bend = q[whole] - 0.5 * (q[whole - 1] + q[whole + 1])
    shift = (jitter[whole] - 0.5 * (jitter[whole - 1] + jitter[whole + 1]))[:, None] * qd[whole]
    fast = np.abs(qd[whole]) > 1.0
    # Curvature has the sign of the acceleration, that of the jitter any.
    true_jitter = (bend * shift)[fast].sum() / max(float((shift**2)[fast].sum()), 1e-12)
    return t if true_jitter > 0.5 else offset + period * number


def _numbered(t: np.ndarray, period: float) -> np.ndarray:
    """Return which sample of an even clock each stamp (T,) belongs to; the clock follows the stamps slowly."""
    number, clock = np.zeros(len(t)), float(t[0])
    for k in range(1, len(t)):
        steps = round((t[k] - clock) / period)
        clock += steps * period
        clock += (1.0 if steps > GAP else FOLLOWED) * (t[k] - clock)  # after a hole it begins anew
        number[k] = number[k - 1] + steps
    rows = np.arange(len(t))
    # A stamp so late that it seems to belong to the next sample belongs to the one before.
    return rows + np.minimum.accumulate((number - rows)[::-1])[::-1]


def noise_of(series: Sequence[np.ndarray]) -> np.ndarray:
    """Return the noise (J,) of several episodes' readings (T, J), as standard deviation.

    It is read from third differences where the robot moves least. Where values have steps so coarse that a resting
    joint shows none of its noise, a uniform error of one step counts.
    """
    blocks, steps = [], []
    for values in series:
        third = np.diff(values, 3, axis=0)
        count = len(third) // 50
        if count:
            cut = third[: 50 * count].reshape(count, 50, -1)
            blocks.append(np.sqrt(np.mean(cut**2, axis=1) / THIRD))
        change = np.abs(np.diff(values, axis=0))
        steps.append([float(np.min(c[c > 1e-12], initial=np.inf)) for c in change.T])
    if not blocks:
        rows = max(map(len, series))
        raise RecordingError(f"the longest recording has {rows} rows; 53 are needed to tell the noise; record longer")
    white = np.quantile(np.concatenate(blocks), 0.3, axis=0) / BLOCK_QUANTILE
    step = np.min(steps, axis=0)
    return np.maximum(white, np.where(np.isfinite(step), step, 0.0) / np.sqrt(12.0)).clip(1e-9)


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
    measured = np.concatenate([q[near] * w[0], qd[near] * w[1]])
    cubic = np.linalg.lstsq(design, measured, rcond=None)[0]
    misfit = np.sqrt(np.mean((design @ cubic - measured) ** 2, axis=0))
    return cubic[0], cubic[1], 2.0 * cubic[2], misfit


def _changes(t: np.ndarray, values: np.ndarray, begin: float, hi: float) -> tuple[np.ndarray, np.ndarray]:
    """Return when (E,), s since ``begin``, and to what (E, ...) a held signal changes; the past first, until ``hi``."""
    first = max(int(np.searchsorted(t, begin - PAST_S + 1e-9, side="right")) - 1, 0)
    last = int(np.searchsorted(t, hi, side="right"))
    part = values[first:last]
    moved = np.ones(len(part), dtype=bool)
    moved[1:] = np.any((part[1:] != part[:-1]).reshape(len(part) - 1, -1), axis=1)
    return t[first:last][moved] - begin, part[moved]


def bridged(t: np.ndarray, target: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times and targets with a row for every single lost sample, and the times of those that hide a step.

    A target that changes with every sample changed at the lost one too; held, it would be late by a sample. Whether a
    step happened at the lost sample or after is unknown.
    """
    lost = np.flatnonzero(np.abs(np.diff(t) / period - 2.0) < 0.5)
    lost = lost[(lost >= 1) & (lost + 2 < len(t))]
    before, last, first, after = (target[lost + k] for k in (-1, 0, 1, 2))
    flows = (last - before) * (after - first) > 0
    middle = np.where(flows, 0.5 * (last + first), last)
    hidden = t[lost][np.any((last != first) & ~flows, axis=1)]
    return np.insert(t, lost + 1, 0.5 * (t[lost] + t[lost + 1])), np.insert(target, lost + 1, middle, axis=0), hidden


@dataclass(frozen=True)
class Place:
    """Where a window may be, by the clock of its recording."""

    first: float  # earliest time at which it may begin, s
    last: float  # latest time, s
    end: float = np.inf  # time after which nothing is compared, s
    joints: tuple[int, ...] | None = None  # which are compared; all if None

    def compared(self, count: int) -> np.ndarray:
        """Return which of ``count`` joints are compared, (J,) bool."""
        return np.ones(count, dtype=bool) if self.joints is None else np.isin(np.arange(count), self.joints)


@dataclass(frozen=True)
class _Track:
    """One recording as it is cut: its clock and readings, its commands, and where its holes are."""

    number: int
    recording: Recording
    t: np.ndarray
    y: np.ndarray
    stamps: np.ndarray
    targets: np.ndarray
    enabled: np.ndarray
    holes: np.ndarray

    @staticmethod
    def from_recording(
        number: int, recording: Recording, t: np.ndarray, quantities: Sequence[str], period: float
    ) -> _Track:
        """Read a recording on the clock ``t`` (T,), s."""
        y = np.stack([recording.joint(name) for name in quantities], axis=1)
        stamps, targets, hidden = bridged(t, recording.joint("q_target"), period)
        enabled = recording.channels.get("torque_enable", np.ones(len(t), dtype=bool)).astype(bool)
        holes = np.concatenate([t[:-1][np.diff(t) > GAP * period], hidden])
        return _Track(number, recording, t, y, stamps, targets, enabled, holes)

    def whole(self, begin: float, length: float) -> bool:
        """Return whether nothing is missing between the commands before a window and its end."""
        return not np.any((self.holes > begin - PAST_S) & (self.holes < begin + length))


@dataclass(frozen=True)
class _Cutter:
    """How windows are cut: durations in s, ``samples`` per window, noise ``sd`` (C, J), half width of the smoothing."""

    settings: GapSettings
    sd: np.ndarray
    half: float
    samples: int
    doubt: Callable[[int, float], float]

    @property
    def length(self) -> float:
        """Time of a window, with what is replayed before it, s."""
        return self.settings.burn_s + self.settings.window_s

    def windows(self, track: _Track, places: Iterable[Place]) -> Iterator[dict[str, Any]]:
        """Cut one recording; every window as the fields of :class:`Windows` without the first axis."""
        for place in places:
            begin, state, misfit = self._smoothest(track, place)
            if np.isfinite(misfit) and track.whole(begin, self.length):
                yield self._window(track, begin, place, state)

    def evenly(self, track: _Track) -> Iterator[Place]:
        """Yield places one stride apart, each a third of a stride wide."""
        at = track.t[0] + PAST_S
        while at + self.settings.stride_s / 3 + self.length < track.t[-1]:
            yield Place(at, at + self.settings.stride_s / 3)
            at += self.settings.stride_s

    def _smoothest(self, track: _Track, place: Place) -> tuple[float, tuple[np.ndarray, ...], float]:
        """Return where at a place the initial state is known best, the state there, and its misfit."""
        tries = place.first + np.linspace(0.0, place.last - place.first, 9)
        tries = track.t[np.searchsorted(track.t, tries)]
        q, qd = track.y[:, 0], track.y[:, 1]
        states = [_start(track.t, q, qd, float(s), self.sd, self.half) for s in tries]
        compared = place.compared(q.shape[1])
        misfits = [
            f[3][compared].max() + self.doubt(track.number, float(s)) for f, s in zip(states, tries, strict=True)
        ]
        best = int(np.argmin(misfits))
        return float(tries[best]), states[best], misfits[best]

    def _window(self, track: _Track, begin: float, place: Place, state: tuple[np.ndarray, ...]) -> dict[str, Any]:
        """Return the window at ``place`` that begins at ``begin``, s, in ``state``."""
        t, end = track.t, begin + self.length
        shown = (t >= begin + self.settings.burn_s - 1e-9) & (t <= min(end, place.end) + 1e-9)
        inside = np.flatnonzero(shown)[: self.samples]
        q, qd, qdd, misfit = state
        return {
            "episode": track.number,
            "begin": begin,
            "origin": t[0],
            "q": q,
            "qd": qd,
            "qdd": qdd,
            "q_sd": START_SD[0] * np.maximum(misfit, 1.0),
            "qd_sd": START_SD[1] * np.maximum(misfit, 1.0),
            "kp": np.asarray(track.recording.meta.kp, dtype=float),
            "kd": np.asarray(track.recording.meta.kd, dtype=float),
            "t": _padded(t[inside] - begin, self.samples),
            "y": _padded(track.y[inside], self.samples),
            "valid": _padded(np.ones(len(inside), dtype=bool), self.samples),
            "scale": np.where(place.compared(self.sd.shape[1]), self.sd, np.inf),
            "edges": _changes(track.stamps, track.targets, begin, end),
            "switches": _changes(t, track.enabled, begin, end),
        }


def cut(
    recordings: Sequence[Recording],
    settings: GapSettings,
    doubt: Callable[[int, float], float] = lambda number, at: 0.0,
    places: Sequence[Sequence[Place]] | None = None,
) -> Windows:
    """Cut recordings of one robot into windows, one stride apart or at ``places`` of each recording.

    A window begins where the motion is smooth, within a third of a stride of where it should, since its initial state
    comes from smoothing. Windows with holes are left out. ``doubt`` returns what to add to the misfit of an initial
    state of a recording (number) at a time, s; where it is infinite, no window begins. RecordingError if not one window
    fits.
    """
    quantities = QUANTITIES if settings.torque and all(r.has("tau_est") for r in recordings) else QUANTITIES[:2]
    sd = np.stack([noise_of([r.joint(name) for r in recordings]) for name in quantities])
    clocks = [even_clock(r) for r in recordings]
    period = float(np.median([np.median(np.diff(t)) for t in clocks]))
    if settings.window_s < 2.0 * period:
        least = f"a window must have two steps of the recordings, {2.0 * period:g} s"
        raise RecordingError(f"search.window_s = {settings.window_s:g}: {least}")
    samples = int(np.ceil(settings.window_s / period)) + 1
    cutter = _Cutter(settings, sd, max(FIT_S, FIT_SAMPLES * period), samples, doubt)
    tracks = (
        _Track.from_recording(k, r, t, quantities, period)
        for k, (r, t) in enumerate(zip(recordings, clocks, strict=True))
    )
    rows = [
        window
        for track in tracks
        for window in cutter.windows(track, cutter.evenly(track) if places is None else places[track.number])
    ]
    if not rows:
        spaced = f" with one in {settings.stride_s:g} s (search.stride_s)" if places is None else ""
        raise RecordingError(
            f"no window of {settings.burn_s:g} + {settings.window_s:g} s fits into these recordings{spaced}; "
            "record longer ones"
        )
    plain = {key: np.stack([row[key] for row in rows]) for key in rows[0] if key not in ("edges", "switches")}
    return Windows(
        joints=recordings[0].meta.joints,
        quantities=quantities,
        period=period,
        edges=tuple(row["edges"] for row in rows),
        switches=tuple(row["switches"] for row in rows),
        length=cutter.length + 1e-9,
        **plain,
    )


def _padded(values: np.ndarray, rows: int) -> np.ndarray:
    """Repeat the last row up to ``rows``; False for flags."""
    missing = rows - len(values)
    fill = np.zeros_like(values[-1:]) if values.dtype == bool else values[-1:]
    return np.concatenate([values, np.repeat(fill, missing, axis=0)]) if missing else values
