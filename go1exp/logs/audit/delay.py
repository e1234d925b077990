"""Delay between a command and the motion of the joint, estimated without a model of the robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import signal
from scipy.interpolate import CubicSpline

import go1exp.logs.audit.limits as limits
from go1exp.logs.audit.signals import stretches

BLOCKS = 10
"""Stretches of time for the jackknife."""
FINE = 2
"""Points of the search grid to a sample."""
MOST_ROWS = 1500
"""Rows of the regression; long recordings are thinned."""


@dataclass(frozen=True)
class Delay:
    """Delay, s; its standard error, s; share of the acceleration that the command explains."""

    time: float
    error: float
    power: float


def delays(t: np.ndarray, command: np.ndarray, q: np.ndarray, usable: np.ndarray) -> list[Delay | None]:
    """Return the delay of each joint, or None where the recording does not show it.

    Any joint under position or torque control obeys approximately q'' = a u(t - d) + b q + c q' + friction + gravity
    + coupling. All terms are smoothed by the same kernel (a Gaussian and its derivatives: the modulating function
    method of Shinbrot, 1957), so no derivative of a noisy signal is taken; a, b, c, ... are fitted for each joint, and
    d is the delay with the smallest residual. Its standard error comes from a jackknife over ten stretches of time, is
    multiplied by ``limits.DELAY_FACTOR``, and has ``limits.DELAY_SAMPLES`` of a sample added in quadrature.
    The result is dead time and fast lag together: drive, bus, or an offset between the clocks of command and state.

    Args:
        t: clock (T,), s.
        command: what was commanded (T, J), angle or torque; held until the next sample.
        q: joint angles (T, J), rad.
        usable: (T,) bool; false where the drives are off.
    """
    # Everything is computed on an even grid, finer than the samples, so that shifts are whole numbers of its points.
    dt = float(np.median(np.diff(t)))
    fine = dt / FINE
    grid = np.arange(t[0], t[-1], fine)
    held = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 1)
    width = max(1.5 * dt, 6e-3)  # s; standard deviation of the Gaussian: about 25 Hz pass at 6 ms
    reach = int(np.ceil(4 * width / fine))  # points beyond which the kernel is negligible
    kernels = _kernels(width, fine, reach)
    angles = CubicSpline(t, q)(grid)
    smooth_q, speed, acceleration = (signal.fftconvolve(angles, k[:, None], mode="same", axes=0) for k in kernels)
    smooth_u = signal.fftconvolve(command[held] - command.mean(axis=0), kernels[0][:, None], mode="same", axes=0)
    first, last = (int(np.floor(d / fine)) for d in limits.DELAY_RANGE)
    good = usable[held] & (np.diff(t, append=t[-1] + dt)[held] < 3 * dt)
    # A kernel or a shift must not reach into a gap, or into a time without drives.
    for a, b in stretches(~good):
        good[max(0, a - reach) : b + reach + last] = False
    good[: reach + last] = False
    good[len(grid) - reach + first :] = False
    rows = np.flatnonzero(good)
    rows = rows[:: max(FINE, -(-len(rows) // MOST_ROWS))]
    shifts = np.arange(first, last + 1)
    results: list[Delay | None] = []
    for joint in range(q.shape[1]):
        others = np.delete(acceleration, joint, axis=1)
        known = [smooth_q[:, joint], speed[:, joint], np.sin(angles[:, joint]), np.cos(angles[:, joint])]
        known += [np.tanh(speed[:, joint] / 0.05), np.ones(len(grid))]  # dry friction, smoothed over 0.05 rad/s
        base = np.column_stack([np.stack(known, axis=1)[rows], others[rows]])
        # row i, column k: the command shifts[k] before rows[i]
        windows = sliding_window_view(smooth_u[:, joint], len(shifts))[rows - last][:, ::-1]
        results.append(_best(acceleration[rows, joint], base, windows, shifts * fine))
    return results


def _kernels(width: float, step: float, reach: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a Gaussian of standard deviation ``width`` and its first two derivatives, on a grid of ``step`` s."""
    x = np.arange(-reach, reach + 1) * step
    g = np.exp(-0.5 * (x / width) ** 2)
    g /= g.sum()
    return g, -x / width**2 * g, (x**2 / width**4 - 1 / width**2) * g


def _best(y: np.ndarray, base: np.ndarray, commands: np.ndarray, times: np.ndarray) -> Delay | None:
    """Find the column of ``commands`` (N, D) that explains most of ``y`` (N,) beyond ``base`` (N, K)."""
    if len(y) < 2 * limits.ENOUGH or np.ptp(commands[:, 0]) < 1e-6 or np.ptp(y) == 0:
        return None
    q, r = np.linalg.qr(base / np.maximum(np.linalg.norm(base, axis=0), 1e-12))
    q = q[:, np.abs(np.diag(r)) > 1e-8]  # without columns that depend on earlier ones
    y = y - q @ (q.T @ y)
    commands = commands - q @ (q.T @ commands)
    parts = np.array_split(np.arange(len(y)), BLOCKS)
    yy = np.array([y[p] @ y[p] for p in parts])
    uy = np.stack([y[p] @ commands[p] for p in parts])
    uu = np.stack([np.einsum("nd,nd->d", commands[p], commands[p]) for p in parts])

    def minimum(keep: np.ndarray) -> tuple[float, float]:
        cross, power = keep @ uy, np.maximum(keep @ uu, 1e-12)
        rest = keep @ yy - np.where(cross > 0, cross**2 / power, 0)  # only a positive factor is physical
        k = int(np.argmin(rest))
        if k in (0, len(rest) - 1):
            return float("nan"), 0.0
        a, b, c = rest[k - 1 : k + 2]  # a parabola through three points gives the minimum between grid points
        vertex = 0.5 * (a - c) / (a - 2 * b + c) if a - 2 * b + c > 0 else 0.0
        return float(times[k] + vertex * (times[1] - times[0])), float(1 - b / (keep @ yy))

    time, share = minimum(np.ones(BLOCKS))
    left_out = np.array([minimum(np.arange(BLOCKS) != b)[0] for b in range(BLOCKS)])
    error = limits.DELAY_FACTOR * float(np.std(left_out) * np.sqrt(BLOCKS - 1))
    if not np.isfinite(time + error) or share < limits.DELAY_POWER or error > limits.DELAY_ERROR:
        return None
    return Delay(time, float(np.hypot(error, limits.DELAY_SAMPLES * (times[1] - times[0]) * FINE)), share)
