"""Checks of the clock, and of each channel alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import go1exp.logs.audit.limits as limits
import go1exp.logs.audit.signals as signals
from go1exp.base.wording import counted
from go1exp.logs.audit.report import Finding
from go1exp.logs.audit.signals import Log, finding, graded
from go1exp.logs.recording import joint_channel
from go1exp.robot import EFFORT_LIMIT, JOINT_POS_LIMITS, JOINTS, VELOCITY_LIMIT

SMALLER = ((1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds"))
"""How many of them make a second, and their name."""
SHORTEST_STEP = 2e-4  # s; few logs of joints step by less (5 kHz): with another unit of time, such a step is likely


def wrong_steps(log: Log) -> str | None:
    """Return what is wrong with a clock whose steps are too long or too short for the log of a joint; None if nothing.

    Where speeds are recorded, their integral over the clock tells the unit of the clock: it must be the change of the
    angles.
    """
    if log.dt < limits.LEAST_STEP:
        message = f"steps by {log.dt:g} s (median); a log of joints must step by at least {limits.LEAST_STEP:g} s"
        fits = [f for f, _ in SMALLER if SHORTEST_STEP <= log.dt * f <= limits.LONGEST_GAP]
        return message + (f". Are its times {fits[0]:.0f} times too small, by a wrong unit?" if fits else "")
    if log.dt <= limits.LONGEST_GAP:
        return None
    ratio = _integral_of_speed(log)
    for factor, unit in SMALLER:
        if ratio is not None and abs(ratio / factor - 1) < limits.SCALE[1]:
            why = f"speeds times these steps are about {factor:.0f} times the change of the angles"
            return f"steps by {log.dt:g}: it is in {unit}, not in seconds ({why})"
    message = f"steps by {log.dt:g} s (median); a log of joints must step by at most {limits.LONGEST_GAP:g} s"
    unit = next((name for f, name in SMALLER if SHORTEST_STEP <= log.dt / f <= limits.LONGEST_GAP), "")
    in_seconds = ratio is not None and abs(ratio - 1) < limits.SCALE[1]
    return message + (f". Is it in {unit}?" if unit and not in_seconds else "")


def _integral_of_speed(log: Log) -> float | None:
    """Return how many times the change of the angles the integral of the speeds is; None if they do not tell."""
    if not (log.recording.has("q") and log.recording.has("qd")):
        return None
    first, last = log.windows()
    q, whole = log.recording.joint("q"), signals.antiderivative(log.t, log.recording.joint("qd"))
    scales = (signals.scale((q[last] - q[first])[:, j], (whole[last] - whole[first])[:, j]) for j in range(q.shape[1]))
    factors = [s.factor for s in scales if s is not None and s.correlation > limits.CLEARLY]
    return float(np.median(factors)) if factors else None


def clock(log: Log) -> Iterator[Finding]:
    """Compare the rate with the metadata, and with what a joint's motion needs; measure jitter and gaps."""
    steps = np.diff(log.t)
    nominal = 1 / log.recording.meta.rate_hz
    for factor, unit in SMALLER:
        if 0.9 < log.dt / (factor * nominal) < 1.1:
            yield finding("rate", "t", "bad", log.dt, "s", f"steps by {log.dt:g}: it is in {unit}, not in seconds")
            return
    if message := wrong_steps(log):
        # The rate of the metadata does not help: an import takes it from the same clock.
        yield finding("rate", "t", "bad", log.dt, "s", message)
        return
    off = log.dt / nominal - 1
    verdict = graded(abs(off), limits.RATE)
    message = f"{1 / log.dt:.5g} Hz (median step {log.dt * 1e3:.4g} ms)"
    if verdict == "ok":
        yield finding("rate", "t", "ok", 1 / log.dt, "Hz", message)
    else:
        yield finding("rate", "t", verdict, 1 / log.dt, "Hz", f"{message}, but rate_hz = {1 / nominal:g}")
    # Robust: the median of the deviations, as a standard deviation, so that the gaps themselves do not count.
    usual = 1.4826 * float(np.median(np.abs(steps - log.dt)))
    long = steps > max(limits.GAP_STEPS * log.dt, log.dt + 6 * usual)
    jitter = float(np.std(steps[~long]))
    worst = float(np.abs(steps[~long] - log.dt).max())
    message = (
        f"steps vary by {jitter * 1e3:.3g} ms (standard deviation; {jitter / log.dt:.1%}), at most {worst * 1e3:.3g} ms"
    )
    # A measured clock is never exact; one without any jitter is a row counter times the nominal period.
    if jitter < limits.COUNTED * log.dt and log.recording.meta.source == "measured":
        message += "; a clock this even was counted, not read, so its true jitter is unknown"
    yield finding("jitter", "t", graded(jitter / log.dt, limits.JITTER), jitter * 1e3, "ms", message)
    if long.any():
        missing = int(np.sum(np.round(steps[long] / log.dt) - 1))
        longest = float(steps.max())
        share = missing / (len(log.t) + missing)
        verdict = "bad" if longest > limits.LONGEST_GAP else graded(share, limits.GAPS)
        at = float(log.t[int(np.argmax(steps))])
        samples = f"{counted(missing, 'sample')} {'is' if missing == 1 else 'are'} missing"
        count = int(long.sum())
        gaps = f"{counted(count, 'gap')}{' of' if count == 1 else ', the longest'} {longest * 1e3:.4g} ms"
        yield finding("gaps", "t", verdict, missing, "samples", f"{samples} ({share:.2%}) in {gaps} at {at:.3f} s")


def stale(log: Log) -> tuple[list[Finding], dict[str, float]]:
    """Find rows and channels that repeat although they move; return the share of repeats by channel, too."""
    reach = log.samples(0.02, 3)  # 20 ms on either side, in which a joint does not stop and start again
    findings: list[Finding] = []
    each = {c: signals.repeats(log.recording.channels[c], log.steps[c], reach) for c in log.measured}
    moving = np.any([r.moving for r in each.values()], axis=0) if each else np.zeros(len(log.t), dtype=bool)
    rows = log.recording.block(*log.measured) if each else np.zeros((len(log.t), 0))
    twice = moving & np.append(False, np.all(rows[1:] == rows[:-1], axis=1))
    share = float(twice.sum() / max(1, moving.sum()))
    if len(each) > 1 and moving.sum() >= limits.ENOUGH and share > limits.REPEATS[0] / 2:
        verdict = graded(share, (limits.REPEATS[0] / 2, limits.REPEATS[1]))
        message = f"{share:.1%} of the rows are exact copies of the row before ({int(twice.sum())}, while joints move)"
        findings.append(finding("duplicates", "all", verdict, share, "", message))
    shares = {}
    for name, r in each.items():
        # Rows that repeat as a whole are reported once above, not for every channel again.
        shares[name] = max(0.0, r.share - (float((twice & r.stale).sum()) / max(1, int(r.moving.sum()))))
        verdict = graded(shares[name], limits.REPEATS)
        if verdict != "ok":
            rate = (1 - shares[name]) / log.dt
            message = f"repeats its last value in {shares[name]:.1%} of its moving samples, as if read at {rate:.2g} Hz"
            findings.append(finding("repeats", name, verdict, shares[name], "", message))
    return findings, shares


def resolution(log: Log) -> Iterator[Finding]:
    """Report the quantisation step of each channel, with the name of the encoder where it is a known one."""
    for name, step in log.steps.items():
        if step == 0:
            continue
        unit = log.unit(name)
        known = next((k for k, s in limits.KNOWN_STEPS.get(unit, {}).items() if abs(step / s - 1) < limits.KNOWN), None)
        message = f"steps of {step:.3g} {unit}".rstrip() + (f": {known}" if known else "")
        coarse = unit == "rad" and step > limits.COARSE_ANGLE
        if coarse:
            message += f"; coarser than any known encoder ({limits.COARSE_ANGLE:g} rad)"
        yield finding("resolution", name, "suspect" if coarse else "ok", step, unit, message)


def noise(log: Log, repeats: dict[str, float]) -> tuple[list[Finding], dict[str, float]]:
    """Measure each channel's noise floor; checked if white, with few stale samples, which look like noise too."""
    findings, floors = [], {}
    for name, (sigma, white) in log.floors.items():
        if not np.isfinite(sigma):
            continue
        floors[name] = sigma
        unit = log.unit(name)
        if len(log.t) < limits.ENOUGH_NOISE or repeats.get(name, 0) > limits.REPEATS[0]:
            continue
        if white and unit in limits.NOISE and (verdict := graded(sigma, limits.NOISE[unit])) != "ok":
            usual = limits.NOISE[unit][0]
            message = (
                f"white noise of {sigma:.3g} {unit} (standard deviation); actuators of this class stay below {usual:g}"
            )
            findings.append(finding("noise", name, verdict, sigma, unit, message))
    return findings, floors


def dead(log: Log) -> Iterator[Finding]:
    """Find channels that never change although the robot moves."""
    meta = log.recording.meta
    moved = {}
    if log.recording.has("q"):
        for joint, q in zip(log.joints, log.recording.joint("q").T, strict=True):
            moved[joint] = np.ptp(q) > limits.STILL_ANGLE
    for name in log.measured:
        values = log.recording.channels[name]
        if np.ptp(values) > 0 or len(values) < limits.ENOUGH:
            continue
        quantity = log.quantity[name]
        message = f"is {values[0]:g} throughout"
        # A constant channel is bad only if something shows that the measured quantity must have changed.
        if quantity in ("qd", "tau_est"):
            joint = name.removeprefix(f"{quantity}_")
            live = moved.get(joint, False)
            verdict, why = ("bad", "while the joint moves") if live else ("ok", "and the joint rests")
        elif quantity == "q":
            target = log.recording.channels.get(name.replace("q_", "q_target_", 1))
            if target is None:
                verdict, why = ("suspect", "while others move") if any(moved.values()) else ("ok", "and no joint moves")
            else:
                live = bool(np.ptp(target) > limits.STILL_ANGLE)
                verdict, why = ("bad", "while its target moves") if live else ("ok", "and its target rests")
        elif meta.base == "fixed":
            verdict, why = "ok", "and the base is fixed"
            if meta.source == "measured" and quantity in ("imu_gyro", "imu_acc"):
                verdict, why = "suspect", "but a real sensor has noise"
        else:
            live = any(moved.values()) and quantity in ("imu_gyro", "imu_acc", "imu_quat", "base_quat", "base_pos")
            verdict, why = ("bad", "while the robot moves") if live else ("suspect", "")
        yield finding("dead", name, verdict, float(values[0]), log.unit(name), f"{message} {why}".rstrip())  # type: ignore[arg-type]


def frozen(log: Log) -> Iterator[Finding]:
    """Find joint angles that stop changing although their target still moves.

    An angle at the end of its range is left out: the joint may be pressed against a stop. Where an angle rests for
    moments only but for once, a smaller motion of the target is enough: it does not stick, it is not read.
    """
    if not (log.recording.has("q") and log.recording.has("q_target")):
        return
    q, target = log.recording.joint("q"), log.recording.joint("q_target")
    for j, joint in enumerate(log.joints):
        ends = q[:, j].min(), q[:, j].max()
        runs = signals.stretches(np.append(log.on[1:] & (np.diff(q[:, j]) == 0.0), False))
        second, longest = sorted((0.0, 0.0, *(log.t[last] - log.t[first] for first, last in runs)))[-2:]
        moved = limits.FROZEN_ANGLE if longest < limits.FROZEN_ONCE * second else limits.FROZEN_ONCE_ANGLE
        caught = [
            (first, last)
            for first, last in runs
            if log.t[last] - log.t[first] > limits.FROZEN_TIME
            and np.ptp(target[first : last + 1, j]) > moved
            and min(abs(q[first, j] - end) for end in ends) > limits.STILL_ANGLE
        ]
        if caught:
            first, last = max(caught, key=lambda run: log.t[run[1]] - log.t[run[0]])
            time = float(log.t[last] - log.t[first])
            message = (
                f"is {q[first, j]:.6g} rad without a change for {time:.2g} s from {log.t[first]:.3f} s, while its "
            )
            message += f"target moves by {np.ptp(target[first : last + 1, j]):.2g} rad"
            yield finding("frozen", joint_channel("q", joint), "bad", time, "s", message)


def saturation(log: Log) -> Iterator[Finding]:
    """Find values that are clipped at their largest or smallest."""
    for name in log.measured:
        quantity = log.quantity[name]
        if quantity in ("q", "base_pos", "imu_quat", "base_quat", "foot_force"):
            continue  # an angle may rest where it is largest, and a force at zero, without being clipped
        values = log.recording.channels[name]
        # Without actuators the torque is zero, which is not a limit.
        use = log.on if quantity == "tau_est" else np.ones(len(values), dtype=bool)
        if use.sum() < limits.ENOUGH or np.ptp(values[use]) == 0:
            continue
        share, levels = signals.clipped(values[use], log.steps[name])
        levels = [v for v in levels if abs(v) > 1e-6 * np.ptp(values)]  # at zero it rests
        if not levels:
            continue
        at = " and ".join(f"{v:.4g}" for v in levels)
        message = f"sticks at {at} {log.unit(name)} in {share:.1%} of the samples"
        verdict = graded(share, limits.CLIPPED)
        if quantity == "tau_est":
            limit = _torque_limit(log, name.removeprefix("tau_est_"))
            if limit is None or all(abs(abs(v) / limit - 1) < 0.02 for v in levels):
                verdict = "ok"
                known = ": the actuator's limit"
                message += known if limit else ": perhaps the actuator's limit, which the file does not give"
            else:
                message += f", but the limit is {limit:.4g} N m"
        yield finding("saturation", name, verdict, share, "", message)


def _torque_limit(log: Log, joint: str) -> float | None:
    limit = log.recording.meta.tau_limit
    if limit is not None:
        return float(limit[log.joints.index(joint)])
    if log.recording.meta.robot == "go1" and joint in JOINTS:
        return EFFORT_LIMIT[JOINTS.index(joint) % 3]
    return None


def ranges(log: Log) -> Iterator[Finding]:
    """Check angles against stops, torques and speeds against limits (Go1), and for degrees (any robot)."""
    go1 = log.recording.meta.robot == "go1"
    for name, quantity in log.quantity.items():
        values = log.recording.channels[name]
        joint = name.removeprefix(f"{quantity}_")
        known = go1 and joint in JOINTS
        if quantity in ("q", "q_target"):
            degrees = float(np.median(np.abs(values))) > 2 * np.pi
            over = 0.0
            if known:
                low, high = JOINT_POS_LIMITS[JOINTS.index(joint)]
                # 0.3 rad: tolerance for a zero offset; degrees are certain if the values fit as degrees and not as rad
                inside = np.mean((np.radians(values) > low - 0.3) & (np.radians(values) < high + 0.3))
                over = float(max(values.max() - high, low - values.min()))
                degrees = over > limits.POSITION_MARGIN[1] and inside > 0.99 and float(np.abs(values).max()) > 2 * np.pi
            if degrees:
                message = f"reaches {np.abs(values).max():.4g}: it looks like degrees, not radians"
                yield finding("units", name, "bad", float(np.abs(values).max()), "rad", message)
            elif quantity == "q" and over > limits.POSITION_MARGIN[0]:
                message = f"goes {over:.3g} rad beyond the joint's stops, {low:g} to {high:g} rad"
                yield finding("limits", name, graded(over, limits.POSITION_MARGIN), over, "rad", message)
        elif quantity in ("qd", "tau_est"):
            limit = _torque_limit(log, joint) if quantity == "tau_est" else None
            if quantity == "qd" and known:
                limit = VELOCITY_LIMIT[JOINTS.index(joint) % 3]
            worst = float(np.abs(values).max())
            if limit is not None and worst > limits.EXCEEDED * limit:
                message = f"reaches {worst:.4g} {log.unit(name)}; the limit is {limit:.4g}"
                verdict = graded(worst / limit, (limits.EXCEEDED, 2.0))
                yield finding("limits", name, verdict, worst, log.unit(name), message)
