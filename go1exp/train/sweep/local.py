"""Jobs on this machine: one after the other in this process, or several at once, each on cores of its own."""

from __future__ import annotations

import os
import queue
import signal
import sys
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from go1exp.base import signals
from go1exp.config.schema.registry import ConfigError, CountOrZero
from go1exp.config.schema.settings import settings
from go1exp.train.sweep.command import Command, Ended, Running, Task, Watch


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

    def check(self) -> None:
        """Nothing can be missing."""

    def launch(self, folder: Path, tasks: Sequence[Task], watch: Watch) -> None:
        """Run the tasks (see ``Launcher``)."""
        for task in tasks:
            try:
                task.in_process()
            finally:
                watch.changed()


class Local:
    """Several jobs at once. Cores are shared out: a thread of one never waits for a core of another."""

    remote = False

    def __init__(self, settings: JoblibSettings) -> None:
        cores = sorted(os.sched_getaffinity(0))
        at_once = len(cores) if settings.n_jobs < 0 else settings.n_jobs
        self.shares = shares(cores, at_once, settings.threads)

    def check(self) -> None:
        """Nothing can be missing."""

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
                running[task.run_folder] = Running(_with_cores(task.command, share))
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


def _with_cores(command: Command, share: tuple[int, ...]) -> Command:
    return replace(command, cores=share, variables={**command.variables, "OMP_NUM_THREADS": str(len(share))})
