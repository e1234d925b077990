"""Sweeps: every job is checked before the first one starts, run by a launcher, and reported after the last one.

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
from typing import TYPE_CHECKING, Any

from go1exp.base.errors import FAILED, STOPPED
from go1exp.cli import hydra_main
from go1exp.cli.app import App, spinner
from go1exp.cli.verbs import command, quoted
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.train.sweep.command import CORES, PARENT, Command, Ended

if TYPE_CHECKING:
    from go1exp.train.sweep import index
    from go1exp.train.sweep.command import Launcher, Task
    from go1exp.train.sweep.index import Index

LOG = "job.log"  # in the run folder of a job that ran in a process of its own: what it printed


@dataclass(frozen=True)
class Rules:
    """Functions of a verb for its jobs."""

    # ``(container, overrides, run folder) -> job``; raises ConfigError; touches no file
    resolve: Callable[[dict[str, Any], list[str], Path], Any]
    check: Callable[[Any], None]  # raises ConfigError, or another error that is an answer, if a job cannot run here
    plan: Callable[[Any], None]  # makes the run folder of a job, unless it has begun
    # ``(run folder, overrides) -> job`` of a folder that was made; raises ConfigError
    planned: Callable[[Path, list[str]], Any]
    # ``(run folder, overrides) -> exit status``, runs it in this process
    go_on: Callable[[Path, list[str]], int | None]


def leave_to_go_on(rules: Rules, app: App, folder: str, overrides: Sequence[str]) -> None:
    """Leave Hydra to go on with the sweep that ``sweep=FOLDER`` names."""
    about = hydra_main.job()
    given = any(re.match(r"[+~]*hydra[./]launcher", o) for o in about.of_hydra)
    launcher = about.launcher if given else None
    allowed = [o for o in overrides if not o.startswith("sweep=")]
    raise hydra_main.Left(lambda: go_on(rules, app, Path(folder).absolute(), allowed, launcher))


def begin(rules: Rules, app: App, folders: Sequence[Path], asked: hydra_main.Sweep) -> int:
    """Check every job, write the sweep's folder, run the jobs; return the exit status.

    Raise ConfigError with every problem of every job, each with the first job that has it; then no folder is left.
    """
    from go1exp.train import run_state
    from go1exp.train.sweep import index, launchers

    folder, listed = asked.folder, asked.jobs
    runs = launchers.built(launchers.chosen(asked.launcher))
    common = set.intersection(*map(set, listed)) if len(listed) > 1 else set()
    names = [" ".join(o for o in overrides if o not in common) for overrides in listed]
    planned = [
        index.Job(number, name, tuple(overrides), place)
        for number, (name, overrides, place) in enumerate(zip(names, listed, index.folder_names(names), strict=True))
    ]
    jobs = _checked(rules, app, folders, folder, planned, runs)
    known = index.Index(tuple(planned), asked.launcher, os.getcwd())
    with run_state.locked(folder):
        if (folder / index.FILE).is_file():
            _refuse_another(index.read(folder), known, folder)
        show = spinner(len(jobs), "writing run folders")
        for number, job in enumerate(jobs):
            rules.plan(job)
            show(number + 1, len(jobs))
        return _launch(rules, app, folder, known, runs, [])


def go_on(rules: Rules, app: App, folder: Path, overrides: list[str], launcher: dict[str, Any] | None) -> int:
    """Run the jobs of a sweep that are not done; return the exit status.

    ``overrides`` are for every job; ``launcher`` None takes the one that ran the sweep last. Raise ConfigError if an
    override changes what it may not, or a job cannot run here, and Expected without a sweep in ``folder``.
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
            with _noting(app, problems, job.number):
                planned = rules.planned(folder / job.run_folder, overrides)
                if not runs.remote and (job.state != "done" or _asks_for_more(overrides)):
                    rules.check(planned)
    _refuse(problems, [job.name for job in known.jobs])
    with run_state.locked(folder):
        return _launch(rules, app, folder, known, runs, overrides)


def _asks_for_more(overrides: Sequence[str]) -> bool:
    """Whether jobs that are done may have more to do."""
    return any(o.startswith("ppo.iterations=") for o in overrides)


def _checked(
    rules: Rules, app: App, folders: Sequence[Path], folder: Path, planned: Sequence[index.Job], runs: Launcher
) -> list[Any]:
    jobs: list[Any] = []
    problems: dict[str, list[int]] = {}
    names = [job.name for job in planned]
    show = spinner(len(planned), "checking jobs")
    for number, job in enumerate(planned):
        with _noting(app, problems, number, job.overrides):
            ours = [o for o in job.overrides if not re.match(r"[+~]*hydra[./@]", o)]
            container = compose(app.name, ours, folders)
            if container.get("resume") or container.get("sweep"):
                raise ConfigError(["resume and sweep go without -m; of a sweep's jobs: sweep=FOLDER"])
            jobs.append(rules.resolve(container, list(job.overrides), folder / job.run_folder))
        show(number + 1, len(planned))
    _refuse(problems, names)
    runs.check()
    checked: set[str] = set()  # as text: to compare each with all others takes an hour for the largest sweep
    for number, job in enumerate([] if runs.remote else jobs):
        about = repr({key: value for key, value in job.container.items() if key != "seed"})
        if about not in checked:  # a seed changes no requirement on this machine
            checked.add(about)
            with _noting(app, problems, number):
                rules.check(job)
    _refuse(problems, names)
    return jobs


@contextmanager
def _noting(app: App, problems: dict[str, list[int]], number: int, overrides: Sequence[str] = ()) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        for line in error.problems if isinstance(error, ConfigError) else [app.cause(error, overrides)]:
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
    """Updates ``sweep.json`` as its jobs change, and prints the changes."""

    def __init__(self, folder: Path, known: Index) -> None:
        self.folder, self.index = folder, known
        self.causes: dict[str, str] = {}
        self._warned = False

    def ended(self, task: Task, how: Ended) -> None:
        """Keep the last message of a job that failed."""
        cause = re.sub(r"^go1exp train: ", "", how.cause)
        if cause and how.status != STOPPED:
            self.causes[task.run_folder] = cause
        self.changed()

    def changed(self) -> None:
        """Look at the run folders; write and print what is new."""
        from go1exp.train.sweep import index

        now = index.looked_at(self.index, self.folder, self.causes)
        new = [job for job, old in zip(now.jobs, self.index.jobs, strict=True) if job.state != old.state]
        self.index = now
        if not new:
            return
        self.write()
        done = sum(job.state == "done" for job in now.jobs)
        for job in new:
            print(f"[{done}/{len(now.jobs)} done] {job.state:8} {job.name or job.run_folder}", flush=True)

    def write(self) -> None:
        """Write the index; where that fails, the run folders know the same."""
        from go1exp.train.sweep import index

        try:
            index.write(self.folder, self.index)
        except OSError as error:
            if not self._warned:
                warnings.warn(f"sweep.json cannot be written ({error.strerror}); the jobs go on", stacklevel=2)
            self._warned = True


def _launch(rules: Rules, app: App, folder: Path, known: Index, runs: Launcher, overrides: list[str]) -> int:
    """Run what is not done in a folder that is locked; report on the sweep; return the exit status."""
    from go1exp.train.sweep import index
    from go1exp.train.sweep.command import Task

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
            Task(job.name, job.run_folder, _command(run, given, known.cwd), _in_process(rules, app, watch, job, given))
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
    place = [f"resume={quoted(str(run))}", f"hydra.run.dir={quoted(str(run))}", "hydra.output_subdir=null"]
    words = (sys.executable, "-m", "go1exp.cli.child", PARENT, CORES, "train", *place, *overrides)
    path = os.environ.get("PYTHONPATH")
    return Command(words, cwd, str(run / LOG), {"PYTHONPATH": path} if path else {})


def _in_process(rules: Rules, app: App, watch: _Watch, job: index.Job, overrides: list[str]) -> Callable[[], None]:
    """Return what runs a job in this process and outlives its failure."""

    def work() -> None:
        try:
            with contextlib.chdir(watch.index.cwd):
                stopped = rules.go_on(watch.folder / job.run_folder, overrides) == STOPPED
        except Exception as error:
            app.failed_in_sweep(error, job.number, job.name.split(" "))
            watch.causes[job.run_folder] = app.cause(error)
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


def _where(numbers: Sequence[int], names: Sequence[str]) -> str:
    """Return which jobs have a problem: the first of them, and how many more."""
    first = f"job {numbers[0]}: {names[numbers[0]]}" if names[numbers[0]] else f"job {numbers[0]}"
    return first if len(numbers) == 1 else f"{first}; and {len(numbers) - 1} more"
