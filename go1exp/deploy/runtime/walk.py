"""One walk: the runtime's parts joined and run at a fixed rate, from the open link to the outcome."""

from __future__ import annotations

import contextlib
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import numpy as np

from go1exp.base import signals
from go1exp.base.errors import FAULTS, FIRST_FAULT, UNKNOWN_FAULT
from go1exp.deploy.estimation.feet import FootCalibration
from go1exp.deploy.runtime.bundle import Bundle
from go1exp.deploy.runtime.commands import CommandConfig, Constant, make, range_array
from go1exp.deploy.runtime.controller import STAND_PATIENCE, Controller, Cycle, Estimator, Mover, Stages
from go1exp.deploy.runtime.estimate import BOTH, TORQUE, KalmanEstimator, settings
from go1exp.deploy.runtime.log import Log
from go1exp.deploy.runtime.loop import MonotonicClock, Timing, run
from go1exp.deploy.runtime.safety import Fault, Safety, SafetyConfig
from go1exp.robot.messages import Link

STATUS = {name: FIRST_FAULT + k for k, name in enumerate(FAULTS)}
"""Exit status of a walk that ended with a fault, by the fault's name."""

TIME = "the end of its time"


@dataclass(frozen=True, kw_only=True)
class Plan(Stages):
    """Settings of a walk, and the durations of its stages.

    Attributes:
        rate: cycles per second, at which the policy runs; None: that of training.
        seconds: time under the policy, s; None: until it is stopped.
        command: source of the commanded velocity.
        keep: newest seconds of a walk that the log holds.
        stale: age of the newest state at which the robot counts as lost, s.
        spin: time before each cycle for which the core is kept busy, rehearsing the cycle, s: quicker, at that price.
    """

    rate: float | None = None
    seconds: float | None = None
    command: CommandConfig = field(default_factory=lambda: CommandConfig((0.0, 0.0, 0.0)))
    keep: float = 120.0
    stale: float = SafetyConfig.stale
    spin: float = 0.0008


@dataclass(frozen=True)
class Outcome:
    """Result of a walk.

    Attributes:
        fault: that ended it; None if it reached its end.
        walked: time under the policy, s.
        timing: of the loop.
        log: of cycles and states.
        safety: with the number of limited targets.
        commands: with the number of limited commands.
        estimator: number of samples that it left out, by status, and of restarts.
        memory_mb: resident memory at the end; None if unknown.
        requested_by: origin of the request of its orderly end, such as a key; empty if its time was up.
    """

    fault: Fault | None
    walked: float
    timing: Timing
    log: Log
    safety: Safety
    commands: Constant
    estimator: dict[str, int]
    memory_mb: float | None
    requested_by: str = ""

    @property
    def status(self) -> int:
        """Exit status: 0 after an orderly end."""
        return 0 if self.fault is None else STATUS.get(self.fault.name, UNKNOWN_FAULT)


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

    Args:
        bundle: policy and metadata.
        link: connection to the robot.
        plan: settings.
        contact: ``torque`` for a robot whose foot sensors report counts; None leaves the bundle's choice.
        feet: calibration of these sensors; with it, contact comes from torques and sensors.
        on_second: called with a status line every second.
        mover: commands the robot in place of the policy.
        gains: kp and kd (J,), in place of the bundle's.

    Raises:
        go1exp.base.errors.Expected: if commands or the estimator are not available; nothing has been sent then.
        OSError: if the file of commands cannot be read.
    """
    about = bundle.metadata
    limits = about.joints, np.array(about.joint_limits), np.array(about.torque_limit)
    safety = Safety(*limits, SafetyConfig(stale=plan.stale))
    estimator = _estimator(bundle, safety, contact, feet, needed=mover is not None)
    stop_requests: list[str] = []
    ranges = range_array(about.command_ranges)
    with contextlib.closing(make(plan.command, ranges, safety.stop, stop_requests.append)) as commands:
        walk = _Walk(bundle, link, plan, safety, estimator, commands, stop_requests, mover, gains)
        with _stopping(safety):
            clock = MonotonicClock(plan.spin, walk.rehearse, link.repeat, walk.controller.prepare)
            timing = run(walk.cycle, walk.rate, None, clock, lambda timing: on_second(walk.status(timing)))
        return walk.outcome(timing)


def _estimator(
    bundle: Bundle, safety: Safety, contact: str | None, feet: FootCalibration | None, needed: bool
) -> Estimator:
    """Return the estimator of a bundle's policy; none if the policy has no use for it, unless ``needed``."""
    if not needed and all(port.name != "base_lin_vel_b" for port in bundle.policy.inputs):
        return Estimator()
    changes: dict[str, str | float] = {}
    if contact == "torque":
        changes = TORQUE if feet is None else BOTH
    config = settings(bundle.metadata.estimator, **changes)
    return KalmanEstimator(config, safety.fail, feet if changes is BOTH else None)


class _Walk:
    def __init__(
        self,
        bundle: Bundle,
        link: Link,
        plan: Plan,
        safety: Safety,
        estimator: Estimator,
        commands: Constant,
        stop_requests: list[str],
        mover: Mover | None,
        gains: tuple[np.ndarray, np.ndarray] | None,
    ) -> None:
        """Join the parts of the runtime; nothing is sent yet. ``stop_requests`` fills with the origins of requests."""
        self.rate = plan.rate or 1.0 / bundle.metadata.policy_dt
        self._link, self._plan, self._safety, self._estimator = link, plan, safety, estimator
        self._commands, self._stop_requests = commands, stop_requests
        room = plan.keep
        if plan.seconds is not None:
            stages = plan.patience + plan.stand_up + STAND_PATIENCE + plan.hand_over + plan.lie_down + plan.brake
            room = min(room, plan.seconds + stages + 1.0)
        self._log = Log(self.rate, room)
        self._walked, self._ended_by, self._velocity = 0.0, "", np.zeros(3)
        self.controller = Controller(
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
            return self.controller.cycle(now)
        except Exception as error:  # of the link or the log: a cycle raises nothing else
            self._safety.fail("runtime", f"{type(error).__name__}: {error}", now)
            with contextlib.suppress(Exception):
                self._link.send(self._safety.damping(None))
            return False

    def _end_when_time_is_up(self, now: float) -> None:
        self._walked = max(self._walked, self.controller.walked(now))
        if self._plan.seconds is None or self.controller.phase != "walking":
            return
        if self._walked > self._plan.seconds - 0.5 / self.rate:  # the next cycle would be the first one too many
            self._end_in_order(TIME, now)

    def _follow_stop_requests(self, now: float) -> None:
        """End the walk in order at the first request; brake at a second one, or where there is nothing to end."""
        for who in self._stop_requests:
            if self._ended_by or not self._plan.lie_down or self.controller.phase == "waiting":
                self._safety.stop(who)
            else:
                self._end_in_order(who, now)
        self._stop_requests.clear()

    def _end_in_order(self, who: str, now: float) -> None:
        self._ended_by = who
        self.controller.finish(now)

    def rehearse(self) -> None:
        """Make a cycle that sends nothing, so that the next one is quick."""
        with contextlib.suppress(Exception):  # the cycle itself finds the error
            self.controller.rehearse()

    def status(self, timing: Timing) -> str:
        """Return a line on phase, timing and estimated velocity."""
        x, y, z = self._velocity
        speed = "" if np.isnan(self._velocity).any() else f"; estimate {x:+.2f} {y:+.2f} {z:+.2f} m/s"
        return f"{self.controller.phase}: {timing}{speed}"

    def outcome(self, timing: Timing) -> Outcome:
        """Return the result of the walk."""
        estimator = self._estimator
        refused = dict(getattr(estimator, "refused", {}), RESTARTED=getattr(estimator, "restarts", 0))
        fault = None if self.controller.finished else self._safety.fault
        parts = timing, self._log, self._safety, self._commands, refused, _resident()
        return Outcome(fault, self._walked, *parts, self._ended_by.removeprefix(TIME))


@contextmanager
def _stopping(safety: Safety) -> Iterator[None]:
    """Let signals stop the robot; restore their handlers."""

    def stop(number: int, frame: FrameType | None) -> None:
        safety.stop(signal.Signals(number).name)
        if number == signal.SIGHUP:
            signals.leave_terminal()

    with signals.handled(stop):
        yield


def _resident() -> float | None:
    """Return this process's resident memory, MB; None where the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return None
    return pages * resource.getpagesize() / 1e6
