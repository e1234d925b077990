"""The settings of launchers and of ``go1exp tune``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from go1exp.config.schema.settings import settings

Count = Annotated[int, Field(ge=1)]
CountOrZero = Annotated[int, Field(ge=0)]


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


@settings
class TuneSettings:
    """``conf/tune.yaml``.

    Attributes:
        space: what to draw from, such as ["ppo.gamma=interval(0.97,0.995)"]; also tag(log,interval(..)), range(..),
            choice(..).
        overrides: settings of every trial, such as ["experiment=five_minutes"].
        trials: trainings of the whole search, those of earlier commands and of other machines counted.
        workers: trainings at once on this machine, its cores shared out.
        metric: column of metrics.csv that says how good a training is, or eval/score and others of eval.every.
        direction: whether more of it is better.
        average: newest rows that the metric is averaged over.
        warmup: iterations before a training may be ended early.
        prune: end a training whose metric is below the median of the others at the same iteration.
        storage: where trials are kept, as Optuna names databases; null is a SQLite file in out.
        seed: of the draws; with one worker the same search from nothing draws the same.
        out: folder of the search: a run folder for each trial, and an index as sweeps have.
    """

    space: tuple[str, ...]
    overrides: tuple[str, ...]
    trials: Count
    workers: Count
    metric: Annotated[str, Field(min_length=1)]
    direction: Literal["maximize", "minimize"]
    average: Count
    warmup: Annotated[int, Field(ge=0)]
    prune: bool
    storage: str | None
    seed: Annotated[int, Field(ge=0)]
    out: Annotated[str, Field(min_length=1)]
