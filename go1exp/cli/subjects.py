"""What a verb works with: a run, a shipped policy, a bundle or another controller, on which robot and engine."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.cli.places import checkpoint_file, run_folder, shipped_policies, trained
from go1exp.config.choices import choice_files, config_folder, load
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.evaluate.controller.settings import MpcSettings, parse_controller

if TYPE_CHECKING:
    from go1exp.config.schema.physics import BackendConfig
    from go1exp.evaluate.agents import Agent
    from go1exp.evaluate.controller.types import Controller, TrunkVelocity
    from go1exp.sim.task import TaskConfig


ENGINE = "engine"


def split_engine(container: dict[str, object]) -> tuple[BackendConfig, dict[str, Any]]:
    """Return the checked engine, and other settings; raise ConfigError of all problems, or if not installed."""
    from go1exp.config.schema.physics import PhysxBackend
    from go1exp.sim.task import parse_parts

    parts, problems = parse_parts(container, (ENGINE,))
    if isinstance(parts.get(ENGINE), PhysxBackend) and importlib.util.find_spec("sapien") is None:
        problems.append("engine = physx: needs the package sapien: pip install 'go1exp[physx]', or use engine=mujoco")
    if problems:
        raise ConfigError(problems)
    return parts[ENGINE], {name: value for name, value in container.items() if name != ENGINE}


ROBOT_GROUPS = ("actuator", "effect", "contact")
"""Groups that a run's own choice can be replaced in; null or absent keeps it."""


def split_robot(container: dict[str, object]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the checked choices of another robot, by group, and other settings; raise ConfigError of problems."""
    from go1exp.sim.task import required_parts

    chosen = {name: container[name] for name in ROBOT_GROUPS if container.get(name) is not None}
    return required_parts(chosen), {name: value for name, value in container.items() if name not in ROBOT_GROUPS}


def with_robot(task: TaskConfig, parts: dict[str, Any]) -> TaskConfig:
    """Return the task with the other robot in it; raise ConfigError if actuator and effects do not go together."""
    from go1exp import robot
    from go1exp.sim.effects.rules import actuator_problems

    changed = dataclasses.replace(task, **parts)
    if problems := actuator_problems(changed.actuator, changed.effect, robot.JOINTS):
        raise ConfigError(problems)
    return changed


def robot_as_data(parts: dict[str, Any]) -> dict[str, Any]:
    """Return the choices as plain data, for a report."""

    def plain(part: Any) -> Any:
        if isinstance(part, tuple):
            return [plain(term) for term in part]
        return {"term": part.entry.name, **part.parameters} if isinstance(part, Term) else dataclasses.asdict(part)

    return {name: plain(part) for name, part in parts.items()}


CONDITIONS = "paper"
"""Shipped policy whose robot, ground and noise another controller walks under where no run is named."""


def chosen_controller(given: object) -> MpcSettings | None:
    """Return the settings of a controller other than a policy, None for a policy; raise ConfigError or SolverError."""
    settings = parse_controller({"name": "policy"} if given is None else given)
    if not isinstance(settings, MpcSettings):
        return None
    from go1exp.evaluate.controller.forces import solver

    solver()  # before anything is built
    return settings


def task_of_run(run: Path) -> TaskConfig:
    """Return the task of a run folder."""
    from go1exp.train import run_folder

    return run_folder.read_parsed(run).task


def controller_maker(settings: MpcSettings, task: TaskConfig) -> Callable[[], Controller]:
    """Return what makes one robot's controller."""
    from go1exp.evaluate.controller.mpc import Mpc

    return lambda: Mpc(settings, task.robot.inertia)


@dataclass(frozen=True)
class Named:
    """A subject whose files are there."""

    label: str  # name in reports
    folder: Path  # default place of its results
    run: Path | None = None  # run folder, of a run or of a shipped policy
    checkpoint: Path | None = None  # one of its checkpoints; None takes the newest
    bundle: Path | None = None  # file, in place of a run
    controller: MpcSettings | None = None  # in place of a policy; ``run`` then names the run of the robot that it moves


def driven(controller: MpcSettings, run: str | None, policy: str | None, file: str, out: str | None = None) -> Named:
    """Return a controller on the robot of a run or policy, or of ``CONDITIONS``; errors are those of ``trained``."""
    folder, results = trained(run, CONDITIONS if run is None and policy is None else policy, file, out)
    return Named("mpc", results if out else Path(f"mpc_{file}"), run=folder, controller=controller)


def subject_of(settings: Any, controller: MpcSettings | None, file: str, out: str | None = None) -> Named:
    """Return the subject of a verb's keys; its results are ``out``, or called ``file``; errors as those below."""
    if controller is None:
        return named(settings.run, settings.policy, settings.bundle, settings.checkpoint, file, out)
    if settings.bundle is not None:
        raise ConfigError([f"bundle = {settings.bundle!r}: is a policy; controller=mpc takes none"])
    return driven(controller, settings.run, settings.policy, file, out)


def named(
    run: str | None, policy: str | None, bundle: str | None, checkpoint: str | None, file: str, out: str | None = None
) -> Named:
    """Return the subject of the one key that is given, its results called ``file``; raise ConfigError of none."""
    if bundle is None:
        folder, results = trained(run, policy, file, out)
        return Named(policy or folder.name, results, run=folder, checkpoint=checkpoint_file(folder, checkpoint))
    others = [f"{key} = {value!r}" for key, value in (("run", run), ("policy", policy)) if value is not None]
    if others:
        raise ConfigError([f"bundle = {bundle!r} and {' and '.join(others)}: only one of them"])
    if checkpoint is not None:
        raise ConfigError([f"checkpoint = {checkpoint!r}: a bundle has only one"])
    return _bundle(bundle, file)


def _bundle(bundle: str, file: str) -> Named:
    path = Path(bundle)
    if not path.is_file():
        raise ConfigError([f"bundle = {bundle!r}: there is no such file; go1exp export writes one"])
    return Named(path.stem, Path(f"{path.stem}_{file}"), bundle=path)


VELOCITIES: dict[str, TrunkVelocity] = {"exact": "exact", "estimated": "estimated"}


@dataclass(frozen=True)
class Variation:
    """How a subject is played, where that differs from the protocol and from its training."""

    policy_dt: float | None = None  # period of the policy, s; None keeps it
    engine: BackendConfig | None = None  # physics engine; None is MuJoCo
    trunk_velocity: TrunkVelocity | None = None  # what the policy sees of it; None keeps it


def varied(given: str, file: str) -> tuple[Named, Variation]:
    """Return the subject of a word such as clock, mpc, runs/NAME@estimated, clock@100hz@physx; raise ConfigError."""
    name, *changes = given.split("@")
    if not name:
        raise ConfigError([f"subjects: {given!r}: names no policy before @, as paper{given} does"])
    variation = Variation()
    for change in changes:
        rate = re.fullmatch(r"(\d+(?:\.\d+)?)hz", change)
        if rate and 10.0 <= float(rate[1]) <= 1000.0:
            variation = dataclasses.replace(variation, policy_dt=1.0 / float(rate[1]))
        elif change in VELOCITIES:
            variation = dataclasses.replace(variation, trunk_velocity=VELOCITIES[change])
        elif change in _choices("engine"):
            moves, _ = split_engine({"engine": load(_choices("engine")[change])})
            variation = dataclasses.replace(variation, engine=moves)
        else:
            known = f"a rate of 10 to 1000 hz, exact, estimated, {' or '.join(_choices('engine'))}"
            raise ConfigError([f"subjects: {given!r}: after @ comes {known}"])
    return dataclasses.replace(word(name, file), label=given), variation


def _choices(group: str) -> dict[str, Path]:
    return choice_files(group, [config_folder()])


def word(given: str, file: str) -> Named:
    """Return the subject that one word names: a bundle's file, a run folder, or a shipped policy."""
    if given == "mpc":
        settings = chosen_controller(load(_choices("controller")[given]))
        assert settings is not None
        return driven(settings, None, None, file)
    if given.endswith(".zip"):
        return _bundle(given, file)
    if given in shipped_policies():
        return named(None, given, None, None, file)
    if Path(given).is_dir():
        return dataclasses.replace(named(str(run_folder(given)), None, None, None, file), label=given.rstrip("/"))
    known = ", ".join(shipped_policies())
    raise ConfigError(
        [f"subjects: {given!r} is no run folder, no bundle (.zip), no shipped policy ({known}), and not mpc"]
    )


def agent(subject: Named, other: dict[str, object], robot_of: TaskConfig | None = None) -> Agent:
    """Load what drives the robots, with choices of another robot (``split_robot``), or with the robot of a task.

    Raise ConfigError of a configuration that this version does not know, and BundleError of a damaged bundle.
    """
    from go1exp.evaluate.agents import BundleAgent, ControllerAgent, PolicyAgent

    if subject.bundle is not None:
        from go1exp.deploy.runtime.bundle import load
        from go1exp.sim.task import parse_train

        bundle = load(subject.bundle)
        task = _robot(parse_train(bundle.config).task, other, robot_of)
        trained = dataclasses.asdict(bundle.metadata.trained)
        about = {"bundle": str(subject.bundle), "sha256": bundle.seal, "trained": trained}
        return BundleAgent(subject.label, task, bundle, about=about)
    assert subject.run is not None
    if subject.controller is not None:
        task, controller = _robot(task_of_run(subject.run), other, robot_of), subject.controller
        settings = {"controller": dataclasses.asdict(controller), "robot_of_run": str(subject.run)}
        return ControllerAgent(subject.label, task, controller_maker(controller, task), about=settings)
    from go1exp.train.policy import load_run

    of_run, policy, about = load_run(subject.run, subject.checkpoint)
    return PolicyAgent(subject.label, _robot(of_run.task, other, robot_of), policy, about=about)


SAME = ("robot", "actuator", "effect", "contact", "rand", "termination")
"""Parts of a task that are the robot's and not the policy's."""


def _robot(task: TaskConfig, other: dict[str, object], robot_of: TaskConfig | None) -> TaskConfig:
    if robot_of is not None:
        task = dataclasses.replace(task, **{part: getattr(robot_of, part) for part in SAME})
    return with_robot(task, other)
