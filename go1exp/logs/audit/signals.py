"""Channels of a recording, and estimators that need no model of the robot: step, noise, repeats, clipping, scale."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import linear_sum_assignment

import go1exp.logs.audit.limits as limits
from go1exp.logs.audit.report import Finding, Verdict
from go1exp.logs.recording import FOOT_FORCE, JOINT_QUANTITIES, VECTORS, Recording, joint_channels

MOST_GAPS = 300  # most gaps in which a step is searched; of more, a part is taken, evenly over their sorted order


def stretches(flags: np.ndarray) -> list[tuple[int, int]]:
    """Return (first, end) of each run of true ``flags`` (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def quantum(values: np.ndarray) -> float:
    """Return the quantisation step of ``values`` (T,): all differences are whole multiples of it; 0 if there is none.

    Candidates are small gaps between neighbouring distinct values, and fractions of them. A candidate is refined by
    regression on larger and larger gaps. It is accepted if the gaps are whole multiples of it: the mean resultant of
    their phases exceeds 0.9, which allows for rounding to a tenth of a step, as in decimal text.
    """
    distinct = np.unique(values)
    gaps = np.diff(distinct)
    largest = float(np.abs(distinct[[0, -1]]).max())
    gaps = np.sort(gaps[gaps > 1e-9 * largest])
    least = 2 if len(values) > 20 * len(distinct) else 10  # few distinct values that occur often are quantised too
    if len(gaps) < least:
        return 0.0
    gaps = gaps[:: -(-len(gaps) // MOST_GAPS)]
    guesses = {float(gaps[int(share * len(gaps))]) / m for share in (0, 0.02, 0.1, 0.5) for m in range(1, 7)}
    steps = _refined(gaps, np.array(sorted(guesses, reverse=True)))
    steps = steps[steps > limits.CONTINUOUS * largest]
    whole = np.abs(np.exp(2j * np.pi * gaps / steps[:, None]).mean(axis=1)) > 0.9
    return float(steps[whole][0]) if whole.any() else 0.0


def _refined(gaps: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Refine candidates (C,) by regression of ``gaps`` (G,) on whole multiples of them, of larger and larger gaps."""
    refining = np.ones(len(steps), dtype=bool)
    for most in (3, 10, 30, 100):
        count = np.round(gaps / steps[:, None])
        count[(count < 1) | (count > most)] = 0.0
        squares = np.einsum("cg,cg->c", count, count)
        refining &= squares > 0  # a candidate is left as it is from where no gap is near enough
        steps = np.where(refining, count @ gaps / np.maximum(squares, 1.0), steps)
    return steps


def noise(values: np.ndarray) -> tuple[float, bool]:
    """Return the standard deviation of white noise on a smooth signal (T,), and whether it looks white.

    Third differences remove the smooth part; their median ignores rare events. Fifth differences give the same value
    for white noise and another one for motion.
    """
    if len(values) < limits.ENOUGH:
        return float("nan"), False
    sigma = []
    for order, gain in ((3, 20.0), (5, 252.0)):  # sums of the squared binomial coefficients
        d = np.diff(values, order)
        sigma.append(1.4826 * float(np.median(np.abs(d - np.median(d)))) / np.sqrt(gain))
    # 1.4826 times the median absolute deviation is the standard deviation of a Gaussian.
    sigma = [s if s > 1e-9 * float(np.ptp(values)) else 0.0 for s in sigma]
    white = sigma[0] > 0 and limits.WHITE[0] < sigma[1] / sigma[0] < limits.WHITE[1]
    return sigma[0], white


@dataclass(frozen=True)
class Repeats:
    """Samples (T,) at which a channel moved, the stale ones of them, and the share of stale ones beyond chance."""

    moving: np.ndarray
    stale: np.ndarray
    share: float


def repeats(values: np.ndarray, step: float, reach: int) -> Repeats:
    """Find samples that repeat the one before although the channel moves.

    A channel moves at a sample if, over the ``reach`` samples before it and those after it, it changes in the same
    direction and by at least two steps per sample. A value may then repeat by chance, but not more often than it
    changes by one step; only the repeats beyond that count.
    """
    n = len(values)
    moving, same = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    same[1:] = values[1:] == values[:-1]
    least = reach * max(2 * step, 1e-7 * float(np.ptp(values)))
    i = np.arange(reach + 1, n - reach)
    if least == 0 or not len(i):
        return Repeats(moving, same & moving, 0.0)
    before, after = values[i - 1] - values[i - 1 - reach], values[i + reach] - values[i]
    moving[i] = (np.abs(before) >= least) & (np.abs(after) >= least) & (before * after > 0)
    forward = (values[i] - values[i - 1]) * np.sign(after)
    natural = np.sum(moving[i] & (forward > 0.5 * step) & (forward < 1.5 * step)) if step else 0
    count, twice = int(moving.sum()), int(np.sum(same & moving))
    excess = twice - int(natural)
    sure = count >= limits.ENOUGH and excess > limits.SURE * np.sqrt(twice + natural)
    return Repeats(moving, same & moving, excess / count if sure else 0.0)


def clipped(values: np.ndarray, step: float) -> tuple[float, list[float]]:
    """Return the share of samples (T,) on flat extremes, entered or left at speed as no smooth peak is, and levels."""
    span = float(np.ptp(values))
    share, levels = 0.0, []
    for level in (float(values.max()), float(values.min())):
        runs = [(a, b) for a, b in stretches(np.abs(values - level) <= 1e-9 * span) if b - a >= limits.PLATEAU]
        fast = max(6 * step, 1e-3 * span)  # over two samples, as the first may just miss the level
        around = [[values[i] for i in (a - 2, b + 1) if 0 <= i < len(values)] for a, b in runs]
        hard = [run for run, v in zip(runs, around, strict=True) if v and np.abs(np.array(v) - level).min() > fast]
        if len(hard) >= 2 or any(b - a >= 2 * limits.PLATEAU for a, b in hard):
            share += sum(b - a for a, b in hard) / len(values)
            levels.append(level)
    return share, levels


@dataclass(frozen=True)
class Scale:
    """One channel against another: factor, its standard error, correlation."""

    factor: float
    error: float
    correlation: float


def scale(reference: np.ndarray, other: np.ndarray, blocks: int = 10) -> Scale | None:
    """Return the least-squares size of ``other`` (N,) to ``reference`` (N,), and its jackknife error, or None."""
    if len(reference) < limits.ENOUGH:
        return None
    parts = np.array_split(np.arange(len(reference)), blocks)
    sums = np.array([[a @ a, a @ b, b @ b] for a, b in ((reference[p], other[p]) for p in parts)])
    total = sums.sum(axis=0)
    if total[0] <= 0 or total[2] <= 0:
        return None

    def factor(s: np.ndarray) -> float:
        return float(s[1] / s[0]) if s[0] > 0 else float("nan")

    left_out = np.array([factor(total - s) for s in sums])
    spread = np.std(left_out) * np.sqrt(blocks - 1)
    return Scale(factor(total), float(spread), float(total[1] / np.sqrt(total[0] * total[2])))


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of two series (T,), 0 where one is constant."""
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12))


def correlations(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the correlation (J, K) of each column of ``a`` (N, J) with each of ``b`` (N, K); 0 if one is constant."""
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    spread = np.outer(np.linalg.norm(a, axis=0), np.linalg.norm(b, axis=0))
    return np.divide(a.T @ b, spread, out=np.zeros_like(spread), where=spread > 0)


def antiderivative(t: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Integrate a cubic spline through ``rate`` (T, ...) from the first sample to each."""
    return CubicSpline(t, rate, axis=0).antiderivative()(t)


def mixed_up(match: np.ndarray) -> dict[int, int]:
    """Return which columns the rows of ``match`` (J, J; correlations) belong to, for those that are not in place.

    The best assignment is split into cycles (a swap is a cycle of two). A cycle counts only if every member of it
    matches its new partner clearly, and clearly better than itself; a single joint that matches badly is not enough.
    """
    size = np.abs(match)
    diagonal = np.diag(size)
    _, partner = linear_sum_assignment(-(size**2))
    partners: dict[int, int] = {}
    for start in range(len(partner)):
        cycle, k = [start], int(partner[start])
        while k != start:
            cycle.append(k)
            k = int(partner[k])
        better = [size[j, partner[j]] > max(limits.CLEARLY, diagonal[j] + limits.BETTER) for j in cycle]
        if len(cycle) > 1 and all(better):
            partners[start] = int(partner[start])
    return partners


# ---------------------------------------------------------------------- a recording as the checks see it

UNITS = {
    "t": "s",
    "q": "rad",
    "q_target": "rad",
    "qd": "rad/s",
    "tau_est": "N m",
    "tau_cmd": "N m",
    "imu_gyro": "rad/s",
    "imu_acc": "m/s2",
    "base_pos": "m",
    "base_lin_vel": "m/s",
    "base_ang_vel": "rad/s",
    "foot_force": "N",
}
COMMANDS = ("q_target", "tau_cmd")
"""Quantities that are commanded, not measured: they are constant between commands by design."""


def graded(size: float, pair: tuple[float, float]) -> Verdict:
    """Grade ``size`` by a pair of thresholds (suspect, bad)."""
    return "bad" if size > pair[1] else "suspect" if size > pair[0] else "ok"


@dataclass(frozen=True)
class Log:
    """A recording whose columns are whole and finite and whose clock increases."""

    recording: Recording

    @cached_property
    def quantity(self) -> dict[str, str]:
        """Column -> its quantity (``q_FR_hip`` -> ``q``)."""
        known = {c: q for q in JOINT_QUANTITIES for c in joint_channels(q, self.recording.meta.joints)}
        known |= {c: q for q, columns in VECTORS.items() for c in columns} | {"t": "t"}
        feet = {c: "foot_force" for c in self.recording.channels if c.startswith(FOOT_FORCE)}
        return {c: q for c, q in (known | feet).items() if c in self.recording.channels}

    def unit(self, channel: str) -> str:
        """Return the unit of a column, empty if it has none."""
        return UNITS.get(self.quantity.get(channel, ""), "")

    @cached_property
    def measured(self) -> list[str]:
        """The columns that a sensor measured (or a simulated one)."""
        return [c for c, q in self.quantity.items() if q not in ("t", *COMMANDS)]

    @property
    def t(self) -> np.ndarray:
        """Clock (T,), s."""
        return self.recording.t

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.recording.meta.joints

    @cached_property
    def dt(self) -> float:
        """Median step of the clock, s."""
        return float(np.median(np.diff(self.t)))

    @cached_property
    def on(self) -> np.ndarray:
        """(T,) bool: actuators on."""
        return self.recording.channels.get("torque_enable", np.ones(len(self.t), dtype=bool))

    @cached_property
    def command(self) -> str | None:
        """``q_target``, or else ``tau_cmd``, or None."""
        return next((c for c in COMMANDS if self.recording.has(c)), None)

    @cached_property
    def steps(self) -> dict[str, float]:
        """Quantisation step of each measured column, 0 if continuous."""
        return {c: quantum(self.recording.channels[c]) for c in self.measured}

    @cached_property
    def target_steps(self) -> dict[str, float]:
        """Quantisation step of each target of an angle, 0 if continuous."""
        return {c: quantum(self.recording.channels[c]) for c, q in self.quantity.items() if q == "q_target"}

    @cached_property
    def floors(self) -> dict[str, tuple[float, bool]]:
        """Noise floor of each measured column, and whether it looks like noise."""
        return {c: noise(self.recording.channels[c]) for c in self.measured}

    def noise(self, channel: str) -> float:
        """Return the noise floor of a column where it looks like noise, else 0."""
        sigma, white = self.floors[channel]
        return sigma if white else 0.0

    @cached_property
    def spans(self) -> dict[str, float]:
        """Range of each known column."""
        return {c: float(np.ptp(self.recording.channels[c])) for c in self.quantity}

    @cached_property
    def sensor_noise(self) -> dict[str, float]:
        """Noise of each measured column with its quantisation; 0 in an ideal simulation."""
        noise = {c: float(np.hypot(self.noise(c), self.steps[c] / np.sqrt(12.0))) for c in self.measured}
        return {c: size if size > limits.IDEAL * self.spans[c] else 0.0 for c, size in noise.items()}

    def samples(self, seconds: float, least: int = 1) -> int:
        """Return the number of samples in ``seconds``, at least ``least``."""
        return max(least, round(seconds / self.dt))

    def windows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return first and last sample (N,) of overlapping windows without gaps, of 50 ms or at least 8 samples."""
        width = self.samples(0.05, 8)
        first = np.arange(0, len(self.t) - width, max(1, width // 4))
        last = first + width
        whole = self.t[last] - self.t[first] < 1.5 * width * self.dt
        return first[whole], last[whole]

    @cached_property
    def still(self) -> np.ndarray:
        """(T,) bool: no joint moves for ``limits.STILL_TIME``; False everywhere if there are no joint angles."""
        flags = np.zeros(len(self.t), dtype=bool)
        if self.recording.has("q"):
            q, n = self.recording.joint("q"), self.samples(limits.STILL_TIME)
            # windows that overlap by four fifths, and one that ends with the last sample
            for first in (*range(0, len(q) - n, max(1, n // 5)), len(q) - n - 1):
                part = q[max(0, first) : first + n + 1]
                if first >= 0 and np.all(part.max(axis=0) - part.min(axis=0) < limits.STILL_ANGLE):
                    flags[first : first + n + 1] = True
        return flags


def finding(check: str, channel: str, verdict: Verdict, size: float | None, unit: str, message: str) -> Finding:
    """Make a finding; ``size`` becomes a plain float, as NumPy numbers cannot be written as JSON."""
    return Finding(check, channel, verdict, None if size is None else float(size), unit, message)
