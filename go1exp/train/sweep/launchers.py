"""The launchers by name: where the jobs of a sweep run, how many at once, with what.

``conf/launcher`` has a file for each; Hydra knows them as ``hydra/launcher``.
"""

from __future__ import annotations

import os
import queue
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from go1exp.base import signals
from go1exp.config.schema.registry import ConfigError, CountOrZero, nearest
from go1exp.config.schema.settings import parse, settings
from go1exp.train.sweep import ray_cluster, slurm
from go1exp.train.sweep.command import Ended, Launcher, Running, Task, Watch


@settings
class BasicSettings:
    """One job after the other, in this process.

    Attributes:
        name: basic.
    """

    name: Literal["basic"]


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


class Basic:
    """One job after the other, in this process."""

    remote = False

    def __init__(self, settings: BasicSettings) -> None:
        """There is nothing to set."""

    def check(self) -> None:
        """Nothing can be missing."""

    def launch(self, folder: Path, tasks: Sequence[Task], watch: Watch) -> None:
        """Run the tasks (see ``Launcher``)."""
        for task in tasks:
            try:
                task.in_process()
            finally:
                watch.changed()


class Local(Basic):
    """Several jobs at once. Cores are shared out: a thread of one never waits for a core of another."""

    def __init__(self, settings: JoblibSettings) -> None:
        cores = sorted(os.sched_getaffinity(0))
        at_once = len(cores) if settings.n_jobs < 0 else settings.n_jobs
        self.shares = shares(cores, at_once, settings.threads)

    def launch(self, folder: Path, tasks: Sequence[Task], watch: Watch) -> None:
        """Run the tasks (see ``Launcher``)."""
        free: queue.SimpleQueue[tuple[int, ...]] = queue.SimpleQueue()
        for share in self.shares[: len(tasks)]:
            free.put(share)
        running: dict[str, Running] = {}
        stopping: list[bool] = []

        def work(task: Task) -> Ended | None:
            share = free.get()
            try:
                if stopping:
                    return None
                variables = {**task.command.variables, "OMP_NUM_THREADS": str(len(share))}
                running[task.run_folder] = Running(replace(task.command, cores=share, variables=variables))
                return running[task.run_folder].wait()
            finally:
                running.pop(task.run_folder, None)
                free.put(share)

        with ThreadPoolExecutor(len(self.shares)) as pool:
            futures = {pool.submit(work, task): task for task in tasks}
            try:
                _follow(futures, watch)
            except KeyboardInterrupt:
                stopping.append(True)
                _stop(running)
                _outwait(pool, running)
                raise


def _follow(futures: dict[Future[Ended | None], Task], watch: Watch) -> None:
    """Tell of each job when it ends, and now and then of those that have begun."""
    left = set(futures)
    while left:
        ended, left = wait(left, timeout=2.0, return_when=FIRST_COMPLETED)
        for future in ended:
            how = future.result()
            if how is not None:
                watch.ended(futures[future], how)
        watch.changed()


def _stop(running: dict[str, Running], number: int = signal.SIGTERM) -> None:
    for job in list(running.values()):
        job.stop(number)


def _outwait(pool: ThreadPoolExecutor, running: dict[str, Running]) -> None:
    """Wait for the checkpoints of jobs that were asked to stop; a second Ctrl-C ends them without."""
    if running:
        print(
            f"\nstopping {len(running)} jobs after the iteration under way, with a checkpoint (Ctrl-C again: at once)",
            file=sys.stderr,
            flush=True,
        )
    with signals.handled(lambda number, frame: _stop(running, signal.SIGKILL)):
        pool.shutdown(cancel_futures=True)


def shares(cores: Sequence[int], at_once: int, threads: int = 0) -> list[tuple[int, ...]]:
    """Share cores out.

    Args:
        cores: numbers of the cores that there are.
        at_once: jobs at once.
        threads: cores of each; 0 shares out as many as there are.

    Returns:
        the cores of each job; with more jobs than cores, some share one.

    Raises:
        ConfigError: if a job is to have more cores than there are.
    """
    if threads > len(cores):
        raise ConfigError([f"hydra.launcher.threads = {threads}: this process may use {len(cores)} cores"])
    width = threads or max(1, len(cores) // at_once)
    ring = [*cores, *cores]
    return [tuple(sorted(ring[(k * width) % len(cores) :][:width])) for k in range(at_once)]


Settings = BasicSettings | JoblibSettings | slurm.SlurmSettings | ray_cluster.RaySettings

LAUNCHERS: dict[str, tuple[type[Settings], Callable[..., Launcher]]] = {
    "basic": (BasicSettings, Basic),
    "joblib": (JoblibSettings, Local),
    "slurm": (slurm.SlurmSettings, slurm.Slurm),
    "ray": (ray_cluster.RaySettings, ray_cluster.Ray),
}
"""Name -> class of its settings, and what is built with them."""

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
        return parse(LAUNCHERS[name][0], container)
    except ConfigError as error:
        raise ConfigError([f"hydra.launcher.{problem}" for problem in error.problems]) from None


def built(settings: Settings) -> Launcher:
    """Return the launcher with these settings."""
    return LAUNCHERS[settings.name][1](settings)
