"""Checks of commands against what the joints did: order, sign, delay."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import signal
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

import go1exp.logs.audit.limits as limits
import go1exp.logs.audit.signals as signals
from go1exp.logs.audit.report import Finding, Verdict
from go1exp.logs.audit.signals import Log, finding
from go1exp.logs.recording import joint_channel

SMOOTH = 0.2
"""s of smoothing: order and sign are checked below about 3 Hz, where a joint follows its target at any gains."""
LONGEST_LAG = 0.12
"""s by which a joint may trail its target (chosen: longer than the response of any actuator under position control)."""
LONGEST_TRAIL = 0.3  # s; the same for a soft position servo


def order_and_sign(log: Log) -> Iterator[Finding]:
    """Check that each joint follows its own target better than that of another, with the right sign and unit."""
    if not (log.recording.has("q_target") and log.recording.has("q")) or not _enough(log):
        return
    target, q = _matches_inputs(log)
    match = _lagged_correlation(log, target, q)
    # Weight moves a leg against its target; without a law that weight does not change, only a held base shows a sign.
    follows = _controller_law(log)
    # In a trot a leg that load moves against its target moves with that of another; its torque tells which it follows.
    partner = {j: k for j, k in _other_order(log, match).items() if not (match[j, j] < 0 < follows[j])}
    against = (follows < 0) | (
        (follows == 0) & (np.diag(match) < -limits.CLEARLY) & (log.recording.meta.base == "fixed")
    )
    for j, joint in enumerate(log.joints):
        if j in partner:
            other = log.joints[partner[j]]
            message = f"moves with q_{other} (correlation {match[j, partner[j]]:.2f}), not with its own joint"
            message += f" ({match[j, j]:.2f}): "
            swap = partner[partner[j]] == j
            message += f"{joint} and {other} are swapped" if swap else f"what is called {other} is the joint it moves"
            yield finding("order", joint_channel("q_target", joint), "bad", match[j, partner[j]], "", message)
        elif against[j]:
            shown = "by tau_est" if follows[j] < 0 else f"correlation {match[j, j]:.2f}"
            message = f"goes against q_target_{joint} ({shown}): a sign is flipped"
            yield finding("sign", joint_channel("q", joint), "bad", match[j, j], "", message)
        elif match[j, j] > limits.CLEARLY:
            yield from _other_unit(joint, float(np.std(q[:, j]) / np.std(target[:, j])))


def _other_order(log: Log, match: np.ndarray) -> dict[int, int]:
    """Return the joints that follow the target of another, by the correlations ``match`` (J, J).

    Legs in antiphase go against each other's targets. Then another order and flipped signs correlate alike, and what
    brings the angles nearer to the targets is right.
    """
    partner = signals.mixed_up(match)
    if partner:
        return partner
    target, q = (log.recording.joint(name)[log.on] for name in ("q_target", "q"))
    apart = np.abs(target.mean(axis=0)[:, None] - q.mean(axis=0))  # rad; legs in phase differ by their means alone
    partner = signals.mixed_up(np.maximum(match, 0.0) * np.exp(-apart))
    if not partner:
        return {}
    legs = list(partner)
    exchanged = np.mean((target[:, legs] - q[:, list(partner.values())]) ** 2)
    return partner if exchanged < np.mean((target[:, legs] + q[:, legs]) ** 2) else {}


def _controller_law(log: Log) -> np.ndarray:
    """Return the sign (J,) by which angles count in the law of the controller: 1 right, -1 flipped, 0 unknown.

    The reported torque is fitted by target, angle and speed, at the best delay: tau = a q_target - b q - c qd + d. A
    load changes none of the factors, and a and b have one sign.
    """
    r, signs, best = log.recording, np.zeros(len(log.joints)), np.full(len(log.joints), limits.LAW)
    if not r.has("tau_est"):
        return signs
    names = [name for name in ("q_target", "q", "qd", "tau_est") if r.has(name)]
    series = np.stack([r.joint(name).T for name in names], axis=1)  # (J, K, T)
    inseparable = [abs(signals.correlation(*pair)) > limits.ALIKE for pair in series[:, :2]]  # their factors are one
    for lag in range(0, log.samples(limits.TORQUE_LAG) + 1, log.samples(0.002)):
        late = np.concatenate([series[:, :1, : len(log.t) - lag], series[:, 1:, lag:]], axis=1)[:, :, log.on[lag:]]
        late -= late.mean(axis=2, keepdims=True)
        about = late @ late.transpose(0, 2, 1) / late.shape[2]  # covariances (J, K, K)
        torque = about[:, -1, -1]
        factors = (np.linalg.pinv(about[:, :-1, :-1], hermitian=True) @ about[:, :-1, -1:])[:, :, 0]
        explained = np.sum(factors * about[:, :-1, -1], axis=1) / np.maximum(torque, 1e-12)
        parts = factors[:, :2] ** 2 * np.diagonal(about, axis1=1, axis2=2)[:, :2]
        better = (explained > best) & (parts.min(axis=1) > limits.LAW_PART**2 * torque) & ~np.array(inseparable)
        best = np.where(better, explained, best)
        signs = np.where(better, -np.sign(factors[:, 0] * factors[:, 1]), signs)
    return signs


def _other_unit(joint: str, times: float) -> Iterator[Finding]:
    """Report an angle that moves ``times`` as far as its target, if that looks like degrees in one of the two.

    Nothing moves so much farther than its target. So much less far moves a joint that is blocked, too.
    """
    degrees = 180.0 / np.pi
    cases: tuple[tuple[float, Verdict, str], ...] = ((times, "bad", "q"), (1.0 / times, "suspect", "q_target"))
    for factor, verdict, which in cases:
        if degrees / limits.FARTHER < factor < degrees * limits.FARTHER:
            message = f"moves {times:.3g} times as far as q_target_{joint}: {which}_{joint} looks like degrees"
            message += "" if which == "q" else f", or q_{joint} was taken for degrees"
            yield finding("units", joint_channel("q", joint), verdict, times, "", message)


def _enough(log: Log) -> bool:
    return log.on.sum() >= max(2 * limits.ENOUGH, limits.LEAST_TIME / log.dt)


def _matches_inputs(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Return targets and angles (T, J), smoothed and without mean, both held while the actuators are off."""
    n = log.samples(SMOOTH)
    held = np.maximum.accumulate(np.where(log.on, np.arange(len(log.t)), 0))
    target, q = (uniform_filter1d(log.recording.joint(name)[held], n, axis=0) for name in ("q_target", "q"))
    return target - target.mean(axis=0), q - q.mean(axis=0)


def _lagged_correlation(log: Log, target: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return correlations (J, J) of targets (rows) with joints at the lag of the largest absolute; 0 of what rests."""
    best = np.zeros((target.shape[1], q.shape[1]))
    live = np.outer(np.ptp(target, axis=0) > limits.STILL_ANGLE, np.ptp(q, axis=0) > limits.STILL_ANGLE)
    for lag in range(0, log.samples(LONGEST_LAG) + 1, log.samples(0.01)):
        match = np.where(live, signals.correlations(target[: len(target) - lag], q[lag:]), 0.0)
        best = np.where(np.abs(match) > np.abs(best), match, best)
    return best


def timing(log: Log) -> tuple[list[Finding], dict[str, Delay]]:
    """Check the delay of each joint; return the delays, too, by the name of the ``q`` column."""
    if log.command is None or not log.recording.has("q") or not _enough(log):
        return [], {}
    if log.dt < limits.LEAST_STEP:  # such a clock is wrong, and its grid would fill the memory
        return [], {}
    q = log.recording.joint("q")
    estimates = delays(log.t, log.recording.joint(log.command), q, log.on)
    known = {j: d for j, d in zip(log.joints, estimates, strict=True) if d is not None}
    findings = []
    middle = float(np.median([d.time for d in known.values()])) if known else 0.0
    for joint, d in known.items():
        why = ""  # an error of two standard deviations is allowed before a delay is reported
        if abs(d.time) - 2 * d.error > limits.DELAY + log.dt:
            before = ", before it is given: a clock offset, or a delayed log of the command"
            why = ": delay or clock offset" if d.time > 0 else before
        elif abs(d.time - middle) - 2 * d.error > limits.DELAY_SPREAD and len(known) > 2:
            why = f", the other joints after {middle * 1e3:.1f} ms: delay or clock offset of this one"
        if why:
            shown = f"answers {log.command} after {d.time * 1e3:.1f} ± {d.error * 1e3:.1f} ms{why}"
            findings.append(finding("delay", joint_channel("q", joint), "suspect", d.time * 1e3, "ms", shown))
    if known and not findings:
        low, high = (f(d.time for d in known.values()) * 1e3 for f in (min, max))
        message = f"{len(known)} of {len(log.joints)} joints answer after {low:.1f} to {high:.1f} ms"
        findings.append(finding("delay", "q", "ok", middle * 1e3, "ms", message))
    findings += _trailing(log, [j for j in log.joints if j not in known])
    return findings, {joint_channel("q", joint): d for joint, d in known.items()}


def _trailing(log: Log, joints: list[str]) -> Iterator[Finding]:
    """Report by how much joints of unknown delay trail their targets: delay and response of the actuator together."""
    if log.command != "q_target" or not joints:
        return
    n, most = log.samples(0.05), log.samples(LONGEST_TRAIL)
    trail = {}
    for joint in joints:
        pair = (log.recording.channels[joint_channel(name, joint)] for name in ("q_target", "q"))
        a, b = (np.gradient(uniform_filter1d(x, n)) for x in pair)
        # row k of the view: the joint k samples later than its target
        a, b = a[: len(a) - most], sliding_window_view(b, len(a) - most)
        spread = np.linalg.norm(a) * np.linalg.norm(b, axis=1)
        match = np.divide(b @ a, spread, out=np.zeros_like(spread), where=spread > 0)
        if match.max() > limits.CLEARLY and 0 < np.argmax(match) < most:
            trail[joint] = float(np.argmax(match)) * log.dt * 1e3
    if trail:
        low, high = min(trail.values()), max(trail.values())
        verb, by = ("trails its target" if len(trail) == 1 else "trail their targets"), f"{low:.3g}"
        by += f" to {high:.3g}" if f"{high:.3g}" != by else ""
        message = f"{', '.join(trail)} {verb} by {by} ms, delay and actuator together; "
        yield finding("trail", "q", "ok", high, "ms", message + "this motion cannot separate them")


# ---------------------------------------------------------------------- delay, without a model of the robot

BLOCKS = 10  # stretches of time for the jackknife
FINE = 2  # points of the search grid to a sample
MOST_ROWS = 1500  # rows of the regression; long recordings are thinned


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
    The result is dead time and fast lag together: actuator, bus, or an offset between the clocks of command and state.

    Args:
        t: clock (T,), s.
        command: what was commanded (T, J), angle or torque; held until the next sample.
        q: joint angles (T, J), rad.
        usable: (T,) bool; false where the actuators are off.
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
    # A kernel or a shift must not reach into a gap, or into a time without actuators.
    for a, b in signals.stretches(~good):
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
    blocks = list(zip(np.array_split(y, BLOCKS), np.array_split(commands, BLOCKS), strict=True))
    yy = np.array([part @ part for part, _ in blocks])
    uy = np.stack([part @ u for part, u in blocks])
    uu = np.stack([np.einsum("nd,nd->d", u, u) for _, u in blocks])

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
