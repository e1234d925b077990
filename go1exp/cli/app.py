"""What all verbs share: Hydra around a task function, and errors as one clean message."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from go1exp.cli import hydra_main, plugins
from go1exp.cli.files import choices_from_files
from go1exp.cli.quoting import protected
from go1exp.cli.verbs import FLAGS, VALUED
from go1exp.config.choices import CONFIG_DIR, given_folders
from go1exp.config.compose import as_hydra_takes_them, composition_problem
from go1exp.config.hydra_adapter import REFUSED
from go1exp.config.schema.registry import ConfigError, Expected

BAD_CONFIG, FAILED = 2, 1
"""Exit statuses: configuration refused before anything was built; the work failed. What a signal ended has
``go1exp.base.signals.STOPPED``."""


@dataclass(frozen=True)
class App:
    """One verb: ``conf/<name>.yaml`` and the function that gets the composed, resolved configuration.

    ``task`` returns an exit status, or None for 0. ConfigError, OSError and ``Expected`` are answers, not bugs: their
    message is printed without a traceback.
    """

    name: str
    task: Callable[[dict[str, Any]], int | None]
    title: str = ""
    """What users call it, where that is not its name."""
    sweep: Callable[[App, Sequence[Path], hydra_main.Sweep], int] | None = None
    """Runs a sweep: ``(verb, the user's folders, sweep) -> exit status``; None leaves sweeps to Hydra."""

    def run(self, arguments: Sequence[str]) -> int:
        """Run with command-line arguments; print errors; return the exit status."""
        wants_traceback = os.environ.get("HYDRA_FULL_ERROR") == "1"
        defer("torch")
        warnings.filterwarnings("ignore", message="The `render_mode` attribute is not defined")
        status: list[int | None] = []
        failure: list[Exception] = []

        def task(container: dict[str, Any]) -> None:
            try:
                status.append(self.task(plugins.begin(self.name, container)))
            except Exception as error:
                if hydra_main.in_multirun():
                    job = hydra_main.job()
                    status.append(self.failed_in_sweep(error, job.number, job.overrides))
                else:
                    failure.append(error)  # Hydra would print a report of its own

        title = f"go1exp {self.title or self.name}"
        formatwarning = warnings.formatwarning  # usually two lines, one of them of code
        warnings.formatwarning = lambda message, *rest, **keywords: f"{title}: warning: {message}\n"
        try:
            _refuse_stray_words(arguments, title)
            overrides, folders = _without_config_dir(choices_from_files(arguments, self.name))
            argv = [title, *map(protected, as_hydra_takes_them(overrides))]
            sweep = self.sweep
            on_sweep = None if sweep is None else lambda asked: sweep(self, folders, asked)
            status.append(hydra_main.run(self.name, argv, folders, task, on_sweep))
            if failure:
                raise failure[0]
            sys.stdout.flush()
        except BrokenPipeError:  # the command line's to answer
            raise
        except Exception as error:
            if wants_traceback:
                raise error from None
            code, message = self._explain(error, arguments)
            print(f"{title}: {message}", file=sys.stderr)
            return code
        finally:
            stop_bars()
            warnings.formatwarning = formatwarning
        return next((s for s in status if s), 0) or 0

    def failed_in_sweep(self, error: Exception, number: int, overrides: Sequence[str]) -> int:
        """Print what went wrong with a job of a sweep and return its status: the other jobs do not depend on it."""
        try:
            status, message = self._explain(error, overrides)
        except Exception:
            traceback.print_exc()
            status, message = FAILED, self.cause(error)
        name = f"go1exp {self.title or self.name}: job {number} ({' '.join(overrides)})"
        print(f"{name}: {message}", file=sys.stderr, flush=True)
        return status

    def cause(self, error: Exception) -> str:
        """Return what went wrong in one line, whatever it was."""
        try:
            message = self._explain(error, ())[1]
        except Exception:  # a bug: its kind says more than its message
            message = f"{type(error).__name__}: {error}"
        return " ".join(message.split())

    def _explain(self, error: Exception, arguments: Sequence[str]) -> tuple[int, str]:
        """Return exit status and message of an exception; re-raise what is a bug."""
        if isinstance(error, ConfigError):
            lines = error.problems
            return BAD_CONFIG, lines[0] if len(lines) == 1 else "\n  ".join([f"{len(lines)} problems", *lines])
        if isinstance(error, (*REFUSED, ValueError)):
            problem = composition_problem(error, self.name, arguments, given_folders(arguments)[1:])
            if problem:
                return BAD_CONFIG, problem
        if isinstance(error, OSError):
            return FAILED, f"{error.strerror}: {error.filename}" if error.strerror and error.filename else str(error)
        if isinstance(error, Expected):
            return FAILED, str(error)
        if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":  # the latter is torch's
            return FAILED, f"out of memory: {' '.join(str(error).split())}"
        raise error


MODES = ("--run", "-r", "--multirun", "-m", "--cfg", "-c", "--info", "-i")
"""Options of Hydra of which one may be given."""


def _refuse_stray_words(arguments: Sequence[str], title: str) -> None:
    """Raise ConfigError where Hydra's parsers would print their usage or a remark on grammar."""
    problems = []
    for before, word in zip(["", *arguments], arguments, strict=False):
        if before in VALUED:
            continue
        if word.startswith("-"):
            if word.partition("=")[0] not in (*VALUED, *FLAGS):
                problems.append(f"{word}: unknown option; see {title} --help")
        elif "=" not in word and not word.startswith("~"):
            problems.append(f"{word}: not a setting, which is key=value; see {title} --help")
    modes = [word for word in arguments if word.partition("=")[0] in MODES]
    if len(modes) > 1:
        problems.append(f"{' and '.join(modes)} cannot be used together: --cfg and --info show one run, without -m")
    if problems:
        raise ConfigError(problems)


def _without_config_dir(arguments: Sequence[str]) -> tuple[list[str], list[Path]]:
    """Return the arguments without ``--config-dir DIR``, and that folder: we show it to Hydra ourselves, filtered.

    Raises:
        ConfigError: if it is no folder.
    """
    folders = given_folders(arguments)[1:]
    if missing := [str(folder) for folder in folders if not folder.is_dir()]:
        raise ConfigError([f"--config-dir {folder}: no such folder" for folder in missing])
    rest = [
        word
        for before, word in zip(["", *arguments], arguments, strict=False)
        if before not in CONFIG_DIR and word.partition("=")[0] not in CONFIG_DIR
    ]
    return rest, folders


class _Deferred(ModuleType):
    """Stands for a module until something of it is used (``importlib.util.LazyLoader`` loads at the next import)."""

    def __getattr__(self, attribute: str) -> Any:
        if attribute == "__file__":  # inspect asks every module for it, as Hydra does to find its caller
            raise AttributeError(attribute)
        sys.modules.pop(self.__name__, None)
        real = importlib.import_module(self.__name__)
        self.__dict__.update(real.__dict__)
        return getattr(real, attribute)


def defer(name: str) -> None:
    """Make ``import name`` free: torch takes over a second, and a misspelt key should not wait for that."""
    sys.modules.setdefault(name, _Deferred(name))


def discard(run: Path, of_lock: Sequence[str] = ()) -> None:
    """Delete a run folder in which nothing ran: it holds no more than Hydra's notes, and the lock if that is ours."""
    if run.is_dir() and {p.name for p in run.iterdir()} <= {".hydra", "train.log", *of_lock}:
        shutil.rmtree(run)


_bars: list[Any] = []


def stop_bars() -> None:
    """End the bars that are still shown: one that an error leaves behind hides the terminal's cursor."""
    while _bars:
        _bars.pop().stop()


def spinner(total: int, what: str) -> Callable[[int, int], None]:
    """Return a callback ``(done, total)`` that shows a progress bar in a terminal and nothing elsewhere."""
    if not sys.stderr.isatty():
        return lambda done, total: None
    from rich.console import Console
    from rich.progress import Progress

    bar = Progress(console=Console(stderr=True), transient=True)
    task = bar.add_task(what, total=total)
    bar.start()
    _bars.append(bar)

    def update(done: int, total: int) -> None:
        bar.update(task, completed=done, total=total)
        if done >= total:
            bar.stop()

    return update
