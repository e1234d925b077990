"""A recording as the checks see it: columns by quantity, units, clock, and when the drives were on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

import go1exp.logs.audit.limits as limits
import go1exp.logs.audit.signals as signals
from go1exp.logs.audit.report import Finding, Verdict
from go1exp.logs.recording import FOOT_FORCE, JOINT_QUANTITIES, VECTORS, Recording, joint_channels

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
        """(T,) bool: drives on."""
        return self.recording.channels.get("torque_enable", np.ones(len(self.t), dtype=bool))

    @cached_property
    def command(self) -> str | None:
        """``q_target``, or else ``tau_cmd``, or None."""
        return next((c for c in COMMANDS if self.recording.has(c)), None)

    @cached_property
    def steps(self) -> dict[str, float]:
        """Quantisation step of each measured column, 0 if continuous."""
        return {c: signals.quantum(self.recording.channels[c]) for c in self.measured}

    @cached_property
    def floors(self) -> dict[str, tuple[float, bool]]:
        """Noise floor of each measured column, and whether it looks like noise."""
        return {c: signals.noise(self.recording.channels[c]) for c in self.measured}

    def noise(self, channel: str) -> float:
        """Return the noise floor of a column where it looks like noise, else 0."""
        sigma, white = self.floors[channel]
        return sigma if white else 0.0

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
