"""``go1exp deploy``."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from go1exp.cli import subjects
from go1exp.cli.app import EXAMPLES, App, parse
from go1exp.cli.places import remove_empty, writable
from go1exp.cli.subjects import ROBOT_GROUPS
from go1exp.config.schema import settings as schema
from go1exp.config.schema.registry import ConfigError, Gain, Positive
from go1exp.config.schema.settings import subset
from go1exp.deploy.runtime.controller import Stages
from go1exp.deploy.sim_robot import SimConfig
from go1exp.evaluate.controller.settings import MpcSettings

if TYPE_CHECKING:
    from go1exp.deploy.runtime.controller import Mover
    from go1exp.logs.record.motions import PlayedMotion


@schema.settings
class SinusoidSettings:
    """Sines of all three velocities.

    Attributes:
        amplitude: amplitudes of x, y, yaw, m/s, m/s, rad/s.
        period: their common period, s.
    """

    amplitude: tuple[float, float, float]
    period: Positive


@schema.settings
class DeploySettings(Stages):
    """``conf/deploy.yaml`` without the groups; the times of the stages are those of the runtime.

    Attributes:
        controller: what moves the robot: policy, that of the bundle, or mpc (robot=sim only).
        bundle: file that go1exp export wrote; check=true needs none.
        robot: sim, a simulated robot in another process, or go1, the real one.
        address: HOST:PORT of robot=go1; null takes 192.168.123.10:8007.
        check: with robot=go1, only look at the robot and calibrate its foot sensors; no torque is ever commanded.
        feet: calibration of foot sensors that count, a real robot's or those of sim.feet=raw, which check=true writes;
            null takes contact from torques alone, and lets check=true write feet.json in out.
        command: velocity as [x m/s, y m/s, yaw rad/s]; or FILE.csv, sinusoid, keyboard, gamepad.
        motion: in place of walking, move a robot that hangs: an excitation of go1exp record, or FILE.csv of targets
            (such as the one of go1exp gap next); its log is a recording for go1exp gap.
        gains: kp N m/rad and kd N m s/rad of motion; null takes those of the file, or [20, 0.5].
        sinusoid: the sines of command=sinusoid.
        rate: rate of policy and commands, Hz; null takes that of training; of a motion, that of its file, or 400.
        seconds: time under the policy, s; null walks until it is stopped (Ctrl-C). Of a motion that is no file: 20.
        keep: newest seconds of the walk that the log has room for.
        stale: time without a state after which the robot counts as lost, s.
        spin: time before each cycle for which the core is kept busy, s; quicker, and it costs that core.
        sim: the simulated robot.
        truth: also record the simulated trunk's true pose and velocity.
        out: folder for the logs.
    """

    controller: Any = None
    bundle: Annotated[str, Field(min_length=1)] | None
    robot: Literal["sim", "go1"]
    address: str | None
    check: bool
    feet: str | None
    command: tuple[float, float, float] | str
    motion: Annotated[str, Field(min_length=1)] | None
    gains: tuple[Gain, Gain] | None
    sinusoid: SinusoidSettings
    rate: Annotated[float, Field(ge=10, le=1000)] | None
    seconds: Positive | None
    keep: Annotated[float, Field(gt=0, le=3600)]
    stale: Positive
    spin: Annotated[float, Field(ge=0, le=0.01)]
    sim: SimConfig
    truth: bool
    out: str


def _task(container: dict[str, object]) -> int:
    other = {name: container[name] for name in ROBOT_GROUPS if container.get(name) is not None}
    settings = parse(DeploySettings, {name: value for name, value in container.items() if name not in ROBOT_GROUPS})
    controller = subjects.chosen_controller(settings.controller)
    if settings.check:
        return _check(settings)
    _refuse_misfits(settings, other, controller is not None)
    assert settings.bundle is not None  # or it would have been refused
    rate, seconds = _rate(settings, controller), settings.seconds
    motion = _motion(settings, controller is not None)
    mover = _mover(controller) if motion is None else motion
    if motion is not None:
        rate, seconds = motion.rate, motion.seconds

    from go1exp.deploy.runtime.commands import CommandConfig
    from go1exp.deploy.runtime.job import Job, run_job
    from go1exp.deploy.runtime.walk import Plan

    existed = Path(settings.out).exists()
    writable(settings.out)
    command = CommandConfig(settings.command, settings.sinusoid.amplitude, settings.sinusoid.period)
    plan = subset(Plan, settings, command=command, rate=rate, seconds=seconds)
    sim = dataclasses.asdict(settings.sim)
    job = Job(
        settings.bundle,
        settings.robot,
        plan,
        settings.out,
        sim,
        other,
        truth=settings.truth,
        mover=mover,
        motion=None if motion is None else motion.name,
        gains=None if motion is None else motion.gains,
        address=settings.address,
        feet=settings.feet,
    )
    try:
        return run_job(job, partial(print, flush=True))
    finally:
        if not existed:
            remove_empty(Path(settings.out))


def _refuse_misfits(settings: DeploySettings, other: dict[str, object], controlled: bool) -> None:
    """Raise ConfigError if settings do not go together; ``other``: choices of the simulated robot's groups."""
    if settings.bundle is None:
        raise ConfigError([f"bundle: required, such as {EXAMPLES['bundle']}"])
    real = settings.robot != "sim"
    if real and other:
        raise ConfigError([f"{', '.join(other)}: the real robot has its own; they are for robot=sim"])
    if not real and settings.address is not None:
        raise ConfigError([f"address = {settings.address}: is for robot=go1"])
    if real and controlled:
        raise ConfigError(
            ["controller=mpc: is for robot=sim; it has never moved a real robot, nor has a person tried it"]
        )


def _check(settings: DeploySettings) -> int:
    from go1exp import robot
    from go1exp.deploy.runtime.job import run_check

    if settings.robot != "go1":
        raise ConfigError([f"check = true: is for robot=go1, not robot={settings.robot}"])
    feet = Path(settings.feet or Path(settings.out) / "feet.json")
    say = partial(print, flush=True)
    return run_check(robot.JOINTS, robot.JOINT_POS_LIMITS, feet, settings.address, say)


def _rate(settings: DeploySettings, controller: MpcSettings | None) -> float | None:
    """Return cycles per second, Hz; None for those of training."""
    if controller is None:
        return settings.rate
    rate = 1.0 / controller.period
    if settings.rate is not None and abs(settings.rate - rate) > 1e-6 * rate:
        raise ConfigError([f"rate = {settings.rate:g}: controller=mpc runs at {rate:g} Hz (controller.period)"])
    return rate


def _mover(controller: MpcSettings | None) -> Mover | None:
    """Return what commands the robot in place of the bundle's policy, if anything does."""
    if controller is None:
        return None
    from go1exp.evaluate.controller.mpc import Mpc
    from go1exp.evaluate.controller.types import Deployed

    return Deployed(Mpc(controller))


def _motion(settings: DeploySettings, controlled: bool) -> PlayedMotion | None:
    if settings.motion is None:
        if settings.gains is not None:
            raise ConfigError(["gains: are of motion; a policy walks with those that it was trained with"])
        return None
    if controlled:
        raise ConfigError(["controller=mpc: walks; motion moves a suspended robot. Leave out one of them"])
    if settings.robot == "sim" and settings.sim.start != "suspended":
        raise ConfigError([f"motion = {settings.motion!r}: is for a suspended robot; add sim.start=suspended"])
    from go1exp.logs.record.motions import played

    return played(settings.motion, settings.seconds, settings.rate, settings.gains, settings.sim.seed)


APP = App("deploy", _task, DeploySettings)
