"""What moves the robot of a verb: the policy that it names, or another controller (group ``controller``)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.evaluate.controller.settings import MpcSettings, parse_controller

if TYPE_CHECKING:
    from go1exp.evaluate.controller.types import Controller
    from go1exp.sim.task import TaskConfig

CONDITIONS = "hop"
"""Shipped policy whose robot, ground and noise another controller walks under where no run is named."""


def chosen(given: Any) -> MpcSettings | None:
    """Return the settings of another controller than a policy, from a verb's group ``controller``; None for a policy.

    Raises:
        ConfigError: with every problem of the settings.
        go1exp.evaluate.controller.forces.SolverError: if the controller's solver is not installed.
    """
    settings = parse_controller({"name": "policy"} if given is None else given)
    if not isinstance(settings, MpcSettings):
        return None
    from go1exp.evaluate.controller.forces import solver

    solver()  # before anything is built
    return settings


def conditions(run: str | None, policy: str | None, file: str, out: str | None) -> tuple[TaskConfig, Path]:
    """Return the task in which another controller walks, and the file for results; arguments as ``runs.trained``'s.

    The task is that of the run or the shipped policy that is named, else that of ``CONDITIONS``.
    """
    return task_of(robot_of(run, policy)), place(run, policy, file, out)


def robot_of(run: str | None, policy: str | None) -> Path:
    """Return the folder of the run whose robot another controller moves.

    Raises:
        ConfigError: if there is no such run or policy.
    """
    from go1exp.cli.runs import trained

    named = run is not None or policy is not None
    return trained(run, policy if named else CONDITIONS, "", None)[0]


def place(run: str | None, policy: str | None, file: str, out: str | None) -> Path:
    """Return where results go: ``out``, or ``mpc_FILE`` here."""
    from go1exp.cli.runs import trained

    named = run is not None or policy is not None
    return trained(run, policy if named else CONDITIONS, file, out)[1] if out else Path(f"mpc_{file}")


def task_of(run: Path) -> TaskConfig:
    """Return the task of a run folder."""
    from go1exp.train import run_folder

    return run_folder.read_parsed(run).task


def maker(settings: MpcSettings, task: TaskConfig) -> Callable[[], Controller]:
    """Return what makes one robot's controller."""
    from go1exp.evaluate.controller.mpc import Mpc

    return lambda: Mpc(settings, task.robot.inertia)
