"""All safety of the runtime, in one module.

Targets are limited by torque and range (``Safety.limited``). A fault by any of ``RULES`` ends the walk: from then on
the motors only brake, whatever is commanded, until a person starts again. A rule is a method that returns a message or
None; its name is that of the fault in the log.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from go1exp.robot.messages import LowCmd, LowState

SDK_RANGE = {"hip": (-1.047, 1.047), "thigh": (-0.663, 2.966), "calf": (-2.721, -0.837)}
"""Targets that the vendor's SDK accepts, rad (``go1_const.h``, used by its Safety.PositionLimit)."""

DEFAULT_KD = 2.0
"""Braking gain, N m s/rad (chosen): a Go1 sinks in about a second, without chattering."""


READINGS = ("joint_pos", "joint_vel", "joint_torque", "imu_quat", "imu_gyro", "imu_acc")
COMMANDED = ("joint_target", "kp", "kd", "feedforward")
"""Parts of a state and of a command that must be finite."""


@dataclass(frozen=True)
class SafetyConfig:
    """Limits of the faults.

    Attributes:
        tilt: largest angle between the trunk's z axis and the vertical, rad (chosen: beyond any gait of training).
        stale: largest age of the newest state, s (15 messages of the SDK).
        beyond_stop: largest measured angle beyond a stop, rad (the SDK's PositionProtect: 5 degrees).
        power: sum of |torque x velocity| over the joints, W (the SDK's PowerProtect at level 5 of 10).
        torque_margin: largest reported torque / limit (the report is an estimate).
        count: cycles over the limit, minus cycles under it, that make a torque or power fault (the SDK: 6 of 2 ms).
        quat_error: largest difference of the attitude quaternion's length from 1.
        damping_kd: braking gain, N m s/rad.
    """

    tilt: float = 1.0
    stale: float = 0.03
    beyond_stop: float = 0.087
    power: float = 500.0
    torque_margin: float = 1.2
    count: int = 6
    quat_error: float = 0.05
    damping_kd: float = DEFAULT_KD


@dataclass(frozen=True)
class Fault:
    """Reason for the end of a walk: name of the rule, time (s, the runtime's clock), and message."""

    name: str
    t: float
    message: str

    def __str__(self) -> str:
        return f"{self.name} at {self.t:.3f} s: {self.message}"


class _Counter:
    """Counts up while a limit is exceeded and down otherwise, as the SDK's PowerProtect."""

    def __init__(self, most: int) -> None:
        self._most, self.value = most, 0

    def exceeded(self, now: bool) -> bool:
        """Count a cycle; return whether the limit has been exceeded for long enough."""
        self.value = min(self.value + 1, 2 * self._most) if now else max(self.value - 1, 0)
        return self.value >= self._most


class Safety:
    """Checks every cycle before its command is sent.

    Attributes:
        fault: the first fault, or None. It stays.
        clamped: cycles in which the target of each joint was limited, (J,).
    """

    def __init__(
        self,
        joints: Sequence[str],
        stops: np.ndarray,
        torque_limit: np.ndarray,
        config: SafetyConfig | None = None,
        target_range: np.ndarray | None = None,
    ) -> None:
        """Set the limits of a robot.

        Args:
            joints: names, J.
            stops: hard stops (J, 2), rad.
            torque_limit: (J,) N m.
            config: limits of the faults.
            target_range: (J, 2) rad to which targets are limited; None for that of the Go1's SDK.
        """
        self.config = config or SafetyConfig()
        self._joints, self._stops, self._torque_limit = tuple(joints), np.asarray(stops), np.asarray(torque_limit)
        allowed = sdk_range(joints) if target_range is None else np.asarray(target_range)
        self._low, self._high = np.maximum(allowed[:, 0], stops[:, 0]), np.minimum(allowed[:, 1], stops[:, 1])
        self._torque, self._power = _Counter(self.config.count), _Counter(self.config.count)
        self._stop: str | None = None
        self._zeros = np.zeros(len(self._joints))
        self._gains: tuple[np.ndarray, np.ndarray] | None = None
        self._braking = np.full(len(self._joints), self.config.damping_kd)
        self.clamped = np.zeros(len(self._joints), dtype=np.int64)
        self.fault: Fault | None = None

    # ------------------------------------------------------------------ interface

    def stop(self, who: str) -> None:
        """Stop at the next cycle, as requested by ``who`` (a key, a signal). Only a flag is set: signal-safe."""
        self._stop = who

    def review(self, state: LowState | None, command: LowCmd | None, now: float) -> LowCmd:
        """Return the command to send: the given one within limits, or damping.

        Args:
            state: the newest state ever received; None before the first.
            command: the wanted command; None to brake.
            now: the runtime's clock, s.
        """
        if self.fault is None:
            for name in RULES if state is not None else STATELESS:
                if message := getattr(self, name)(state, command, now):
                    self.fault = Fault(name, now, message)
                    break
        if self.fault is not None or command is None or state is None:
            return self.damping(state)
        return self.limited(state, command)

    def fail(self, name: str, message: str, now: float) -> None:
        """Report a fault from another module, such as a filter that diverged; the first fault stays."""
        if self.fault is None:
            self.fault = Fault(name, now, message)

    def damping(self, state: LowState | None) -> LowCmd:
        """Return the command with which the motors only brake."""
        usable = state is not None and bool(np.isfinite(state.joint_pos).all())
        target = state.joint_pos.copy() if state is not None and usable else self._zeros
        return LowCmd(target, self._zeros, self._braking, damping=True)

    def limited(self, state: LowState, command: LowCmd) -> LowCmd:
        """Limit targets to those that need at most the peak torque, and then to the SDK's range and the stops.

        Feed-forward torque is limited to the peak torque first, and counts towards that of the target. The range has
        priority: a fast joint may need more than the peak torque to stay within it.
        """
        if command.feedforward is not None:
            within = np.minimum(np.maximum(command.feedforward, -self._torque_limit), self._torque_limit)
            command = replace(command, feedforward=within)
        target = self._cut(state, command)
        self.clamped += target != command.joint_target
        return replace(command, joint_target=target)

    def rehearse(self, state: LowState, command: LowCmd) -> None:
        """Do the work of a review without a result, for ``Controller.rehearse``."""
        for rule in (self.not_finite, self.attitude, self.tilt, self.joint_range):
            rule(state, command, state.t)
        self._cut(state, command)

    def _cut(self, state: LowState, command: LowCmd) -> np.ndarray:
        reach, drag = self._reach(command.kp, command.kd)
        still = state.joint_pos + drag * state.joint_vel  # (J,) the target that gives zero torque
        if command.feedforward is not None:  # a joint without kp has no target that could make up for it
            still = still - np.divide(command.feedforward, command.kp, out=self._zeros.copy(), where=command.kp > 0.0)
        target = np.minimum(np.maximum(command.joint_target, still - reach), still + reach)
        # The range comes last: it applies even if the torque limit gives a target outside it.
        return np.minimum(np.maximum(target, self._low), self._high)

    def _reach(self, kp: np.ndarray, kd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest distance of targets from zero torque, rad, and kd / kp, s; cached for these gains."""
        if self._gains is None or self._gains[0] is not kp or self._gains[1] is not kd:
            # A joint without kp has no target, so any is allowed.
            limit, held = self._torque_limit, kp > 0.0
            reach = np.divide(limit, kp, out=np.full_like(limit, np.inf), where=held)
            self._gains, self._reached = (kp, kd), (reach, np.divide(kd, kp, out=np.zeros_like(limit), where=held))
        return self._reached

    # ------------------------------------------------------------------ the rules

    def operator_stop(self, state: LowState | None, command: LowCmd | None, now: float) -> str | None:
        """A person, or a signal, requested the end."""
        return None if self._stop is None else f"requested by {self._stop}"

    def stale_state(self, state: LowState, command: LowCmd | None, now: float) -> str | None:
        """The newest state is too old."""
        age = now - state.t
        return f"the newest state is {1e3 * age:.0f} ms old" if age > self.config.stale else None

    def not_finite(self, state: LowState | None, command: LowCmd | None, now: float) -> str | None:
        """A reading or a command is not finite."""
        given: list[tuple[LowState | LowCmd, str]] = [(state, name) for name in READINGS] if state is not None else []
        if command is not None:
            given += [(command, name) for name in COMMANDED if getattr(command, name) is not None]
        vectors = [getattr(message, name) for message, name in given]
        if not vectors or np.isfinite(np.concatenate(vectors)).all():
            return None
        (_, name), values = next(p for p in zip(given, vectors, strict=True) if not np.isfinite(p[1]).all())
        k = int(np.flatnonzero(~np.isfinite(values))[0])
        where = self._joints[k] if len(values) == len(self._joints) else str(k)
        return f"{name} of {where} is {values[k]}"

    def attitude(self, state: LowState, command: LowCmd | None, now: float) -> str | None:
        """The attitude is not a unit quaternion, as from an IMU that has not started."""
        length = math.sqrt(float(state.imu_quat @ state.imu_quat))
        off = abs(length - 1.0) > self.config.quat_error
        return f"the attitude quaternion's length is {length:.3f} instead of 1" if off else None

    def tilt(self, state: LowState, command: LowCmd | None, now: float) -> str | None:
        """The tilt of the trunk is too large: the robot falls."""
        angle, limit = tilt_angle(state.imu_quat), self.config.tilt
        if angle <= limit:
            return None
        return f"tilt {math.degrees(angle):.0f} deg, the limit is {math.degrees(limit):.0f} deg"

    def joint_range(self, state: LowState, command: LowCmd | None, now: float) -> str | None:
        """A joint is measured beyond its stop."""
        beyond = np.maximum(self._stops[:, 0] - state.joint_pos, state.joint_pos - self._stops[:, 1])
        k = int(beyond.argmax())
        if beyond[k] <= self.config.beyond_stop:
            return None
        return f"{self._joints[k]} is at {state.joint_pos[k]:.3f} rad, {beyond[k]:.3f} rad beyond its stop"

    def torque(self, state: LowState, command: LowCmd | None, now: float) -> str | None:
        """A motor reports more than its peak torque, for some cycles."""
        share = np.abs(state.joint_torque) / self._torque_limit
        k = int(share.argmax())
        if not self._torque.exceeded(bool(share[k] > self.config.torque_margin)):
            return None
        return f"{self._joints[k]} reports {state.joint_torque[k]:.1f} N m, its limit is {self._torque_limit[k]:g} N m"

    def power(self, state: LowState, command: LowCmd | None, now: float) -> str | None:
        """The sum of |torque x velocity| is too large, for some cycles; driving and braking count alike."""
        power = float(np.abs(state.joint_torque * state.joint_vel).sum())
        if not self._power.exceeded(power > self.config.power):
            return None
        return f"the motors' power is {power:.0f} W, the limit is {self.config.power:g} W"


RULES = ("operator_stop", "stale_state", "not_finite", "attitude", "tilt", "joint_range", "torque", "power")
"""Names of the rules, in the order of evaluation; the first rule with a message is the fault."""

STATELESS = ("operator_stop", "not_finite")
"""Rules that apply before the first state too; until it arrives the motors brake."""


def tilt_angle(quat: np.ndarray) -> float:
    """Return the angle between the trunk's z axis and the vertical, rad, of an attitude w-x-y-z."""
    x, y = float(quat[1]), float(quat[2])
    squared = float(quat @ quat)
    if squared == 0.0:
        return math.pi
    return math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y) / squared)))


def sdk_range(joints: Sequence[str]) -> np.ndarray:
    """Return the targets (J, 2), rad, that the Go1's SDK accepts; unlimited for a joint of another kind."""
    return np.array([SDK_RANGE.get(name.rsplit("_", 1)[-1], (-np.inf, np.inf)) for name in joints])
