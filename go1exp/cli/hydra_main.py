"""A verb as a Hydra application: composition of its command line, its jobs, and the work for which Hydra is left."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from go1exp.config.hydra_adapter import MAIN, composed_once, jobs_of_sweep, plain, seen_by


class Left(BaseException):
    """Leaves Hydra for work that it has no part in; its callbacks would turn an ``Exception`` into a warning."""

    def __init__(self, work: Callable[[], int | None]) -> None:
        super().__init__()
        self.work = work


@dataclass(frozen=True)
class Sweep:
    """A sweep that Hydra was asked for.

    Attributes:
        folder: of the sweep.
        jobs: overrides of each job.
        launcher: ``hydra.launcher``, as plain data.
    """

    folder: Path
    jobs: list[list[str]]
    launcher: dict[str, Any]


@dataclass(frozen=True)
class Job:
    """The job that is running.

    Attributes:
        folder: run folder.
        multirun: whether it is one of several.
        number: among them.
        overrides: of the configuration, as given.
        of_hydra: overrides of Hydra's own configuration.
        study: chosen study that lists values to sweep over, if there is one.
        launcher: ``hydra.launcher``, as plain data.
    """

    folder: Path
    multirun: bool
    number: int
    overrides: list[str]
    of_hydra: list[str]
    study: str | None
    launcher: dict[str, Any]


def job() -> Job:
    """Return the job that is running."""
    about = HydraConfig.get()
    multirun = about.mode == RunMode.MULTIRUN
    return Job(
        Path(about.runtime.output_dir),
        multirun,
        about.job.num if multirun else 0,
        list(about.overrides.task),
        list(about.overrides.hydra),
        about.runtime.choices.get("study") if about.sweeper.get("params") else None,
        plain(about.launcher),
    )


def in_multirun() -> bool:
    """Return whether one of several jobs is running."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


_on_sweep: list[Callable[[Sweep], int | None]] = []


class SweepStart(Callback):
    """Hydra's hook before a sweep (``hydra.callbacks`` in ``conf/train.yaml``)."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Leave Hydra with the list of jobs, unless another sweeper than Hydra's own decides which there are."""
        if not _on_sweep:
            return
        begin, problem, asked = _on_sweep[-1], None, None
        try:
            if (jobs := jobs_of_sweep(config)) is not None:
                asked = Sweep(Path(str(config.hydra.sweep.dir)).absolute(), jobs, plain(config.hydra.launcher))
        except Exception as error:
            problem = error

        def work() -> int | None:
            if problem:
                raise problem
            assert asked
            return begin(asked)

        if problem or asked:
            raise Left(work)


def run(
    verb: str,
    argv: Sequence[str],
    folders: Sequence[Path],
    task: Callable[[dict[str, Any]], None],
    on_sweep: Callable[[Sweep], int | None] | None = None,
) -> int | None:
    """Compose ``conf/<verb>.yaml`` with Hydra's command line and call ``task`` with each job's configuration.

    Args:
        verb: name of the configuration.
        argv: title and arguments.
        folders: the user's folders of choices.
        task: gets the resolved configuration.
        on_sweep: runs a sweep in place of Hydra's sweeper; returns the exit status.

    Returns:
        the exit status of the work for which Hydra was left; None if it was not left.
    """
    before = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises, in place of a report and an exit
    sys.argv = list(argv)
    _on_sweep[:] = [on_sweep] if on_sweep else []
    try:
        with seen_by(verb, folders), composed_once(argv[1:], folders):
            hydra.main(**MAIN, config_path=None, config_name=verb)(lambda config: task(plain(config)))()
    except Left as left:
        return left.work()
    finally:
        if before is None:
            os.environ.pop("HYDRA_FULL_ERROR", None)
    return None
