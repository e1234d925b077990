"""Sweeps: every job is checked before the first one starts, and told of after the last one.

Which jobs there are, and where they run, is the business of Hydra's sweeper and launcher. This module knows a sweep by
its folder, and a job by the state in its run folder (``go1exp/train/run_state.py``), so that it holds for any launcher.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict

from go1exp.cli.app import FAILED, App, Refused
from go1exp.cli.quoting import command
from go1exp.compose import as_container
from go1exp.schema.registry import ConfigError


class Job(Protocol):
    """What a job's configuration stands for."""

    @property
    def run(self) -> Path:
        """Its run folder."""


@dataclass
class Sweep:
    """A sweep as it was asked for: empty until Hydra says that there is one.

    Attributes:
        app: the verb.
        arguments: the command line after the verb.
        resolve: ``(container, overrides, folder) -> job``; raises ConfigError.
        check: raises ConfigError, or another error that is an answer, if a job cannot run here.
        folder: of the sweep.
        jobs: what tells each job from the others, and its run folder.
        status: exit status, after the sweep.
    """

    app: App
    arguments: Sequence[str]
    resolve: Callable[[dict[str, Any], list[str], Path], Any]
    check: Callable[[Any], None]
    folder: str = ""
    jobs: list[tuple[str, Path]] = field(default_factory=list)
    status: int = 0

    def prepare(self, config: DictConfig) -> None:
        """Compose and check every job.

        Args:
            config: that of the whole sweep, with ``hydra``.

        Raises:
            ConfigError: with every problem of every job, each with the first job that has it.
        """
        folder = str(config.hydra.sweep.dir)  # first: jobs take the time in it from the sweep, once that is known
        listed = _overrides_of_jobs(config)
        common = set.intersection(*map(set, listed)) if len(listed) > 1 else set()
        names = [" ".join(o for o in overrides if o not in common) for overrides in listed]
        jobs: list[Job] = []
        problems: dict[str, list[int]] = {}
        for step in (self._resolved, self._checked):
            for number, overrides in enumerate(listed):
                try:
                    step(config, number, overrides, jobs)
                except Exception as error:
                    for line in error.problems if isinstance(error, ConfigError) else [self.app.cause(error)]:
                        problems.setdefault(line, []).append(number)
            if problems:
                raise ConfigError([f"{line} ({_where(numbers, names)})" for line, numbers in problems.items()])
        self.folder = folder
        self.jobs = [(name, job.run) for name, job in zip(names, jobs, strict=True)]

    def _resolved(self, config: DictConfig, number: int, overrides: list[str], jobs: list[Job]) -> None:
        composed = GlobalHydra.instance().config_loader().load_sweep_config(config, overrides)
        with open_dict(composed):
            composed.hydra.job.id = composed.hydra.job.num = number
        folder = Path(str(composed.hydra.sweep.dir)) / str(composed.hydra.sweep.subdir)
        with open_dict(composed):
            del composed["hydra"]
        jobs.append(self.resolve(as_container(composed), overrides, folder))

    def _checked(self, config: DictConfig, number: int, overrides: list[str], jobs: list[Job]) -> None:
        self.check(jobs[number])

    def report(self) -> None:
        """Print what became of each job, and the command that goes on with what is left."""
        from go1exp.train import run_state

        states = [run_state.read(run) for _, run in self.jobs]
        kinds = [s.state for s in states]
        counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(sorted(kinds)))
        print(f"\nsweep {self.folder}: {counts}")
        for number, ((name, _), known) in enumerate(zip(self.jobs, states, strict=True)):
            print(f"{number:4}  {known.state:11}  {name}{f'  ({known.cause})' if known.cause else ''}")
        if any(kind != "done" for kind in kinds):
            self.status = FAILED
            given = any(a.startswith("hydra.sweep.dir=") for a in self.arguments)
            folder = [] if given else [f"hydra.sweep.dir={self.folder}"]
            print(f"go on with: {command(self.app.name, *self.arguments, *folder)}", flush=True)


class Check(Callback):
    """Hydra's hook before a sweep (``hydra.callbacks`` in ``conf/train.yaml``)."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Check every job of a sweep before the first one starts, and before the sweep has a folder."""
        if _current and str(config.hydra.sweeper["_target_"]).endswith(f".{BasicSweeper.__name__}"):
            try:
                _current[-1].prepare(config)
            except ConfigError as error:
                raise Refused(error) from None


_current: list[Sweep] = []


@contextmanager
def watched(
    app: App,
    arguments: Sequence[str],
    resolve: Callable[[dict[str, Any], list[str], Path], Any],
    check: Callable[[Any], None],
) -> Iterator[Sweep]:
    """Check the sweep that may begin in this block, and tell of it at its end, also at one by Ctrl-C."""
    _current.append(Sweep(app, arguments, resolve, check))
    try:
        yield _current[-1]
    finally:
        sweep = _current.pop()
        if sweep.jobs:
            sweep.report()


def _overrides_of_jobs(config: DictConfig) -> list[list[str]]:
    """Return the overrides of every job, as Hydra's own sweeper makes them."""
    params = config.hydra.sweeper.get("params") or {}
    given = OmegaConf.to_container(config.hydra.overrides.task)
    assert isinstance(given, list)
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    parsed = parser.parse_overrides([*(f"{key}={value}" for key, value in params.items()), *map(str, given)])
    return [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]


def _where(numbers: Sequence[int], names: Sequence[str]) -> str:
    """Say which jobs have a problem: the first of them, and how many more."""
    first = f"job {numbers[0]}: {names[numbers[0]]}" if names[numbers[0]] else f"job {numbers[0]}"
    return first if len(numbers) == 1 else f"{first}; and {len(numbers) - 1} more"
