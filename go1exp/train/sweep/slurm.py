"""Jobs as an array on a Slurm cluster, through submitit.

The job that Slurm runs starts the training and waits. Before the time limit, and when a job is preempted, Slurm sends
SIGUSR2; then the training gets SIGTERM, saves a checkpoint after the iteration under way, and the job queues again.
Which jobs are left is read from ``squeue``: ``sacct`` needs a database that small clusters do not have.
"""

from __future__ import annotations

import importlib.util
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from go1exp.base.errors import Expected
from go1exp.base.files import write_json
from go1exp.config.schema.registry import ConfigError, Count, CountOrZero
from go1exp.config.schema.settings import settings
from go1exp.train.sweep.command import Command, Ended, Running, Task, Watch


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


FOLDER = "slurm"
"""In the sweep's folder: scripts, logs and results of submitit, and ``jobs.json``: run folder -> id of its job."""

DEAF = ("/bin/sh", "-c", "trap '' USR2 CONT; exec \"$@\"", "go1exp")
"""Before a command: Slurm's signals go to every process of a job, and this one shall hear what its parent makes of
them."""

ANSWER_S = 20.0
"""Time for Slurm's commands, s."""

USUAL = ("", "None", "Resources", "Priority", "JobArrayTaskLimit", "BeginTime", "Cleaning")
"""Why jobs wait, where it is nothing to tell of."""

LOST_LOOKS = 30
"""Looks at the queue without an answer after which the controller counts as gone: its jobs go on without us."""


class SlurmJob:
    """What submitit carries to a node; ``checkpoint`` is called there when the job is about to be ended."""

    def __init__(self, command: Command) -> None:
        self.command = command
        self._running: Running | None = None

    def __call__(self) -> Ended:
        """Run the training to its end."""
        self._running = Running(replace(self.command, words=(*DEAF, *self.command.words)))
        how = self._running.wait()
        print(f"status {how.status}: {how.last_line}", flush=True)
        return how

    def checkpoint(self) -> Any:
        """Have the training save a checkpoint and end; return what runs when the job starts again."""
        from submitit.helpers import DelayedSubmission

        signal.signal(signal.SIGUSR2, signal.SIG_IGN)  # Slurm sends it again, and would interrupt what follows
        if self._running is not None:
            self._running.stop()
            self._running.outlast()
        return DelayedSubmission(SlurmJob(self.command))


class Slurm:
    """An array of jobs."""

    remote = True

    def __init__(self, settings: SlurmSettings) -> None:
        self.settings = settings

    def check(self) -> None:
        """Refuse where submitit, Slurm's commands, its controller or the partition is missing."""
        if importlib.util.find_spec("submitit") is None:
            raise ConfigError(["hydra/launcher=slurm needs the package submitit: pip install 'go1exp[slurm]'"])
        if shutil.which("sbatch") is None:
            raise ConfigError(["hydra/launcher=slurm: there is no sbatch here; start the sweep on a login node"])
        known = _asked("sinfo", "-h", "-o", "%R").split()
        missing = [name for name in (self.settings.partition or "").split(",") if name and name not in known]
        if missing:
            raise ConfigError(
                [f"hydra.launcher.partition = {','.join(missing)!r}: no such partition; there are {', '.join(known)}"]
            )

    def launch(self, folder: Path, tasks: Sequence[Task], watch: Watch) -> None:
        """Run the tasks (see ``Launcher``)."""
        place = folder / FOLDER
        ids = {run: job for run, job in _noted(place).items() if run in {task.run_folder for task in tasks}}
        queued = _queued(ids.values())
        ids = {run: job for run, job in ids.items() if job in queued}
        if ids:
            print(f"{len(ids)} jobs are in the queue already")
        new = [task for task in tasks if task.run_folder not in ids]
        if new:
            ids |= self._submitted(place, folder.name, new)
            write_json(place / "jobs.json", {**_noted(place), **ids})
        print(f"logs: {place}/*_log.out of Slurm's jobs, job.log in each run folder", flush=True)
        try:
            self._follow(place, {ids[task.run_folder]: task for task in tasks}, watch)
        except KeyboardInterrupt:
            _leave(sorted(_queued(ids.values())), folder)
            raise

    def _submitted(self, place: Path, name: str, tasks: Sequence[Task]) -> dict[str, str]:
        import submitit

        wanted = self.settings
        executor = submitit.SlurmExecutor(folder=place, max_num_timeout=wanted.requeues)
        optional = {"partition": wanted.partition, "account": wanted.account, "qos": wanted.qos}
        executor.update_parameters(
            job_name=f"go1exp-{name}",
            time=wanted.time_min,
            signal_delay_s=wanted.warning_s,
            cpus_per_task=wanted.cpus,
            mem=f"{round(wanted.mem_gb * 1024)}M",
            array_parallelism=wanted.at_once,
            stderr_to_stdout=True,
            setup=[*wanted.setup, f"export OMP_NUM_THREADS={wanted.cpus}"],
            additional_parameters={"requeue": True, **wanted.options},
            **({"gpus_per_node": wanted.gpus} if wanted.gpus else {}),
            **{key: value for key, value in optional.items() if value is not None},
        )
        try:
            with executor.batch():
                jobs = [executor.submit(SlurmJob(task.command)) for task in tasks]
        except Exception as error:  # submitit's own kinds, with what sbatch printed
            lines = [line for line in str(error).splitlines() if "error:" in line] or str(error).splitlines()[-1:]
            raise Expected(f"slurm: sbatch refused the jobs: {' '.join(lines)}") from None
        print(f"slurm: {len(jobs)} jobs handed in as {jobs[0].job_id.split('_')[0]}")
        return {task.run_folder: str(job.job_id) for task, job in zip(tasks, jobs, strict=True)}

    def _follow(self, place: Path, tasks: dict[str, Task], watch: Watch) -> None:
        """Look at the queue until none of the jobs is in it."""
        left, lost, known = dict(tasks), 0, set(USUAL)
        while left:
            try:
                queued, lost = _queued(left), 0
            except Expected:
                lost += 1
                if lost >= LOST_LOOKS:
                    raise
                queued = dict.fromkeys(left, "")
            for job in [job for job in left if job not in queued]:
                watch.ended(left.pop(job), _result(place, job))
            watch.changed()
            for reason in sorted(set(queued.values()) - known):
                waiting = sum(why == reason for why in queued.values())
                print(f"slurm: {waiting} jobs wait: {reason} (scontrol show job says more)", flush=True)
                known.add(reason)
            if left:
                time.sleep(self.settings.poll_s)


def _asked(*words: str) -> str:
    """Return what one of Slurm's commands prints; raise Expected if the controller does not answer."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=ANSWER_S)
    except subprocess.TimeoutExpired:
        raise Expected(f"slurm: the controller does not answer ({words[0]} waited {ANSWER_S:.0f} s)") from None
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise Expected(f"slurm: the controller does not answer ({reason})")
    return done.stdout


def _queued(ids: Iterable[str]) -> dict[str, str]:
    """Return which of the jobs are in the queue (waiting, running, about to start again), each with why it waits."""
    wanted = set(ids)
    if not wanted:
        return {}
    # All of the user's jobs: asking for one that is forgotten already is an error.
    lines = _asked("squeue", "-h", "-r", "--me", "-o", "%i|%T|%r").splitlines()
    rows = [line.split("|", 2) for line in lines if line.count("|") >= 2]
    return {job: why if state == "PENDING" else "" for job, state, why in rows if job in wanted}


def _noted(place: Path) -> dict[str, str]:
    """Return run folder -> id of the job that was handed in for it last."""
    try:
        noted: dict[str, str] = json.loads((place / "jobs.json").read_text())
    except (OSError, ValueError):
        return {}
    return noted


def _result(place: Path, job: str) -> Ended:
    """Return how a job ended, as it said itself; of one that could not, that."""
    from submitit.core import utils

    paths = utils.JobPaths(place, job_id=job, task_id=0)
    for _ in range(10):  # a shared folder may be late
        if paths.result_pickle.exists():
            with suppress(Exception):
                kind, content = utils.pickle_load(paths.result_pickle)
                return content if kind == "success" else Ended(1, str(content).strip().splitlines()[-1])
        time.sleep(0.2)
    return Ended(1, f"Slurm's job {job} left the queue without a result; see {paths.stdout}")


def _leave(queued: Sequence[str], folder: Path) -> None:
    """Ask whether the jobs shall be cancelled; without a terminal they stay."""
    if not queued:
        return
    array = sorted({job.split("_")[0] for job in queued})
    answer = ""
    if sys.stdin.isatty():
        with suppress(EOFError, KeyboardInterrupt):
            answer = input(f"\ncancel {len(queued)} jobs of Slurm ({', '.join(array)})? They save a checkpoint. [y/N] ")
    if answer.strip().lower().startswith("y"):
        _asked("scancel", *queued)
        print(f"cancelled {len(queued)} jobs")
    else:
        print(f"\n{len(queued)} jobs stay in the queue; to cancel them: scancel {' '.join(array)}")
