"""The launchers by name, and their settings: where the jobs of a sweep run, how many at once, with what.

``conf/launcher`` has a file for each; Hydra knows them as ``hydra/launcher``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

from pydantic import Field

from go1exp.schema.registry import ConfigError, nearest
from go1exp.schema.settings import parse, settings
from go1exp.sweep.command import Command, Ended

Count = Annotated[int, Field(ge=1)]
CountOrZero = Annotated[int, Field(ge=0)]


@dataclass(frozen=True)
class Task:
    """A job to run.

    Attributes:
        name: what tells it from the others.
        run_folder: relative to the sweep's folder.
        command: in a process of its own.
        here: in this process; returns when it is done, raises KeyboardInterrupt when a person stopped it.
    """

    name: str
    run_folder: str
    command: Command
    here: Callable[[], None]


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
            go1exp.errors.Expected: if the cluster is not there, or leaves.
        """


@settings
class BasicSettings:
    """One job after the other, in this process.

    Attributes:
        name: basic.
    """

    name: Literal["basic"]

    def launcher(self) -> Launcher:
        """Return the launcher."""
        from go1exp.sweep.local import Basic

        return Basic()


@settings
class JoblibSettings:
    """``conf/launcher/joblib.yaml``: several jobs at once on the cores of this machine.

    Attributes:
        name: joblib.
        n_jobs: jobs at once; -1 for one on each core.
        threads: cores of each job, 0 shares all of them out.
    """

    name: Literal["joblib"]
    n_jobs: Annotated[int, Field(ge=-1)]
    threads: CountOrZero

    def __post_init__(self) -> None:
        """Refuse no jobs at all."""
        if self.n_jobs == 0:
            raise ValueError("n_jobs = 0: give the number of jobs at once, or -1 for one on each core")

    def launcher(self) -> Launcher:
        """Return the launcher."""
        from go1exp.sweep.local import Local

        return Local(self)


@settings
class SlurmSettings:
    """``conf/launcher/slurm.yaml``: an array of jobs on a Slurm cluster.

    Attributes:
        name: slurm.
        partition: partition, or several with commas; null is the cluster's default.
        time_min: time limit of a job, minutes; at its end a job saves a checkpoint and queues again.
        warning_s: time before the limit at which Slurm warns a job, s; longer than one iteration.
        requeues: times that a job may reach its limit; what is preempted does not count.
        cpus: cores of a job.
        mem_gb: memory of a job, GB.
        gpus: GPUs of a job.
        at_once: jobs of the array that may run at once.
        account: account to charge, null for the user's default.
        qos: quality of service, null for the default.
        setup: shell lines before a job starts, such as 'module load cuda'.
        options: further options of sbatch, as name and value, such as {constraint: a100}.
        poll_s: time between two looks at the queue, s.
    """

    name: Literal["slurm"]
    partition: str | None
    time_min: Count
    warning_s: Annotated[int, Field(ge=1)]
    requeues: CountOrZero
    cpus: Count
    mem_gb: Annotated[float, Field(gt=0)]
    gpus: CountOrZero
    at_once: Count
    account: str | None
    qos: str | None
    setup: tuple[str, ...]
    options: dict[str, Any]
    poll_s: Annotated[float, Field(gt=0, le=600)]

    def launcher(self) -> Launcher:
        """Return the launcher."""
        from go1exp.sweep.slurm import Slurm

        return Slurm(self)


@settings
class RaySettings:
    """``conf/launcher/ray.yaml``: jobs as Ray tasks.

    Attributes:
        name: ray.
        address: of a running cluster, auto for the one of this machine; null starts one here for this sweep.
        cpus: cores of a job.
        gpus: GPUs of a job; less than 1 lets jobs share one.
        retries: times that a job is started again when its node dies; it goes on from its checkpoint.
    """

    name: Literal["ray"]
    address: str | None
    cpus: Count
    gpus: Annotated[float, Field(ge=0)]
    retries: CountOrZero

    def launcher(self) -> Launcher:
        """Return the launcher."""
        from go1exp.sweep.ray_cluster import Ray

        return Ray(self)


LAUNCHERS: dict[str, Any] = {
    "basic": BasicSettings,
    "joblib": JoblibSettings,
    "slurm": SlurmSettings,
    "ray": RaySettings,
}
"""Name -> class of its settings."""

HYDRAS_BASIC = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
"""What ``hydra/launcher=basic``, Hydra's default, is called in a composed configuration."""


def chosen(container: Mapping[str, Any]) -> Any:
    """Return the settings of the launcher that ``hydra.launcher`` describes, checked.

    Raises:
        ConfigError: with everything that is wrong with them, or if it is not one of ours.
    """
    if container.get("_target_") == HYDRAS_BASIC:
        return BasicSettings(name="basic")
    name = container.get("name")
    if name not in LAUNCHERS:
        given = container.get("_target_", name)
        close = nearest(str(name), list(LAUNCHERS))
        hint = f"did you mean {close[0]!r}?" if close else f"there are: {', '.join(LAUNCHERS)}"
        raise ConfigError([f"hydra/launcher: {given!r} is no launcher of sweeps; {hint}"])
    try:
        return parse(LAUNCHERS[name], container)
    except ConfigError as error:
        raise ConfigError([f"hydra.launcher.{problem}" for problem in error.problems]) from None
