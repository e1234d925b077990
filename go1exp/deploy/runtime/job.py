"""A walk from start to end, as both command lines run it: bundle, robot, walk, log."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from go1exp.deploy.estimation.feet import LEGS, FootCalibration
from go1exp.deploy.runtime import bundle as bundles
from go1exp.deploy.runtime.bundle import Bundle
from go1exp.deploy.runtime.commands import KEYS, make, range_array
from go1exp.deploy.runtime.controller import Mover
from go1exp.deploy.runtime.estimate import settings as estimator_settings
from go1exp.deploy.runtime.go1_check import Report, calibrate, check
from go1exp.deploy.runtime.go1_wire import gains_on_wire
from go1exp.deploy.runtime.launch import RefusedError, RobotError, SimulatedRobot
from go1exp.deploy.runtime.log import About
from go1exp.deploy.runtime.packet_delay import MOST_SLIP
from go1exp.deploy.runtime.udp import HOST, SIMULATED_TICK_S, Go1Link, parsed_address
from go1exp.deploy.runtime.walk import STATUS, Outcome, Plan, account, interruptible, save, velocity_errors, walk
from go1exp.robot.go1_fields import MOTOR_NAMES, TORQUE_NOTE

Say = Callable[[str], None]

ON_WIRE = f"; gains are those that the packets carried, {TORQUE_NOTE}"
OTHER_MOVER = "; not moved by a policy: gains change, and torques that are fed forward are not recorded"


@dataclass(frozen=True)
class Job:
    """A walk to run.

    Attributes:
        bundle: the file.
        robot: ``sim``, ``go1``, or the port of this machine at which a simulated robot already listens.
        plan: how to walk.
        out: folder of the logs.
        sim: settings of the simulated robot (``go1exp.deploy.sim_robot.machine.SimConfig``).
        other: its ``actuator`` and ``effect``, if not those of training.
        truth: also write the simulated trunk's true motion into the recording.
        mover: walks in place of the bundle's policy.
        motion: what the mover does to a robot that hangs; None if it walks.
        gains: kp and kd (J,) in place of the bundle's.
        address: HOST:PORT of ``go1``; that of every Go1 if None.
        feet: file of the calibration of foot sensors that count (``counting``); contact from torques alone if None.
    """

    bundle: str
    robot: str
    plan: Plan
    out: str
    sim: Mapping[str, Any] = field(default_factory=dict)
    other: Mapping[str, Any] = field(default_factory=dict)
    truth: bool = False
    mover: Mover | None = None
    motion: str | None = None
    gains: tuple[np.ndarray, np.ndarray] | None = None
    address: str | None = None
    feet: str | None = None

    @property
    def counting(self) -> bool:
        """Whether the foot sensors report counts, each with its own zero and scale, instead of newtons."""
        return self.robot == "go1" or self.sim.get("feet") == "raw"


NOTICE = "note: robot=go1 has never been run on a robot; hang it up first, and keep a hand on its switch"


@dataclass
class _Robot:
    """The connected robot, and the process to close with it."""

    link: Go1Link
    simulated: bool
    process: SimulatedRobot | None = None


@contextmanager
def _reached(job: Job, bundle: Bundle, say: Say) -> Iterator[_Robot]:
    """Open the link to the robot; close it at the end."""
    with contextlib.ExitStack() as stack:
        if job.robot == "go1":
            say(NOTICE)
            link = stack.enter_context(closing(Go1Link(*parsed_address(job.address))))
            link.tick_s = _checked(link, bundle, say).tick_s
            yield _Robot(link, simulated=False)
        elif job.robot == "sim":
            say("starting the simulated robot")
            process = stack.enter_context(SimulatedRobot(job.bundle, job.sim, job.other, keep=job.plan.keep))
            yield _Robot(stack.enter_context(closing(simulated(process.port))), True, process)
        else:
            if not (job.robot.isascii() and job.robot.isdigit() and 0 < int(job.robot) < 2**16):
                raise RobotError(f"robot={job.robot}: must be sim, go1, or the port where a simulated robot listens")
            yield _Robot(stack.enter_context(closing(simulated(int(job.robot)))), simulated=True)


def simulated(port: int) -> Go1Link:
    """Return a link to the simulated robot that listens at a port of this machine."""
    return Go1Link(HOST, port, SIMULATED_TICK_S)


def _checked(link: Go1Link, bundle: Bundle, say: Say) -> Report:
    """Return the findings about a robot that may walk.

    Raises:
        RobotError: if it may not.
    """
    about = bundle.metadata
    report = check(link, about.joints, np.array(about.joint_limits), estimator_settings(about.estimator), say)
    if report.problems:
        raise RobotError("the robot does not pass its check, so no walk begins: " + "; ".join(report.problems))
    return report


@dataclass(frozen=True)
class CheckJob:
    """A robot to look at.

    Attributes:
        joints: names.
        stops: (J, 2) hard stops, rad.
        feet: file of the foot sensors' calibration, which is made or completed.
        address: HOST:PORT; that of every Go1 if None.
    """

    joints: Sequence[str]
    stops: np.ndarray
    feet: Path
    address: str | None = None


def run_check(job: CheckJob, say: Say) -> int:
    """Look at a robot, calibrate its feet's sensors, and return the exit status: 0 if a walk may begin.

    Raises:
        go1exp.base.errors.Expected: if the address or the calibration's file is wrong.
        OSError: if the socket or the file cannot be opened.
    """
    host, port = parsed_address(job.address)
    say(f"listening to {host}:{port}; nothing is sent that asks for a torque")
    with closing(Go1Link(host, port)) as link:
        report: Report = check(link, job.joints, job.stops, estimator_settings({}), say)
    if not report.problems:
        calibrate(report, job.feet, say)
    for problem in report.problems:
        say(f"problem: {problem}")
    say("check passed: a walk may begin" if not report.problems else "check not passed: no walk would begin")
    return NOT_PASSED if report.problems else 0


NOT_PASSED = 1
"""Exit status of a check that finds a problem."""


def run_job(job: Job, say: Say) -> int:
    """Walk, write the log, and return the exit status: 0 after a whole walk, otherwise that of the fault.

    SIGINT and SIGTERM before the first command end it at once, with the status of an operator's stop.

    Raises:
        go1exp.base.errors.Expected: if bundle, robot, commands or estimator are not available.
        OSError: if a file cannot be read or written.
    """
    feet = _calibration(job)
    bundle = bundles.load(job.bundle)
    about, plan = bundle.metadata, job.plan
    refuse_unfit(bundle)
    if about.kp is None or about.kd is None:
        raise RobotError(f"{job.bundle}: knows no gains of its drives (those of an actuator net that says none)")
    make(
        plan.wish, range_array(about.command_ranges), lambda who: None, lambda who: None
    ).close()  # before anything is started
    if not about.command_ranges:
        say("note: the bundle knows no range of commands, so none is cut")
    if job.mover is None and plan.rate is not None and abs(plan.rate * about.policy_dt - 1.0) > 1e-6:
        say(f"note: the policy was trained at {1 / about.policy_dt:g} Hz and runs at {plan.rate:g} Hz")
    if plan.wish.command == "keyboard":
        say(KEYS)
    if job.counting:
        say(BY_TORQUE if feet is None else BY_BOTH.format(job.feet))
    _writable(Path(job.out))
    outcome: Outcome | None = None
    try:
        with interruptible(), _reached(job, bundle, say) as robot:
            contact = "torque" if job.counting else None
            means: dict[str, Any] = {"contact": contact, "feet": feet, "mover": job.mover, "gains": job.gains}
            outcome = walk(bundle, robot.link, plan, on_second=say, **means)
            traffic = robot.link.traffic
    except KeyboardInterrupt:
        if outcome is not None:
            raise
        say("stopped before the walk began: nothing was commanded")
        return STATUS["operator_stop"]
    extra: dict[str, Any] = {"robot": job.robot, "link": traffic.counts()}
    truth: Mapping[str, np.ndarray] = {}
    if robot.process is not None:
        truth, extra["simulated_robot"] = robot.process.truth, robot.process.report
        extra["velocity"] = velocity_errors(outcome.log, truth)
    content = account(bundle, plan, outcome, extra)
    where = _about(job, bundle, robot.simulated)
    applied = None if robot.process is None else robot.process.applied
    files = save(Path(job.out), where, outcome, content, truth if job.truth and truth else None, applied)
    say(str(outcome.timing))
    for line in summary_lines(content):
        say(line)
    say(f"written to {', '.join(map(str, files))}")
    say(_end(outcome))
    return outcome.status


def _end(outcome: Outcome) -> str:
    """Return a line on how a walk ended; a fault with its time since the start, which is the first cycle."""
    if fault := outcome.fault:
        began = min(outcome.log.phases.values(), default=fault.t)
        return f"fault: {fault.name} at {fault.t - began:.3f} s after the start: {fault.message}"
    end = f"until {outcome.asked}" if outcome.asked else "to the end"
    return f"walked for {outcome.walked:.1f} s, {end}"


def refuse_unfit(bundle: Bundle) -> None:
    """Refuse a bundle that is whole, but not for a Go1; a packet tells motors by their place, not by their name.

    Raises:
        RobotError: if it is for another robot, or its joints are others or in another order.
        go1exp.config.schema.registry.ConfigError: if its settings of the estimator are wrong.
    """
    about = bundle.metadata
    estimator_settings(about.estimator)
    if about.robot != "go1":
        raise RobotError(f"{bundle.source}: is for the robot {about.robot!r}; deploy drives a 'go1'")
    if about.joints != MOTOR_NAMES:
        at = next(
            (k for k, pair in enumerate(zip(about.joints, MOTOR_NAMES, strict=False)) if pair[0] != pair[1]), None
        )
        first = f"{len(about.joints)} joints" if at is None else f"{about.joints[at]} at place {at + 1}"
        wanted = ", ".join(MOTOR_NAMES)
        raise RobotError(f"{bundle.source}: joints: has {first}; the motors of a Go1 are {wanted}, in this order")


BY_TORQUE = "contact of the feet: by the joints' torques alone; feet=FILE, a calibration, adds the foot sensors"
BY_BOTH = "contact of the feet: by the joints' torques and by the sensors that {} calibrates"


def _calibration(job: Job) -> FootCalibration | None:
    """Return the calibration of the feet's sensors, if there is one.

    Raises:
        RefusedError: if the sensors need none.
        go1exp.deploy.estimation.feet.CalibrationError: if the file is none, or has no scales yet.
    """
    if job.feet is None:
        return None
    if not job.counting:
        problem = f"feet = {job.feet}: calibrates sensors that count; those of robot={job.robot} say newtons"
        raise RefusedError([f"{problem}, unless sim.feet=raw"])
    calibration = FootCalibration.read(Path(job.feet))
    calibration.forces(np.zeros(LEGS))  # raises without scales, before anything moves
    return calibration


def _about(job: Job, bundle: Bundle, simulated: bool) -> About:
    """Return the origin of a walk's log."""
    about = bundle.metadata
    gains = job.gains or (np.array(about.kp), np.array(about.kd))
    gains = gains_on_wire(*gains)
    return About(
        metadata=about,
        kp=gains[0],
        kd=gains[1],
        simulated=simulated,
        newton=not job.counting,
        episode=_free(Path(job.out), time.strftime(f"{job.motion or 'walk'}_%Y-%m-%d_%H-%M-%S")),
        excitation=job.motion or "policy",
        hung=job.motion is not None,
        notes="ends where the drives begin to brake"
        + ON_WIRE
        + (OTHER_MOVER if job.mover and job.motion is None else ""),
        trained=bundle.config,
    )


def summary_lines(content: Mapping[str, Any]) -> list[str]:
    """Return lines about the velocity of the walk, delays of packets and the timing of the simulated robot."""
    lines = []
    if velocity := content.get("velocity"):
        mean, rmse, off = (
            " ".join(f"{value:+.3f}" if name == "mean" else f"{value:.3f}" for value in velocity[name])
            for name in ("mean", "estimate_rmse", "tracking_rmse")
        )
        lines.append(f"true velocity {mean} m/s over {velocity['distance']:.1f} m; RMSE of the estimate {rmse}")
        lines.append(f"RMSE against the command: x, y {off.rsplit(' ', 1)[0]} m/s, yaw {off.rsplit(' ', 1)[1]} rad/s")
    if packets := content.get("packets"):
        late, age = (
            ", ".join(f"{name} {1e3 * value:.1f}" for name, value in packets[part].items()) for part in ("delay", "age")
        )
        lines.append(f"packets, beyond the fastest way: delay {late} ms; age of the newest at a cycle {age} ms")
        slow = packets.get("clock_slip")
        if slow is not None and abs(slow) > MOST_SLIP:
            how = f"{100 * abs(slow):.2g} % {'slow' if slow > 0 else 'fast'}"
            lines.append(f"note: the robot's clock ran {how} against this computer's; delays and ages include that")
    if robot := content.get("simulated_robot"):
        timing = robot["timing"]
        lines.append(
            f"simulated robot: {robot['ticks']} ticks of 2 ms, {1e3 * robot['slipped']:.0f} ms behind real time, "
            f"latest {1e3 * timing['late_worst']:.1f} ms; {robot['lost']} datagrams lost on the way"
        )
    return lines


def _writable(folder: Path) -> None:
    """Make the folder of the logs; raise OSError now, before the walk, if nothing can be written there."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        pass


def _free(folder: Path, name: str) -> str:
    """Return ``name``, with a number appended if a log of this name exists."""
    free, number = name, 1
    while list(folder.glob(f"{free}.*")):
        number += 1
        free = f"{name}_{number}"
    return free
