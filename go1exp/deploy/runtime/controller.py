"""One cycle of the runtime: newest state, estimate, policy, safety, command."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np

from go1exp.deploy.runtime.bundle import Bundle
from go1exp.deploy.runtime.policy import PolicyMemory
from go1exp.deploy.runtime.safety import Safety, tilt_angle
from go1exp.deploy.runtime.udp import PacketDelay
from go1exp.robot.messages import Link, LowCmd, LowState

PHASES = ("waiting", "standing_up", "handing_over", "walking", "lying_down", "damping")
"""Before the first state; moving to the nominal stance; from its gains to the policy's, which is commanded to stand;
under the policy; lying down at an orderly end; braking until the end."""

STAND_KP, STAND_KD = 80.0, 2.5
"""Gains of standing up, N m/rad and N m s/rad (chosen: errors below 0.1 rad under the robot's weight)."""

STANCE_ERROR, STANCE_TILT = 0.15, 0.35
"""Largest difference of a joint from the nominal stance, and largest tilt, of a robot that stands, rad (chosen)."""

STAND_PATIENCE = 3.0
"""Time after ``Stages.stand_up`` within which the stance must be reached, s."""

LYING = (0.0, 1.3, -2.65)
"""Hip, thigh and calf angle of every leg of a lying Go1, rad."""

HALTED, STOOD = 0.4, 0.6
"""Shares of the time for lying down: end of standing still under a policy that walked, and of the motion to the nominal
stance (chosen on a shipped policy, which tips over without them)."""


@dataclass(frozen=True, kw_only=True)
class Stages:
    """Durations of the stages of a walk.

    Attributes:
        stand_up: time from the first pose to the nominal stance, s.
        hand_over: time from standing in the stance to the policy's own gains and targets, s.
        lie_down: time for lying down at an orderly end, s; 0: the motors brake at once.
        brake: time for which the motors brake at the end, s.
        patience: time to wait for the robot's first state, s.

    Raises:
        ValueError: if a time is negative, or ``patience`` not positive.
    """

    stand_up: float = 2.0
    hand_over: float = 0.5
    lie_down: float = 2.0
    brake: float = 2.0
    patience: float = 5.0

    def __post_init__(self) -> None:
        times = ("stand_up", "hand_over", "lie_down", "brake")
        problems = [f"{k} = {getattr(self, k)}: must be at least 0" for k in times if not getattr(self, k) >= 0.0]
        if not self.patience > 0.0:
            problems.append(f"patience = {self.patience}: must be greater than 0")
        if problems:
            raise ValueError("\n".join(problems))


class Estimator:
    """Estimates the trunk's velocity from the robot's sensors. This one, of a policy without use for it, says NaN."""

    def update(self, state: LowState) -> np.ndarray:
        """Take a new state; return the velocity (3,), m/s, of the trunk's origin in the trunk frame, at the newest."""
        return np.full(3, np.nan)

    def ahead(self, age: float) -> np.ndarray:
        """Return the velocity (3,), m/s, ``age`` s after the newest state; NaN: the age is not known."""
        return np.full(3, np.nan)


class Mover(Protocol):
    """Commands the robot in place of the bundle's policy."""

    def step(self, velocity: np.ndarray, state: LowState, base_lin_vel: np.ndarray) -> LowCmd:
        """Return the command of a cycle.

        Args:
            velocity: (3,) commanded, m/s, m/s, rad/s.
            state: the newest one.
            base_lin_vel: (3,) estimate of the trunk's velocity in its own frame, m/s.
        """


CommandSource = Callable[[float], np.ndarray]
"""Time since walking began, s -> commanded velocity (3,): x and y in m/s, yaw rate in rad/s."""


@dataclass(frozen=True)
class Cycle:
    """Data of one cycle, for the log.

    Attributes:
        t: the runtime's clock, s.
        phase: one of ``PHASES``.
        state: the newest state; None before the first.
        command: the command that was sent; None if none was.
        velocity: (3,) the commanded velocity that the policy observed.
        base_lin_vel: (3,) the estimate; NaN before the first.
        observation: (O,) input of the network; None unless walking.
        fresh: the states received since the last cycle, in the order of arrival.
        sent_at: time at which the command was sent, s of the runtime's clock; NaN if none was.
        age: age of the newest state, less the latency of the fastest packet, s; NaN if the robot reports no clock.
    """

    t: float
    phase: str
    state: LowState | None
    command: LowCmd | None
    velocity: np.ndarray
    base_lin_vel: np.ndarray
    observation: np.ndarray | None
    fresh: Sequence[LowState] = ()
    sent_at: float = math.nan
    age: float = math.nan


class Controller:
    """Runs a bundle's policy on the robot at the other end of a link.

    Attributes:
        phase: one of ``PHASES``.
        safety: checks every command before it is sent.
        finished: whether the walk reached its orderly end; a fault while braking after that does not count.
    """

    def __init__(
        self,
        bundle: Bundle,
        link: Link,
        commands: CommandSource,
        estimator: Estimator,
        safety: Safety,
        *,
        rate: float | None = None,
        stages: Stages | None = None,
        kp: np.ndarray | None = None,
        kd: np.ndarray | None = None,
        on_cycle: Callable[[Cycle], None] = lambda cycle: None,
        mover: Mover | None = None,
    ) -> None:
        """Join the parts.

        Args:
            bundle: the policy and its metadata.
            link: connection to the robot.
            commands: called in every cycle.
            estimator: gets every new state.
            safety: has the robot's limits.
            rate: cycles per second, Hz; that of training if None.
            stages: their durations.
            kp: (J,) N m/rad, also for standing up; None: those of the bundle, after those of standing up.
            kd: (J,) N m s/rad.
            on_cycle: called after every cycle.
            mover: commands the robot in place of the policy.

        Raises:
            ValueError: if neither the bundle nor the caller gives gains.
        """
        about = bundle.metadata
        gains = (about.kp if kp is None else kp), (about.kd if kd is None else kd)
        if gains[0] is None or gains[1] is None:
            raise ValueError("kp, kd: the bundle has none; they must be given")
        self._policy, self._link, self._commands = bundle.policy, link, commands
        self._estimator, self.safety, self._on_cycle = estimator, safety, on_cycle
        self._kp, self._kd = (np.asarray(values, dtype=float) for values in gains)
        given, size = kp is not None, len(self._kp)
        self._stand_gains = None if given else (np.full(size, STAND_KP), np.full(size, STAND_KD))
        self._joints, self._nominal = about.joints, np.asarray(about.nominal_stance)
        self._stages = stages or Stages()
        self._lying = np.tile(LYING, len(self._nominal) // len(LYING))
        self._begin: float | None = None
        self._mover = mover
        self._readings = {port.name: np.zeros((1, port.size), np.float32) for port in bundle.policy.inputs}
        self._memory = PolicyMemory(about, about.policy_dt if rate is None else 1.0 / rate)
        self._target = self._nominal.copy()
        self._state: LowState | None = None
        self._delay, self._age = PacketDelay(), math.nan
        self._early: list[LowState] = []  # received before their cycle; of these so many are in the estimate
        self._estimated, self._failed_early = 0, cast("Exception | None", None)
        self._origin, self._halting = self._nominal, False
        self._since = 0.0
        self._velocity, self._base = np.zeros(3), np.full(3, np.nan)
        self._observation: np.ndarray | None = None
        self.phase, self.finished = "waiting", False

    def cycle(self, now: float) -> bool:
        """Run one cycle; return whether there should be another. ``now`` is the clock's time, s.

        On any error the motors are commanded to brake; only the link and ``on_cycle`` can raise.
        """
        self._begin = now if self._begin is None else self._begin
        fresh, estimated = [*self._early, *self._link.receive()], self._estimated
        self._early, self._estimated = [], 0
        for each in fresh:
            self._delay.note(each.t, each.clock)
            # `not <`: the clock may be NaN
            self._state = each if self._state is None or not each.clock < self._state.clock else self._state
        if self._state is not None:
            self._age = self._delay.age(now, self._state.clock)
        elif now - self._begin > self._stages.patience:
            self.safety.fail("no_state", f"no state from the robot for {self._stages.patience:g} s", now)
        self._observation = None
        try:
            wanted = self._wanted(now, fresh[estimated:])
        except Exception as error:  # without a new command the robot would keep its last one
            self.safety.fail("runtime", f"{type(error).__name__}: {error}", now)
            wanted = None
        sent = self.safety.review(self._state, wanted, now)
        if self.safety.fault is not None and self.phase != "damping":  # also while lying down
            self.phase, self._since = "damping", now
        commanding = self._state is not None or self.phase == "damping"
        if commanding:
            self._target = sent.joint_target
            self._link.send(sent)
        command = sent if commanding else None
        sent_at = self._link.sent_at if commanding else math.nan
        about = (self._velocity, self._base, self._observation, fresh, sent_at, self._age)
        self._on_cycle(Cycle(now, self.phase, self._state, command, *about))
        return self.phase != "damping" or now - self._since < self._stages.brake

    def finish(self, now: float) -> None:
        """End the walk without a fault: from the next cycle on the robot lies down, then the motors brake."""
        if self.phase in ("lying_down", "damping"):
            return
        if self._stages.lie_down > 0 and self.phase != "waiting":
            self._halting, self._origin = self.phase == "walking", self._target
            self.phase, self._since = "lying_down", now
        else:
            self.phase, self._since, self.finished = "damping", now, True

    def prepare(self) -> None:
        """Process the states that have arrived, so that the next cycle has less to do; errors are raised there."""
        try:
            for state in self._link.receive():
                self._early.append(state)
                self._estimator.update(state)
                self._estimated += 1
        except Exception as error:
            self._failed_early = error

    def rehearse(self) -> None:
        """Run the costly parts of a cycle so that caches are warm; nothing is kept and nothing is sent."""
        if self._state is not None and self.phase == "walking":
            self._policy(self._readings)
            command = LowCmd(self._target, self._kp, self._kd)
            self.safety.rehearse(self._state, command)
            self._link.rehearse(command)

    def walked(self, now: float) -> float:
        """Return the time since walking began, s; 0 in other phases."""
        return now - self._since if self.phase == "walking" else 0.0

    def _wanted(self, now: float, unestimated: Sequence[LowState]) -> LowCmd | None:
        """Return the command of the present phase; None to brake. ``unestimated``: states for the estimator."""
        state = self._state
        if state is None or self.phase == "damping":
            return None
        if self._failed_early is not None:
            raise self._failed_early
        for each in unestimated:
            self._estimator.update(each)
        self._base = self._estimator.ahead(self._age)
        if self.phase == "waiting":
            self.phase, self._since, self._origin = "standing_up", now, state.joint_pos.copy()
        if self.phase == "standing_up" and (command := self._stand_up(state, now)):
            return command
        if self.phase == "handing_over":
            share = _share(now - self._since, self._stages.hand_over)
            if share < 1.0:
                return self._blended(share, self._walk(state, now))
            self.phase, self._since = "walking", now
        if self.phase == "lying_down":
            return self._lie(state, now)
        return self._walk(state, now)

    def _stand_up(self, state: LowState, now: float) -> LowCmd | None:
        """Return the command towards the stance; None once it is reached. A fault names what is not."""
        gains = self._stand_gains or (self._kp, self._kd)
        share = _share(now - self._since, self._stages.stand_up)
        if share < 1.0:
            return LowCmd(self._origin + share * (self._nominal - self._origin), *gains)
        missing = "" if self._stand_gains is None else self._missing(state)
        if not missing:
            self.phase, self._since = "walking" if self._stand_gains is None else "handing_over", now
            return None
        if now - self._since > self._stages.stand_up + STAND_PATIENCE:
            self.safety.fail("stand_up", f"the stance is not reached in {now - self._since:.1f} s: {missing}", now)
        return LowCmd(self._nominal, *gains)

    def _missing(self, state: LowState) -> str:
        """Return what of the stance is not reached; empty if all of it is."""
        away = state.joint_pos - self._nominal
        k, tilt = int(np.abs(away).argmax()), tilt_angle(state.imu_quat)
        wrong = []
        if not abs(away[k]) <= STANCE_ERROR:
            torque = f"with {state.joint_torque[k]:+.1f} N m"
            wrong.append(f"{self._joints[k]} is {away[k]:+.2f} rad off (at most {STANCE_ERROR:g}) {torque}")
        if not tilt <= STANCE_TILT:
            wrong.append(f"tilt {math.degrees(tilt):.0f} deg (at most {math.degrees(STANCE_TILT):.0f})")
        return ", ".join(wrong)

    def _blended(self, share: float, wanted: LowCmd | None) -> LowCmd | None:
        """Return a command whose torques are a share of the wanted ones, the rest those of the stance."""
        if wanted is None or self._stand_gains is None:
            return wanted
        (kp, kd), rest = self._stand_gains, 1.0 - share
        stance_kp, policy_kp = rest * kp, share * wanted.kp
        total_kp = stance_kp + policy_kp
        target = (stance_kp * self._nominal + policy_kp * wanted.joint_target) / total_kp
        fed = None if wanted.feedforward is None else share * wanted.feedforward
        return LowCmd(target, total_kp, rest * kd + share * wanted.kd, feedforward=fed)

    def _lie(self, state: LowState, now: float) -> LowCmd | None:
        """Stand still under the policy if it walked, move to the nominal stance, lie down; None at the end."""
        share = (now - self._since) / self._stages.lie_down
        if share < HALTED and self._halting:
            self._origin = self._target
            return self._walk(state, now)
        if share < 1.0 - 1e-9:
            ways = (HALTED if self._halting else 0.0, STOOD, 1.0), (self._origin, self._nominal, self._lying)
            k = int(share >= STOOD)
            begin, end = ways[0][k : k + 2]
            part = (share - begin) / (end - begin)
            return LowCmd(ways[1][k] + part * (ways[1][k + 1] - ways[1][k]), self._kp, self._kd)
        self.phase, self._since, self.finished = "damping", now, True
        return None

    def _walk(self, state: LowState, now: float) -> LowCmd | None:
        """Return the policy's command; None, and a fault, if the estimate or the commanded velocity is not finite."""
        command = self._commands(now - self._since) if self.phase == "walking" else np.zeros(3)
        self._velocity = np.asarray(command, dtype=float)
        given: dict[str, np.ndarray | float] = {
            "joint_pos": state.joint_pos,
            "joint_vel": state.joint_vel,
            "imu_gyro": state.imu_gyro,
            "imu_quat": state.imu_quat,
            "base_lin_vel_b": self._base,
            "joint_torque": state.joint_torque,
            "joint_target": self._target,
            "command": self._velocity,
            "walked": self.walked(now),
        }
        for name, values in given.items():
            if name in self._readings:
                self._readings[name][0] = values
        for fault, name in (("estimator", "base_lin_vel_b"), ("command", "command")):
            if (self._mover or name in self._readings) and not np.isfinite(given[name]).all():
                self.safety.fail(fault, f"{name} is {given[name]}", now)
                return None
        if self._mover:
            return self._mover.step(self._velocity, state, self._base)
        outputs = self._memory(self._policy, self._readings)
        self._observation = outputs["observation"][0]
        return LowCmd(outputs["joint_target"][0].astype(float), self._kp, self._kd)


def _share(passed: float, whole: float) -> float:
    """Return which share of a stage has passed, also of one without length."""
    return passed / whole if whole > 0 else 1.0
