"""Checks of channels against one another: speed and angle, torque and control law, gyroscope and attitude, gravity."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

import go1exp.logs.audit.limits as limits
import go1exp.logs.audit.signals as signals
from go1exp.logs.audit.report import Finding
from go1exp.logs.audit.signals import Log, finding, graded
from go1exp.logs.recording import VECTORS, joint_channel
from go1exp.robot import GRAVITY

BLOCKS = 10  # stretches of time for the error of a mean in motion

SPEED_CHECKS = ("scale", "lag", "repeats", "copy")
"""Checks after which a recorded speed is not to be trusted, even if they only call it suspect."""


def _scale_finding(
    check: str, name: str, against: str, s: signals.Scale, pair: tuple[float, float]
) -> Iterator[Finding]:
    """Report a scale: first a flipped sign, then a factor of another unit, then any other factor."""
    shown = f"{s.factor:.3f} ± {s.error:.3f} times"
    if s.correlation < -limits.RELATED:
        yield finding("sign", name, "bad", s.factor, "", f"goes against {against} ({shown}): its sign is flipped")
        return
    named = next((n for n, f in limits.UNIT_SCALES.items() if abs(s.factor / f - 1) < 0.1), None)
    if named:
        yield finding("units", name, "bad", s.factor, "", f"is {shown} {against}: it looks like {named}")
        return
    off = max(0.0, abs(s.factor - 1) - 2 * s.error)
    verdict = graded(off, pair)
    if verdict != "ok":
        size = "too large" if s.factor > 1 else "too small"
        yield finding(check, name, verdict, s.factor, "", f"is {shown} {against}: {size}")


def speed(log: Log) -> Iterator[Finding]:
    """Compare the integrated speed with the change of the angle over about 50 ms, at the lag that fits best."""
    if not (log.recording.has("q") and log.recording.has("qd")):
        return
    first, last = log.windows()
    most = log.samples(limits.LAG_RANGE)
    inside = (first >= most) & (last < len(log.t) - most)
    first, last = first[inside], last[inside]
    if len(first) < limits.ENOUGH:
        return
    q, qd = log.recording.joint("q"), log.recording.joint("qd")
    change = q[last] - q[first]
    lags = np.arange(-most, most + 1)
    whole = signals.antiderivative(log.t, qd)  # (T, J): its differences are changes of angle at any lag
    match = np.stack([signals.correlations(change, whole[last + lag] - whole[first + lag]) for lag in lags])
    # (lags, J, J); a small cost on the lag decides between equal correlations
    best = np.argmax(np.abs(match) - 1e-4 * np.abs(lags)[:, None, None] / most, axis=0)
    peak = np.take_along_axis(match, best[None], axis=0)[0]
    partner = signals.mixed_up(peak.T)
    for j, joint in enumerate(log.joints):
        name, angle = joint_channel("qd", joint), joint_channel("q", joint)
        blur = np.hypot(log.noise(angle) * np.sqrt(2), log.noise(name) * log.dt * np.sqrt(last[0] - first[0]))
        if np.std(change[:, j]) < limits.MOTION * max(blur, log.steps[angle], 1e-6) or np.ptp(qd[:, j]) == 0:
            continue
        if j in partner:
            other = log.joints[partner[j]]
            message = (
                f"is the speed of q_{other} (correlation {peak[partner[j], j]:.2f}), not of {angle} ({peak[j, j]:.2f})"
            )
            yield finding("order", name, "bad", peak[partner[j], j], "", f"{message}: the joints are in another order")
            continue
        lag = int(lags[best[j, j]])
        s = signals.scale(change[:, j], whole[last + lag, j] - whole[first + lag, j])
        if s is None:
            continue
        if abs(s.correlation) < limits.RELATED:
            message = f"does not follow the change of {angle} (correlation {s.correlation:.2f})"
            yield finding("scale", name, "suspect", s.correlation, "", message)
            continue
        yield from _scale_finding("scale", name, f"the change of {angle}", s, limits.SCALE)
        rest, rest_now = 1 - peak[j, j] ** 2, 1 - match[most, j, j] ** 2
        sharp = s.correlation > limits.CLEARLY and rest_now > limits.LAG_GAIN * rest + 1e-3
        late = (lag + _vertex(match[:, j, j], int(best[j, j]))) * log.dt
        if sharp and abs(late) > limits.LAG + min(log.dt, limits.LAG):
            verb = "trails" if late > 0 else "leads"
            message = f"{verb} the change of {angle} by {abs(late) * 1e3:.3g} ms: filtered, or read at another time"
            yield finding("lag", name, "suspect", late * 1e3, "ms", message)


def _vertex(match: np.ndarray, k: int) -> float:
    """Return how far the top of a parabola through three points about ``match[k]`` lies from k, in points."""
    if k in (0, len(match) - 1):
        return 0.0
    a, b, c = match[k - 1 : k + 2]
    return float(0.5 * (a - c) / (a - 2.0 * b + c)) if a - 2.0 * b + c < 0.0 else 0.0


def torque(log: Log) -> Iterator[Finding]:
    """Compare the reported torque with the command or controller's law, at the best lag before it or behind."""
    r = log.recording
    if not r.has("tau_est"):
        return
    tau = r.joint("tau_est")
    if r.has("tau_cmd"):
        command, state, what = r.joint("tau_cmd"), np.zeros_like(tau), "the commanded torque"
    elif r.meta.kp and r.meta.kd and r.has("q_target") and r.has("q") and r.has("qd"):
        kp = np.array(r.meta.kp)
        command, state = kp * r.joint("q_target"), kp * r.joint("q") + np.array(r.meta.kd) * r.joint("qd")
        what = "kp (q_target - q) - kd qd"
    else:
        return
    # A torque near its limit is clipped, so that it says nothing about the scale.
    highest = np.full(len(log.joints), np.inf) if r.meta.tau_limit is None else 0.9 * np.array(r.meta.tau_limit)
    # The first samples, without a command at the largest lag, are cut.
    most, count = log.samples(limits.TORQUE_LAG), len(tau)
    tau, on = tau[most:], log.on[most:, None]
    on = on & (np.abs(tau) < highest)

    def expected(joints: int | slice, command_lag: int, state_lag: int) -> np.ndarray:
        late, held = (slice(most - lag, count - lag) for lag in (command_lag, state_lag))
        return command[late, joints] - state[held, joints]

    lags = [(lag, held) for lag in range(0, most + 1, log.samples(0.002)) for held in sorted({0, lag})]
    match = []
    for pair in lags:  # one after another: all of them are many times the recording
        shifted = expected(slice(None), *pair)
        match.append(_masked_correlation(shifted, tau, on & (np.abs(shifted) < highest)))
    best = np.argmax(np.abs(match), axis=0)
    for j, joint in enumerate(log.joints):
        reference = expected(j, *lags[best[j]])
        blur, white = signals.noise(reference)
        if white and np.std(reference) < limits.MOTION * blur:
            continue
        use = on[:, j] & (np.abs(reference) < highest[j])
        s = signals.scale(reference[use], tau[use, j])
        if s and abs(s.correlation) >= limits.CLEARLY:
            yield from _scale_finding("scale", joint_channel("tau_est", joint), what, s, limits.TORQUE_SCALE)


def _masked_correlation(a: np.ndarray, b: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Return the correlation (J,), about zero, of the columns of ``a`` and ``b`` (T, J) where ``use`` is set."""
    a, b = np.where(use, a, 0.0), np.where(use, b, 0.0)
    aa, ab, bb = (np.einsum("tj,tj->j", *pair) for pair in ((a, a), (a, b), (b, b)))
    spread = np.sqrt(aa * bb)
    return np.divide(ab, spread, out=np.zeros(a.shape[1]), where=spread > 0)


def rotation(log: Log) -> Iterator[Finding]:
    """Compare the integrated rate of rotation with the attitude, axis by axis, for the IMU and for ground truth."""
    pairs = [("imu_quat", "imu_gyro"), ("base_quat", "base_ang_vel")]
    for attitude, rate in pairs:
        names = VECTORS[rate]
        if not set(VECTORS[attitude] + names) <= set(log.quantity):
            continue
        length = np.linalg.norm(log.recording.block(*VECTORS[attitude]), axis=1)
        first, last = log.windows()
        if length.min() < 1e-3 or len(first) < limits.ENOUGH:
            continue
        turn = _attitude(log, attitude)
        # rotation over each window as a vector in body axes (W, 3), small enough to be compared axis by axis
        change = (turn[first].inv() * turn[last]).as_rotvec()
        whole = signals.antiderivative(log.t, log.recording.block(*names))
        integral = whole[last] - whole[first]
        match = signals.correlations(change, integral)
        # Turning is twice the vector part of a quaternion; noise of what is compared with makes a scale look too small.
        blur = 2.0 * np.sqrt(2.0) * max(log.noise(channel) for channel in VECTORS[attitude])
        moves = (np.std(change, axis=0) > max(limits.MOTION * blur, 1e-3)) & (np.std(integral, axis=0) > 0)
        if not moves.any():
            continue
        partner = signals.mixed_up(match.T)
        for b, name in enumerate(names):
            s = signals.scale(change[:, b], integral[:, b])
            if b in partner:
                a = partner[b]
                message = (
                    f"follows the {'xyz'[a]} axis of {attitude} ({match[a, b]:.2f}), not its own ({match[b, b]:.2f})"
                )
                yield finding("order", name, "bad", match[a, b], "", message)
            elif s and moves[b] and abs(s.correlation) >= limits.CLEARLY:
                yield from _scale_finding("scale", name, f"the rotation of {attitude}", s, limits.SCALE)


def _attitude(log: Log, quantity: str) -> Rotation:
    return Rotation.from_quat(log.recording.block(*VECTORS[quantity]), scalar_first=True)


def attitude_length(log: Log) -> Iterator[Finding]:
    """Check that quaternions have length 1."""
    for quantity in ("imu_quat", "base_quat"):
        if set(VECTORS[quantity]) <= set(log.quantity):
            off = np.abs(np.linalg.norm(log.recording.block(*VECTORS[quantity]), axis=1) - 1)
            if off.max() > 1e-3:
                message = f"its length differs from 1 by up to {off.max():.3g}; normalise, or look for a missing part"
                yield finding("norm", quantity, "bad", off.max(), "", message)


def gravity(log: Log) -> Iterator[Finding]:
    """Check length and direction of the measured gravity: at rest by its length, in motion by its mean.

    In motion the length of the acceleration says nothing. Its mean in the world frame is gravity plus the change of
    velocity over the duration, whatever the robot does. The mean of what a body axis reads is less where it tilts.
    """
    names = VECTORS["imu_acc"]
    if not set(names) <= set(log.quantity):
        return
    acc = log.recording.block(*names)
    resting = log.still.sum() >= limits.ENOUGH
    rest = log.still if resting else np.ones(len(acc), dtype=bool)
    source = next((q for q in ("imu_quat", "base_quat") if set(VECTORS[q]) <= set(log.quantity)), None)
    if source and np.linalg.norm(log.recording.block(*VECTORS[source]), axis=1).min() < 1e-3:
        source = None
    world = _attitude(log, source)[rest].apply(acc[rest]) if source else acc[rest]
    blocks = np.array([part.mean(axis=0) for part in np.array_split(world, min(BLOCKS, len(world)))])
    mean = world.mean(axis=0)
    error = 0.0 if resting else float(np.linalg.norm(blocks.std(axis=0)) / np.sqrt(len(blocks)))
    reading = float(np.median(np.linalg.norm(acc[rest], axis=1)) if resting else np.linalg.norm(mean))
    where = "at rest" if resting else "on average"
    off = max(0.0, abs(reading / GRAVITY - 1) - 2.0 * error / GRAVITY)
    channel = "imu_acc"
    if off > limits.GRAVITY_ERROR[0]:
        message = f"reads {reading:.4g} {where}; gravity is {GRAVITY} m/s2"
        guess = "g instead of m/s2" if 0.9 < reading < 1.1 else "milli-g" if 900 < reading < 1100 else ""
        guess = guess or ("gravity taken out" if reading < 0.5 else "")
        if guess:
            yield finding("units", channel, "bad", reading, "m/s2", f"{message}: it looks like {guess}")
        elif resting or off > limits.GRAVITY_ERROR[1]:
            yield finding("gravity", channel, graded(off, limits.GRAVITY_ERROR), reading, "m/s2", message)
    if source is None or reading < 0.5:
        return
    tilt = float(np.degrees(np.arccos(np.clip(mean[2] / np.linalg.norm(mean), -1, 1))))
    verdict = graded(tilt, limits.TILT)
    if verdict != "ok":
        why = "its sign is flipped (at rest it must read +9.81 upwards)" if tilt > 150 else "axes or quaternion order"
        message = f"gravity {where} is {tilt:.0f} degrees off the vertical of {source}: {why}"
        yield finding("gravity", channel, verdict, tilt, "degrees", message)
