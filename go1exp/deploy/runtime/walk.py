"""One walk from the opened link to the last word of the account: the runtime's parts joined, and its log written."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from go1exp.base import signals
from go1exp.base.files import write_json
from go1exp.deploy.estimation.feet import FootCalibration
from go1exp.deploy.runtime.bundle import Bundle
from go1exp.deploy.runtime.commands import Limited, Wish, make, range_array
from go1exp.deploy.runtime.controller import Controller, Cycle, Estimator, Mover, Stages
from go1exp.deploy.runtime.estimate import BOTH, TORQUE, KalmanEstimator, NoEstimator, settings
from go1exp.deploy.runtime.log import About, Log, write_cycles
from go1exp.deploy.runtime.loop import MonotonicClock, Timing, run
from go1exp.deploy.runtime.packet_delay import delays, slip, spread
from go1exp.deploy.runtime.safety import RULES, Fault, Safety, SafetyConfig
from go1exp.robot.messages import Link

FAULTS = (*RULES, "no_state", "estimator", "command", "runtime")
FIRST_STATUS = 20
STATUS = {name: FIRST_STATUS + k for k, name in enumerate(FAULTS)}
"""Exit status of a walk that a fault ended, by its name."""

UNKNOWN_FAULT = FIRST_STATUS - 1
DONE = "walked to the end"

TIME = "the end of its time"
"""Who ends a walk that nobody else ends."""


@dataclass(frozen=True, kw_only=True)
class Plan(Stages):
    """How to walk, and how long its stages take.

    Attributes:
        rate: cycles per second, at which the policy runs; None: that of training.
        seconds: time under the policy, s; None: until somebody stops it.
        wish: where commands come from.
        keep: newest seconds of a walk that the log has room for.
        stale: age of the newest state at which the robot counts as lost, s.
        spin: time before each cycle for which the core is kept busy, rehearsing it, s: quicker, at that price.
    """

    rate: float | None = None
    seconds: float | None = None
    wish: Wish = field(default_factory=lambda: Wish((0.0, 0.0, 0.0)))
    keep: float = 120.0
    stale: float = SafetyConfig.stale
    spin: float = 0.0008


@dataclass(frozen=True)
class Outcome:
    """What became of a walk.

    Attributes:
        fault: what ended it; None if it went on to its end.
        walked: time under the policy, s.
        timing: how the loop kept its time.
        log: everything else.
        safety: with what was cut.
        commands: with what was cut.
        estimator: what it refused, by its word for it.
        memory_mb: resident when the walk ended.
        asked: who asked for its orderly end: a key; empty if the time was up.
    """

    fault: Fault | None
    walked: float
    timing: Timing
    log: Log
    safety: Safety
    commands: Limited
    estimator: dict[str, int]
    memory_mb: float | None
    asked: str = ""

    @property
    def status(self) -> int:
        """Exit status: 0 if it came to an orderly end."""
        return 0 if self.fault is None else STATUS.get(self.fault.name, UNKNOWN_FAULT)


def estimator_of(
    bundle: Bundle,
    safety: Safety,
    contact: str | None,
    feet: FootCalibration | None = None,
    always: bool = False,
) -> Estimator:
    """Return the estimator that a bundle's policy wants; with ``always`` one in any case.

    ``contact`` is ``torque`` for a robot whose feet's sensors count instead of saying newtons; None leaves the bundle's
    choice. With their calibration, ``feet``, both are used.

    Raises:
        go1exp.config.schema.registry.ConfigError: if the bundle's settings are not such.
        go1exp.deploy.estimation.EstimatorError: if the compiled filter is missing.
    """
    if not always and all(port.name != "base_lin_vel_b" for port in bundle.policy.inputs):
        return NoEstimator()
    changes: dict[str, Any] = {}
    if contact == "torque":
        changes = TORQUE if feet is None else BOTH
    return KalmanEstimator(
        settings(bundle.metadata.estimator, **changes), safety.fail, feet if changes is BOTH else None
    )


def walk(
    bundle: Bundle,
    link: Link,
    plan: Plan,
    *,
    contact: str | None = None,
    feet: FootCalibration | None = None,
    on_second: Callable[[str], None] = lambda line: None,
    mover: Mover | None = None,
    gains: tuple[np.ndarray, np.ndarray] | None = None,
) -> Outcome:
    """Walk, by the bundle's policy or by ``mover``. The link stays open; SIGINT and SIGTERM stop the robot meanwhile.

    ``gains``, kp and kd (J,), are in force in place of the bundle's.

    Raises:
        go1exp.base.errors.Expected: if commands or the estimator cannot be had; nothing has been sent then.
        OSError: if the file of commands cannot be read.
    """
    about = bundle.metadata
    limits = about.joints, np.array(about.joint_limits), np.array(about.torque_limit)
    safety = Safety(*limits, SafetyConfig(stale=plan.stale))
    estimator = estimator_of(bundle, safety, contact, feet, always=mover is not None)
    stop_requests: list[str] = []
    ranges = range_array(about.command_ranges)
    with contextlib.closing(make(plan.wish, ranges, safety.stop, stop_requests.append)) as commands:
        walk = _Walk(bundle, link, plan, safety, estimator, commands, stop_requests, mover, gains)
        with stopping(safety):
            clock = MonotonicClock(plan.spin, walk.rehearse, link.repeat, walk.prepare)
            timing = run(walk.cycle, walk.rate, None, clock, lambda timing: on_second(walk.status(timing)))
        return walk.outcome(timing)


class _Walk:
    """A walk under way: what each cycle does, and how it comes to its end."""

    def __init__(
        self,
        bundle: Bundle,
        link: Link,
        plan: Plan,
        safety: Safety,
        estimator: Estimator,
        commands: Limited,
        stop_requests: list[str],
        mover: Mover | None,
        gains: tuple[np.ndarray, np.ndarray] | None,
    ) -> None:
        """Join the parts of the runtime; nothing is sent yet. ``stop_requests`` fills with who asks for an end."""
        self.rate = plan.rate or 1.0 / bundle.metadata.policy_dt
        self._link, self._plan, self._safety, self._estimator = link, plan, safety, estimator
        self._commands, self._stop_requests = commands, stop_requests
        room = plan.keep
        if plan.seconds is not None:
            room = min(room, plan.seconds + plan.stand_up + plan.lie_down + plan.brake + plan.patience + 1.0)
        self._log = Log(self.rate, room)
        self._walked, self._ended_by, self._velocity = 0.0, "", np.zeros(3)
        self._controller = Controller(
            *(bundle, link, commands, estimator, safety),
            rate=self.rate,
            stages=plan,
            on_cycle=self._note,
            mover=mover,
            kp=gains and gains[0],
            kd=gains and gains[1],
        )

    def _note(self, cycle: Cycle) -> None:
        self._log.note(cycle)
        self._velocity[:] = cycle.base_lin_vel

    def cycle(self, now: float) -> bool:
        """Make one cycle at ``now``, s; return whether there is another."""
        self._commands.poll()
        if self._safety.fault is None and not self._ended_by:
            self._end_when_time_is_up(now)
        self._follow_stop_requests(now)
        try:
            return self._controller.cycle(now)
        except Exception as error:  # of the link or the log: nothing else gets out of a cycle
            self._safety.fail("runtime", f"{type(error).__name__}: {error}", now)
            with contextlib.suppress(Exception):
                self._link.send(self._safety.damping(None))
            return False

    def _end_when_time_is_up(self, now: float) -> None:
        self._walked = max(self._walked, self._controller.walked(now))
        if self._plan.seconds is None or self._controller.phase != "walking":
            return
        if self._walked > self._plan.seconds - 0.5 / self.rate:  # the next cycle would be the first one too many
            self._end_in_order(TIME, now)

    def _follow_stop_requests(self, now: float) -> None:
        """End the walk in order at the first request; brake at a second one, or where there is nothing to end."""
        for who in self._stop_requests:
            if self._ended_by or not self._plan.lie_down or self._controller.phase == "waiting":
                self._safety.stop(who)
            else:
                self._end_in_order(who, now)
        self._stop_requests.clear()

    def _end_in_order(self, who: str, now: float) -> None:
        self._ended_by = who
        self._controller.finish(now)

    def rehearse(self) -> None:
        """Make a cycle that sends nothing, so that the next one is quick."""
        with contextlib.suppress(Exception):  # what is wrong is the cycle's to find
            self._controller.rehearse()

    def prepare(self) -> None:
        """Take what has come already, while the robot moves."""
        self._controller.prepare()

    def status(self, timing: Timing) -> str:
        """Return a line on phase, timing and estimated velocity."""
        x, y, z = self._velocity
        speed = "" if np.isnan(self._velocity).any() else f"; estimate {x:+.2f} {y:+.2f} {z:+.2f} m/s"
        return f"{self._controller.phase}: {timing}{speed}"

    def outcome(self, timing: Timing) -> Outcome:
        """Return what became of the walk."""
        estimator = self._estimator
        refused = dict(getattr(estimator, "refused", {}), RESTARTED=getattr(estimator, "restarts", 0))
        fault = None if self._controller.finished else self._safety.fault
        parts = timing, self._log, self._safety, self._commands, refused, resident()
        return Outcome(fault, self._walked, *parts, self._ended_by.removeprefix(TIME))


@contextmanager
def stopping(safety: Safety) -> Iterator[None]:
    """Let signals stop the robot; leave their handlers as they were."""

    def stop(number: int, frame: FrameType | None) -> None:
        safety.stop(signal.Signals(number).name)
        if number == signal.SIGHUP:
            signals.leave_terminal()

    with signals.handled(stop):
        yield


def interruptible() -> AbstractContextManager[None]:
    """Let signals raise ``KeyboardInterrupt``, SIGINT also where a shell's background had it ignored; put them back."""
    return signals.handled(signals.interrupt)


def resident() -> float | None:
    """Return this process's resident memory, MB; None where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return None
    return pages * resource.getpagesize() / 1e6


def age() -> float | None:
    """Return how long this process has lived, s, to 10 ms; None where the system does not tell."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        return time.clock_gettime(time.CLOCK_BOOTTIME) - int(fields[19]) / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError):
        return None


def account(bundle: Bundle, plan: Plan, outcome: Outcome, extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return a walk as plain data."""
    log, fault = outcome.log, outcome.fault
    joints = bundle.metadata.joints
    start = log.first_command
    lived = age()
    return {
        "bundle": {"file": bundle.source, "sha256": bundle.seal},
        "ended": (f"asked for by {outcome.asked}" if outcome.asked else DONE) if fault is None else fault.name,
        "fault": None if fault is None else asdict(fault),
        "status": outcome.status,
        "walked_s": outcome.walked,
        "phases": log.phases,
        "rate": plan.rate or 1.0 / bundle.metadata.policy_dt,
        "trained_rate": 1.0 / bundle.metadata.policy_dt,
        "timing": {**asdict(outcome.timing), "missed_share": outcome.timing.missed_share},
        "clamped": dict(zip(joints, map(int, outcome.safety.clamped), strict=True)),
        "commands_cut": dict(zip(("x", "y", "yaw"), map(int, outcome.commands.cut), strict=True)),
        "estimator": outcome.estimator,
        "packets": packet_delays(log),
        "first_command_after_s": None if start is None or lived is None else lived - (time.perf_counter() - start),
        "memory_mb": outcome.memory_mb,
        "log": {"states": log.states.count, "overwritten": log.states.overwritten},
        **extra,
    }


def packet_delays(log: Log) -> dict[str, Any] | None:
    """Return how late packets came, and how old the newest state of a cycle was, s; None where no clock is told.

    Returns:
        ``delay`` of the states that are kept, and ``age`` at the cycles: each with p50, p99 and worst, both without the
        time that the fastest packet takes, which is not known; and ``clock_slip``, the share by which the robot's clock
        ran slow, None where that is not known.
    """
    arrived, clock = log.states.part("t"), log.states.part("clock")
    late, slow = spread(delays(arrived, clock)), slip(arrived, clock)
    age = spread(log.cycles.part("age"))
    if late is None or age is None:
        return None
    return {"delay": dict(late), "age": dict(age), "clock_slip": slow}


def save(
    folder: Path,
    about: About,
    outcome: Outcome,
    content: dict[str, Any],
    truth: Mapping[str, np.ndarray] | None,
    applied: np.ndarray | None = None,
) -> list[Path]:
    """Write NAME.json, NAME.npz and, if the robot was commanded, NAME.parquet; return the files.

    ``truth`` and ``applied`` are those of a simulated robot (``Log.recording``).

    Raises:
        OSError: if one cannot be written.
        go1exp.logs.recording.RecordingError: if what was logged is no recording.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{about.episode}.json", folder / f"{about.episode}.npz"]
    write_json(files[0], content, indent=1, allow_nan=False)  # first: nothing else is as small
    write_cycles(files[1], outcome.log)
    recording = outcome.log.recording(about, truth, applied)
    if recording is not None:
        from go1exp.logs import recording as format_

        files.append(folder / f"{about.episode}.parquet")
        format_.write(files[-1], recording)
    return files


def velocity_errors(log: Log, truth: Mapping[str, np.ndarray]) -> dict[str, Any] | None:
    """Compare estimate and command with the truth, cycle by cycle while walking; None if there is nothing to compare.

    The truth is that at the cycle, less the time that the fastest packet takes: nobody knows that one on a real robot.

    Returns:
        ``mean`` true velocity (3,), m/s in the trunk's frame; RMSE of the estimate, ``estimate_rmse`` (3,), and of the
        walk against its command after a second, ``tracking_rmse``: x and y in m/s, yaw in rad/s; ``distance``, m.
    """
    from go1exp.deploy.runtime.controller import PHASES

    arrived, clock = log.states.part("t"), log.states.part("clock")
    known = np.isfinite(clock)
    at = log.cycles.part("t")
    walking = (log.cycles.part("phase") == PHASES.index("walking")) & np.isfinite(log.cycles.part("estimate")).all(1)
    if not known.any() or not walking.any() or not truth:
        return None
    newest = np.searchsorted(arrived[known], at[walking], "right") - 1
    when = np.maximum.accumulate(clock[known])[np.maximum(newest, 0)] + log.cycles.part("age")[walking]
    w, x, y, z = (truth[f"base_quat_{part}"] for part in "wxyz")
    v = np.stack([truth[f"base_lin_vel_{axis}_w"] for axis in "xyz"], axis=1)
    turn = np.stack([x, y, z], axis=1)
    # R' v = v - 2 w (u x v) + 2 u x (u x v), u the vector part
    cross = np.cross(turn, v)
    every = v - 2.0 * w[:, None] * cross + 2.0 * np.cross(turn, cross)

    def then(values: np.ndarray) -> np.ndarray:
        return np.interp(when, truth["clock"], values)

    body = np.stack([then(values) for values in every.T], axis=1)
    true = np.column_stack([body[:, :2], then(truth["base_ang_vel_z_b"])])
    late = at[walking] - at[walking][0] >= min(1.0, 0.5 * (at[walking][-1] - at[walking][0]))
    off = true[late] - log.cycles.part("command")[walking][late]
    place = np.stack([then(truth["base_pos_x_w"]), then(truth["base_pos_y_w"])], axis=1)
    return {
        "mean": body[late].mean(axis=0).tolist(),
        "estimate_rmse": np.sqrt(np.mean((log.cycles.part("estimate")[walking] - body) ** 2, axis=0)).tolist(),
        "tracking_rmse": np.sqrt(np.mean(off**2, axis=0)).tolist(),
        "distance": float(np.linalg.norm(place[-1] - place[0])),
    }
