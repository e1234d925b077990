"""What a launcher is given and what it tells: tasks, and whoever watches them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from go1exp.train.sweep.command import Command, Ended


@dataclass(frozen=True)
class Task:
    """A job to run.

    Attributes:
        name: what tells it from the others.
        run_folder: relative to the sweep's folder.
        command: in a process of its own.
        in_process: in this process; returns when it is done, raises KeyboardInterrupt when a person stopped it.
    """

    name: str
    run_folder: str
    command: Command
    in_process: Callable[[], None]


class Watch(Protocol):
    """What a launcher tells of its jobs."""

    def changed(self) -> None:
        """Some job may have begun or ended: the index is written anew."""

    def ended(self, task: Task, how: Ended) -> None:
        """A job's process has ended."""


class Launcher(Protocol):
    """Runs jobs until none is left that can run."""

    remote: bool
    """Whether jobs run on other machines: what this one lacks is not asked."""

    def check(self) -> None:
        """Refuse what cannot work, before anything is written; raise ConfigError or ``Expected``."""

    def launch(self, folder: Path, tasks: Sequence[Task], watch: Watch) -> None:
        """Run the tasks of the sweep in ``folder``.

        Raises:
            KeyboardInterrupt: after a person stopped it; what ran has saved a checkpoint, or goes on elsewhere.
            go1exp.base.errors.Expected: if the cluster is not there, or leaves.
        """
