"""A walk or a check as both command lines run it: bundle, robot, walk, report."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from go1exp.base import signals
from go1exp.base.errors import REFUSED
from go1exp.deploy.estimation.feet import LEGS, FootCalibration
from go1exp.deploy.runtime import bundle as bundles
from go1exp.deploy.runtime.bundle import Bundle
from go1exp.deploy.runtime.commands import KEYS, make, range_array
from go1exp.deploy.runtime.controller import Mover
from go1exp.deploy.runtime.estimate import settings as estimator_settings
from go1exp.deploy.runtime.go1_check import calibrate, check
from go1exp.deploy.runtime.go1_wire import gains_on_wire
from go1exp.deploy.runtime.launch import RefusedError, RobotError, SimulatedRobot
from go1exp.deploy.runtime.log import About
from go1exp.deploy.runtime.report import end_line, report, save, summary_lines, velocity_errors
from go1exp.deploy.runtime.udp import HOST, SIMULATED_TICK_S, Go1Link, parsed_address
from go1exp.deploy.runtime.walk import STATUS, Outcome, Plan, walk
from go1exp.robot.go1_fields import MOTOR_NAMES, TORQUE_NOTE

Say = Callable[[str], None]

ON_WIRE = f"; gains are those of the packets, {TORQUE_NOTE}"
OTHER_MOVER = "; not moved by a policy: gains change, and feed-forward torques are not recorded"


@dataclass(frozen=True)
class Job:
    """A walk to run.

    Attributes:
        bundle: the file.
        robot: ``sim``, ``go1``, or the port of this machine at which a simulated robot already listens.
        plan: settings of the walk.
        out: folder of the logs.
        sim: settings of the simulated robot (``go1exp.deploy.sim_robot.SimConfig``).
        other: its ``actuator`` and ``effect``, if not those of training.
        truth: also write the simulated trunk's true motion into the recording.
        mover: commands the robot in place of the bundle's policy.
        motion: name of the mover's motion of a suspended robot; None if it walks.
        gains: kp and kd (J,) in place of the bundle's.
        address: HOST:PORT of ``go1``; that of every Go1 if None.
        feet: file of the calibration of foot sensors that report counts; contact from torques alone if None.
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


NOTICE = "note: robot=go1 has never been run on a robot; suspend it first, and keep a hand on its switch"


@contextmanager
def _connected(job: Job, bundle: Bundle, say: Say) -> Iterator[tuple[Go1Link, SimulatedRobot | None]]:
    """Open the link to the robot, and start the simulated one if wanted; close both at the end."""
    with contextlib.ExitStack() as stack:
        if job.robot == "go1":
            say(NOTICE)
            link = stack.enter_context(closing(Go1Link(*parsed_address(job.address))))
            about = bundle.metadata
            limits = about.joints, np.array(about.joint_limits), estimator_settings(about.estimator)
            findings = check(link, *limits, say)
            if findings.problems:
                why = "; ".join(findings.problems)
                raise RobotError(f"the robot does not pass its check, so no walk begins: {why}")
            link.tick_s = findings.tick_s
            yield link, None
        elif job.robot == "sim":
            say("starting the simulated robot")
            process = stack.enter_context(SimulatedRobot(job.bundle, job.sim, job.other, keep=job.plan.keep))
            yield stack.enter_context(closing(Go1Link(HOST, process.port, SIMULATED_TICK_S))), process
        else:
            if not (job.robot.isascii() and job.robot.isdigit() and 0 < int(job.robot) < 2**16):
                raise RobotError(
                    f"robot={job.robot}: must be sim, go1, or the port where a simulated robot listens", status=REFUSED
                )
            yield stack.enter_context(closing(Go1Link(HOST, int(job.robot), SIMULATED_TICK_S))), None


def run_check(joints: Sequence[str], stops: np.ndarray, feet: Path, address: str | None, say: Say) -> int:
    """Check a robot, calibrate its foot sensors, and return the exit status: 0 if a walk may begin.

    Args:
        joints: names.
        stops: (J, 2) hard stops, rad.
        feet: file of the foot sensors' calibration, to be made or completed.
        address: HOST:PORT; that of every Go1 if None.
        say: prints a line.

    Raises:
        go1exp.base.errors.Expected: if the address or the calibration's file is wrong.
        OSError: if the socket or the file cannot be opened.
    """
    host, port = parsed_address(address)
    say(f"listening to {host}:{port}; no torque is commanded")
    with closing(Go1Link(host, port)) as link:
        findings = check(link, joints, stops, estimator_settings({}), say)
    if not findings.problems:
        calibrate(findings, feet, say)
        say("check passed: a walk may begin")
        return 0
    for problem in findings.problems:
        say(f"problem: {problem}")
    say("check failed: no walk would begin")
    return NOT_PASSED


NOT_PASSED = 1
"""Exit status of a failed check."""


def run_job(job: Job, say: Say) -> int:
    """Walk, write the log, and return the exit status: 0 after an orderly end, otherwise that of the fault.

    SIGINT and SIGTERM before the first command end it at once, with the status of an operator's stop.

    Raises:
        go1exp.base.errors.Expected: if bundle, robot, commands or estimator are not available.
        OSError: if a file cannot be read or written.
    """
    feet = _calibration(job)
    bundle = bundles.load(job.bundle)
    _prepare(job, bundle, feet, say)
    outcome: Outcome | None = None
    try:
        with signals.handled(signals.interrupt), _connected(job, bundle, say) as (link, process):
            contact = "torque" if job.counting else None
            outcome = walk(
                bundle, link, job.plan, contact=contact, feet=feet, on_second=say, mover=job.mover, gains=job.gains
            )
    except KeyboardInterrupt:
        if outcome is not None:
            raise
        say("stopped before the walk began: nothing was commanded")
        return STATUS["operator_stop"]
    extra: dict[str, Any] = {"robot": job.robot, "link": asdict(link.traffic)}
    truth: Mapping[str, np.ndarray] = {}
    if process is not None:
        truth, extra["simulated_robot"] = process.truth, process.report
        extra["velocity"] = velocity_errors(outcome.log, truth)
    content = report(bundle, job.plan, outcome, extra)
    recorded = truth if job.truth and truth else None
    applied = None if process is None else process.applied
    files = save(Path(job.out), _about(job, bundle), outcome.log, content, recorded, applied)
    for line in (str(outcome.timing), *summary_lines(content), f"written to {', '.join(map(str, files))}"):
        say(line)
    say(end_line(outcome, job.motion))
    return outcome.status


def _prepare(job: Job, bundle: Bundle, feet: FootCalibration | None, say: Say) -> None:
    """Refuse what cannot walk before anything is started, and report the choices that were made."""
    about, plan = bundle.metadata, job.plan
    refuse_unfit(bundle)
    if about.kp is None or about.kd is None:
        raise RobotError(f"{job.bundle}: has no gains (its actuator net reports none)")
    make(plan.command, range_array(about.command_ranges), lambda who: None).close()
    if not about.command_ranges:
        say("note: the bundle has no range of commands, so none is limited")
    if job.mover is None and plan.rate is not None and abs(plan.rate * about.policy_dt - 1.0) > 1e-6:
        say(f"note: the policy was trained at {1 / about.policy_dt:g} Hz and runs at {plan.rate:g} Hz")
    if plan.command.source == "keyboard":
        say(KEYS)
    if job.counting:
        say(BY_TORQUE if feet is None else BY_BOTH.format(job.feet))
    folder = Path(job.out)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):  # raises now, not when the log is due
        pass


def refuse_unfit(bundle: Bundle) -> None:
    """Refuse a valid bundle that is not for a Go1; packets identify motors by position, not by name.

    Raises:
        RobotError: if it is for another robot, or its joints are others or in another order.
        go1exp.config.schema.registry.ConfigError: if its settings of the estimator are wrong.
    """
    about = bundle.metadata
    estimator_settings(about.estimator)
    if about.robot != "go1":
        raise RobotError(f"{bundle.source}: is for the robot {about.robot!r}; deploy commands a 'go1'")
    if about.joints != MOTOR_NAMES:
        pairs = enumerate(zip(about.joints, MOTOR_NAMES, strict=False))
        at = next((k for k, pair in pairs if pair[0] != pair[1]), None)
        first = f"{len(about.joints)} joints" if at is None else f"{about.joints[at]} at place {at + 1}"
        wanted = ", ".join(MOTOR_NAMES)
        raise RobotError(f"{bundle.source}: joints: has {first}; the motors of a Go1 are {wanted}, in this order")


BY_TORQUE = "foot contact: from joint torques alone; feet=FILE, a calibration, adds the foot sensors"
BY_BOTH = "foot contact: from joint torques and the foot sensors, calibrated by {}"


def _calibration(job: Job) -> FootCalibration | None:
    """Return the calibration of the foot sensors, if there is one; refuse one that is invalid, or is not needed."""
    if job.feet is None:
        return None
    if not job.counting:
        problem = f"feet = {job.feet}: calibrates sensors that report counts; those of robot={job.robot} report newtons"
        raise RefusedError([f"{problem}, unless sim.feet=raw"])
    calibration = FootCalibration.read(Path(job.feet))
    calibration.forces(np.zeros(LEGS))  # raises without scales, before anything moves
    return calibration


def _about(job: Job, bundle: Bundle) -> About:
    about = bundle.metadata
    gains = gains_on_wire(*(job.gains or (np.array(about.kp), np.array(about.kd))))
    return About(
        metadata=about,
        kp=gains[0],
        kd=gains[1],
        simulated=job.robot != "go1",
        newton=not job.counting,
        episode=_free(Path(job.out), time.strftime(f"{job.motion or 'walk'}_%Y-%m-%d_%H-%M-%S")),
        excitation=job.motion or "policy",
        suspended=job.motion is not None,
        varied=job.mover is not None and job.motion is None,
        notes=f"ends where the motors begin to brake{ON_WIRE}{OTHER_MOVER if job.mover and not job.motion else ''}",
        trained=bundle.config,
    )


def _free(folder: Path, name: str) -> str:
    """Return ``name``, with a number appended if a log of this name exists."""
    free, number = name, 1
    while list(folder.glob(f"{free}.*")):
        number += 1
        free = f"{name}_{number}"
    return free
