"""Commanded velocity over time: pieces that a protocol's file is made of."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from go1exp.config.schema.registry import NonNegative, Positive, Speed
from go1exp.config.schema.settings import settings

Velocity = tuple[Speed, Speed, Speed]
"""x and y in m/s, yaw rate in rad/s, body frame."""


@settings
class Constant:
    """One velocity, from rest after ``rest``.

    Attributes:
        kind: constant, steps or sine.
        velocity: x m/s, y m/s, yaw rad/s.
        rest: time with a zero command at the start, s.
    """

    kind: Literal["constant"] = "constant"
    velocity: Velocity
    rest: NonNegative = 0.0

    def at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Return the velocity (T, 3) at the times (T,), s."""
        after = np.asarray(t, dtype=np.float64) >= self.rest - 1e-9
        return after[:, None] * np.asarray(self.velocity)


@settings
class Steps:
    """Velocities one after the other.

    Attributes:
        kind: constant, steps or sine.
        velocities: each as x m/s, y m/s, yaw rad/s.
        hold: time of each, s; the last one stays.
    """

    kind: Literal["steps"] = "steps"
    velocities: Annotated[tuple[Velocity, ...], Field(min_length=1)]
    hold: Positive

    def at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Return the velocity (T, 3) at the times (T,), s."""
        which = np.floor(np.asarray(t, dtype=np.float64) / self.hold + 1e-9).astype(int)
        return np.asarray(self.velocities)[np.clip(which, 0, len(self.velocities) - 1)]


@settings
class Sine:
    """A sine on all three axes at once.

    Attributes:
        kind: constant, steps or sine.
        amplitude: of x m/s, y m/s, yaw rad/s.
        period: s.
    """

    kind: Literal["sine"] = "sine"
    amplitude: Velocity
    period: Positive

    def at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Return the velocity (T, 3) at the times (T,), s."""
        wave = np.sin(2.0 * np.pi * np.asarray(t, dtype=np.float64) / self.period)
        return wave[:, None] * np.asarray(self.amplitude)


Signal = Annotated[Constant | Steps | Sine, Field(discriminator="kind")]


# ---------------------------------------------------------------------- response to a sine


def phasors(values: ArrayLike, t: ArrayLike, period: float) -> NDArray[np.complex128]:
    """Return the amplitude and phase at ``period`` of each whole period of a signal, (P, ...) complex.

    The projection of ``values`` (T, ...) on exp(-i w t) with its mean beside it, by least squares in each period, so
    that a period need not be a whole number of samples. The first period is dropped: it has the start in it.
    """
    t, values = np.asarray(t, dtype=np.float64), np.asarray(values, dtype=np.float64)
    omega, projections = 2.0 * np.pi / period, []
    whole = int(np.floor((t[-1] + (t[1] - t[0])) / period + 1e-6)) if len(t) > 1 else 0
    for k in range(1, whole):
        rows = (t >= k * period - 1e-9) & (t < (k + 1) * period - 1e-9)
        basis = np.column_stack([np.ones(rows.sum()), np.cos(omega * t[rows]), np.sin(omega * t[rows])])
        flat = values[rows].reshape(rows.sum(), -1)
        _, real, minus_imaginary = np.linalg.lstsq(basis, flat, rcond=None)[0]
        projections.append((real - 1j * minus_imaginary).reshape(values.shape[1:]))
    return np.array(projections, dtype=complex).reshape(len(projections), *values.shape[1:])


def response(
    measured: ArrayLike, commanded: ArrayLike, t: ArrayLike, period: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return gain, lag (s, positive if late) and coherence of the response to a sine, (...) each; NaN without a period.

    Gain and lag are those of the mean phasors. Coherence is |mean of M conj(C)|^2 / (mean |M|^2 mean |C|^2) over the
    periods: 1 if all responses are equal.
    """
    m, c = phasors(measured, t, period), phasors(commanded, t, period)
    if not len(m):
        nothing = np.full(np.asarray(measured).shape[1:], np.nan)
        return nothing, nothing.copy(), nothing.copy()
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = m.mean(0) / c.mean(0)
        coherence = np.abs((m * c.conj()).mean(0)) ** 2 / ((np.abs(m) ** 2).mean(0) * (np.abs(c) ** 2).mean(0))
    return np.abs(ratio), -np.angle(ratio) * period / (2.0 * np.pi), coherence
