"""Sweeps: every job is checked before the first one starts, run by a launcher, and told of after the last one.

Hydra composes ``-m`` and its sweeper says which jobs there are; then it is left. A job is a run folder that holds its
configuration, and running it is going on with that run, so a change of ``conf/`` never reaches a job that waits.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from go1exp.base.signals import STOPPED
from go1exp.cli.app import FAILED, App, Left, Refused, spinner
from go1exp.cli.quoting import command, quoted
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.train.sweep.command import CORES, PARENT, Command, Ended

if TYPE_CHECKING:
    from go1exp.train.sweep.index import Index
    from go1exp.train.sweep.task import Launcher, Task

LOG = "job.log"
"""In the run folder of a job that ran in a process of its own: what it printed."""


class Job(Protocol):
    """What a job's configuration stands for."""

    @property
    def run(self) -> Path:
        """Its run folder."""

    @property
    def container(self) -> dict[str, Any]:
        """Its configuration."""


@dataclass(frozen=True)
class Rules:
    """What a verb knows of its jobs.

    Attributes:
        app: the verb.
        folders: the user's folders of choices.
        resolve: ``(container, overrides, run folder) -> job``; raises ConfigError; touches no file.
        check: raises ConfigError, or another error that is an answer, if a job cannot run here.
        plan: makes the run folder of a job, unless it has begun.
        planned: ``(run folder, overrides) -> job`` of a folder that was made; raises ConfigError.
        go_on: ``(run folder, overrides) -> exit status``, runs it in this process.
    """

    app: App
    folders: Sequence[Path]
    resolve: Callable[[dict[str, Any], list[str], Path], Any]
    check: Callable[[Any], None]
    plan: Callable[[Any], None]
    planned: Callable[[Path, list[str]], Any]
    go_on: Callable[[Path, list[str]], int | None]


_current: list[Rules] = []


@contextmanager
def watched(rules: Rules) -> Iterator[None]:
    """Check and run the sweep that may begin in this block."""
    _current.append(rules)
    try:
        yield
    finally:
        _current.pop()


class Check(Callback):
    """Hydra's hook before a sweep (``hydra.callbacks`` in ``conf/train.yaml``)."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Leave Hydra with the list of jobs, unless another sweeper than Hydra's own will say which there are."""
        if not _current or not str(config.hydra.sweeper["_target_"]).endswith(f".{BasicSweeper.__name__}"):
            return
        try:
            listed = _overrides_of_jobs(config)
            launcher = _plain(config.hydra.launcher)
        except Exception as error:
            raise Refused(error) from None  # type: ignore[arg-type]
        rules, folder = _current[-1], Path(str(config.hydra.sweep.dir)).absolute()
        raise Left(lambda: begin(rules, folder, listed, launcher))


def leave_to_go_on(container: dict[str, Any], overrides: Sequence[str]) -> None:
    """Leave Hydra to go on with the sweep that ``sweep=FOLDER`` names."""
    about = HydraConfig.get()
    given = [o for o in about.overrides.hydra if re.match(r"[+~]*hydra[./]launcher", o)]
    launcher = _plain(about.launcher) if given else None
    rules, folder = _current[-1], Path(str(container["sweep"])).absolute()
    allowed = [o for o in overrides if not o.startswith("sweep=")]
    raise Left(lambda: go_on(rules, folder, allowed, launcher))


def begin(rules: Rules, folder: Path, listed: Sequence[list[str]], launcher: dict[str, Any]) -> int:
    """Check every job, write the sweep's folder, run the jobs; return the exit status.

    Raises:
        ConfigError: with every problem of every job, each with the first job that has it; then no folder is left.
    """
    from go1exp.train import run_state
    from go1exp.train.sweep import index, launchers

    runs = launchers.built(launchers.chosen(launcher))
    common = set.intersection(*map(set, listed)) if len(listed) > 1 else set()
    names = [" ".join(o for o in overrides if o not in common) for overrides in listed]
    places = index.folder_names(names)
    jobs = _checked(rules, folder, listed, names, places, runs)
    known = index.Index(
        tuple(
            index.Job(number, name, tuple(overrides), place)
            for number, (name, overrides, place) in enumerate(zip(names, listed, places, strict=True))
        ),
        launcher,
        os.getcwd(),
    )
    with run_state.locked(folder):
        if (folder / index.FILE).is_file():
            _refuse_another(index.read(folder), known, folder)
        show = spinner(len(jobs), "writing run folders")
        for number, job in enumerate(jobs):
            rules.plan(job)
            show(number + 1, len(jobs))
        return _launch(rules, folder, known, runs, [])


def go_on(rules: Rules, folder: Path, overrides: list[str], launcher: dict[str, Any] | None) -> int:
    """Run the jobs of a sweep that are not done; return the exit status.

    Args:
        rules: of the verb.
        folder: the sweep's.
        overrides: for every job; what a resumed run may change.
        launcher: None takes the one that ran the sweep last.

    Raises:
        ConfigError: if an override changes what it may not, or a job cannot run here.
        Expected: if there is no sweep in ``folder``.
    """
    from go1exp.train import run_state
    from go1exp.train.sweep import index, launchers

    known = index.read(folder)
    known = replace(known, launcher=launcher or known.launcher)
    runs = launchers.built(launchers.chosen(known.launcher))
    runs.check()
    problems: dict[str, list[int]] = {}
    with contextlib.chdir(known.cwd):
        for job in known.jobs:
            with _noting(rules.app, problems, job.number):
                planned = rules.planned(folder / job.run_folder, overrides)
                if not runs.remote and (job.state != "done" or _asks_for_more(overrides)):
                    rules.check(planned)
    _refuse(problems, [job.name for job in known.jobs])
    with run_state.locked(folder):
        return _launch(rules, folder, known, runs, overrides)


def _asks_for_more(overrides: Sequence[str]) -> bool:
    """Whether jobs that are done may have more to do."""
    return any(o.startswith("ppo.iterations=") for o in overrides)


def _checked(
    rules: Rules,
    folder: Path,
    listed: Sequence[list[str]],
    names: Sequence[str],
    places: Sequence[str],
    runs: Launcher,
) -> list[Any]:
    """Compose and check every job, and that the launcher can work."""
    jobs: list[Any] = []
    problems: dict[str, list[int]] = {}
    show = spinner(len(listed), "checking jobs")
    for number, (overrides, place) in enumerate(zip(listed, places, strict=True)):
        with _noting(rules.app, problems, number):
            container = compose(rules.app.name, [o for o in overrides if not _is_hydras(o)], rules.folders)
            if container.get("resume") or container.get("sweep"):
                raise ConfigError(["resume and sweep go without -m; of a sweep's jobs: sweep=FOLDER"])
            jobs.append(rules.resolve(container, overrides, folder / place))
        show(number + 1, len(listed))
    _refuse(problems, names)
    runs.check()
    checked: list[dict[str, Any]] = []
    for number, job in enumerate([] if runs.remote else jobs):
        about = {key: value for key, value in job.container.items() if key != "seed"}
        if about not in checked:  # a seed changes nothing that this machine could lack
            checked.append(about)
            with _noting(rules.app, problems, number):
                rules.check(job)
    _refuse(problems, names)
    return jobs


@contextmanager
def _noting(app: App, problems: dict[str, list[int]], number: int) -> Iterator[None]:
    """Collect what is wrong with a job."""
    try:
        yield
    except Exception as error:
        for line in error.problems if isinstance(error, ConfigError) else [app.cause(error)]:
            problems.setdefault(line, []).append(number)


def _refuse(problems: dict[str, list[int]], names: Sequence[str]) -> None:
    if problems:
        raise ConfigError([f"{line} ({_where(numbers, names)})" for line, numbers in problems.items()])


def _refuse_another(old: Index, new: Index, folder: Path) -> None:
    """Refuse to mix two sweeps in a folder; the same one again goes on."""
    if [job.name for job in old.jobs] != [job.name for job in new.jobs]:
        raise ConfigError(
            [
                f"{folder}: holds another sweep ({len(old.jobs)} jobs, the first of them {old.jobs[0].name!r}); use "
                f"another hydra.sweep.dir, or go on with it: {command('train', settings={'sweep': folder})}"
            ]
        )


class _Watch:
    """Keeps ``sweep.json`` as its jobs change, and says so."""

    def __init__(self, folder: Path, known: Index) -> None:
        self.folder, self.index = folder, known
        self.causes: dict[str, str] = {}
        self._warned = False

    def ended(self, task: Task, how: Ended) -> None:
        """Take down what a job said last, if it went wrong."""
        cause = re.sub(r"^go1exp train: ", "", how.cause)
        if cause and how.status != STOPPED:
            self.causes[task.run_folder] = cause
        self.changed()

    def changed(self) -> None:
        """Look at the run folders; write and tell what is new."""
        from go1exp.train.sweep import index

        now = index.looked_at(self.index, self.folder, self.causes)
        new = [job for job, old in zip(now.jobs, self.index.jobs, strict=True) if job.state != old.state]
        self.index = now
        if not new:
            return
        self.write()
        done = sum(job.state == "done" for job in now.jobs)
        for job in new:
            print(f"{done}/{len(now.jobs)} done  {job.state:8} {job.name or job.run_folder}", flush=True)

    def write(self) -> None:
        """Write the index; where that fails, the run folders know the same."""
        from go1exp.train.sweep import index

        try:
            index.write(self.folder, self.index)
        except OSError as error:
            if not self._warned:
                warnings.warn(f"sweep.json cannot be written ({error.strerror}); the jobs go on", stacklevel=2)
            self._warned = True


def _launch(rules: Rules, folder: Path, known: Index, runs: Launcher, overrides: list[str]) -> int:
    """Run what is not done in a folder that is locked; tell of the sweep; return the exit status."""
    from go1exp.train.sweep import index
    from go1exp.train.sweep.task import Task

    fresh = tuple(replace(job, state="waiting", cause="") for job in known.jobs)
    watch = _Watch(folder, index.looked_at(replace(known, jobs=fresh), folder))
    watch.write()
    tasks = []
    for job in watch.index.jobs:
        if job.state == "done" and not _asks_for_more(overrides):
            continue
        run = folder / job.run_folder
        given = [*overrides, *_share_of_cores(rules, run, known, runs)]
        tasks.append(
            Task(job.name, job.run_folder, _command(run, given, known.cwd), _in_process(rules, watch, job, given))
        )
    print(f"sweep {folder}: {len(tasks)} of {len(known.jobs)} jobs to run", flush=True)
    try:
        if tasks:
            runs.launch(folder, tasks, watch)
    finally:
        watch.changed()
        left = _report(watch.index, folder)
    return FAILED if left else 0


def _share_of_cores(rules: Rules, run: Path, known: Index, runs: Launcher) -> list[str]:
    """Return what gives a job elsewhere no more threads than cores: ``backend.threads=0`` takes all of a machine."""
    if not runs.remote:
        return []
    backend = rules.planned(run, []).container["backend"]
    cpus = known.launcher.get("cpus", 1)
    return [f"backend.threads={cpus}"] if (backend.get("name"), backend.get("threads")) == ("cpu", 0) else []


def _command(run: Path, overrides: Sequence[str], cwd: str) -> Command:
    """Return the command that a job is in a process of its own."""
    place = [f"resume={quoted(str(run))}", f"hydra.run.dir={quoted(str(run))}", "hydra.output_subdir=null"]
    words = (sys.executable, "-m", "go1exp.cli.child", PARENT, CORES, "train", *place, *overrides)
    path = os.environ.get("PYTHONPATH")
    return Command(words, cwd, str(run / LOG), {"PYTHONPATH": path} if path else {})


def _in_process(rules: Rules, watch: _Watch, job: Any, overrides: list[str]) -> Callable[[], None]:
    """Return what runs a job in this process and outlives its failure."""

    def work() -> None:
        try:
            with contextlib.chdir(watch.index.cwd):
                stopped = rules.go_on(watch.folder / job.run_folder, overrides) == STOPPED
        except Exception as error:
            rules.app.failed_in_sweep(error, job.number, job.name.split(" "))
            watch.causes[job.run_folder] = rules.app.cause(error)
            return
        if stopped:
            raise KeyboardInterrupt

    return work


def _report(known: Index, folder: Path) -> int:
    """Print what became of each job, and the command that goes on with what is left; return how many are."""
    kinds = [job.state for job in known.jobs]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(sorted(kinds)))
    print(f"\nsweep {folder}: {counts}")
    for job in known.jobs:
        print(f"{job.number:4}  {job.state:8}  {job.name}{f'  ({job.cause})' if job.cause else ''}")
    left = len(kinds) - kinds.count("done")
    if left:
        print(f"go on with: {command('train', settings={'sweep': folder})}", flush=True)
    return left


def _overrides_of_jobs(config: DictConfig) -> list[list[str]]:
    """Return the overrides of every job, as Hydra's own sweeper makes them.

    What the command line says of a key takes the place of what ``hydra.sweeper.params`` (a study) says of it.
    """
    params = config.hydra.sweeper.get("params") or {}
    given = OmegaConf.to_container(config.hydra.overrides.task)
    assert isinstance(given, list)
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    typed = parser.parse_overrides([str(override) for override in given])
    keys = {override.key_or_group for override in typed}
    listed = parser.parse_overrides([f"{key}={value}" for key, value in params.items()])
    parsed = [*(override for override in listed if override.key_or_group not in keys), *typed]
    return [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]


def _is_hydras(override: str) -> bool:
    return re.match(r"[+~]*hydra[./@]", override) is not None


def _plain(config: Any) -> dict[str, Any]:
    container = OmegaConf.to_container(config, resolve=True)
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


def _where(numbers: Sequence[int], names: Sequence[str]) -> str:
    """Say which jobs have a problem: the first of them, and how many more."""
    first = f"job {numbers[0]}: {names[numbers[0]]}" if names[numbers[0]] else f"job {numbers[0]}"
    return first if len(numbers) == 1 else f"{first}; and {len(numbers) - 1} more"
