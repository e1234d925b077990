"""``go1exp deploy``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.cli import controllers
from go1exp.cli.app import App
from go1exp.cli.other_robot import CHOICES
from go1exp.config.schema.registry import ConfigError
from go1exp.evaluate.controller.settings import MpcSettings

if TYPE_CHECKING:
    from go1exp.cli.settings import DeploySettings
    from go1exp.deploy.runtime.controller import Mover
    from go1exp.logs.record.motions import PlayedMotion


def _task(container: dict[str, Any]) -> int:
    from go1exp.cli.settings import DeploySettings, parse
    from go1exp.config.schema.settings import subset

    other = {name: container[name] for name in CHOICES if container.get(name) is not None}
    settings = parse(DeploySettings, {name: value for name, value in container.items() if name not in CHOICES})
    controller = controllers.chosen(settings.controller)
    if settings.check:
        return _check(settings)
    _refuse_misfits(settings, other, controller is not None)
    assert settings.bundle is not None  # or it would have been refused
    rate, seconds = _rate(settings, controller), settings.seconds
    motion = _motion(settings, controller is not None)
    mover = _mover(controller) if motion is None else motion
    if motion is not None:
        rate, seconds = motion.rate, motion.seconds

    from go1exp.cli.logs import remove_empty, writable
    from go1exp.deploy.runtime.commands import CommandConfig
    from go1exp.deploy.runtime.job import Job, run_job
    from go1exp.deploy.runtime.launch import RefusedError
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
        return run_job(job, lambda line: print(line, flush=True))
    except RefusedError as error:
        raise ConfigError(error.problems) from None
    finally:
        if not existed:
            remove_empty(Path(settings.out))


def _refuse_misfits(settings: DeploySettings, other: dict[str, Any], controlled: bool) -> None:
    """Raise ConfigError if settings do not go together; ``other``: choices of the simulated robot's groups."""
    from go1exp.cli.settings import EXAMPLES

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
    """Check the robot."""
    from go1exp import robot
    from go1exp.deploy.runtime.job import CheckJob, run_check

    if settings.robot != "go1":
        raise ConfigError([f"check = true: is for robot=go1, not robot={settings.robot}"])
    feet = Path(settings.feet or Path(settings.out) / "feet.json")
    job = CheckJob(robot.JOINTS, robot.JOINT_POS_LIMITS, feet, settings.address)
    return run_check(job, lambda line: print(line, flush=True))


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
    from go1exp.evaluate.controller.adapters import Deployed
    from go1exp.evaluate.controller.mpc import Mpc

    return Deployed(Mpc(controller))


def _motion(settings: DeploySettings, controlled: bool) -> PlayedMotion | None:
    """Return the motion of a suspended robot, if one is requested."""
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


APP = App("deploy", _task)
