"""What all verbs share: Hydra around a task function, and errors as one clean message."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import hydra
from hydra._internal.hydra import Hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from go1exp.cli import plugins
from go1exp.cli.files import choices_from_files
from go1exp.cli.quoting import protected
from go1exp.cli.verbs import FLAGS, VALUED
from go1exp.config.choices import CONFIG_DIR, given_folders
from go1exp.config.compose import as_container, as_hydra_takes_them, composition_problem
from go1exp.config.schema.registry import ConfigError, Expected
from go1exp.config.source import seen_by

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

    def run(self, arguments: Sequence[str]) -> int:
        """Run with command-line arguments; print errors; return the exit status."""
        # Hydra would print its own report and leave; this makes it raise to here instead.
        before = os.environ.get("HYDRA_FULL_ERROR")
        wants_traceback = before == "1"
        os.environ["HYDRA_FULL_ERROR"] = "1"
        defer("torch")
        warnings.filterwarnings("ignore", message="The `render_mode` attribute is not defined")
        status: list[int | None] = []
        failure: list[Exception] = []

        def task(config: DictConfig) -> None:
            try:
                status.append(self.task(plugins.begin(self.name, as_container(config))))
            except Exception as error:
                if HydraConfig.get().mode == RunMode.MULTIRUN:
                    about = HydraConfig.get()
                    status.append(self.failed_in_sweep(error, about.job.num, list(about.overrides.task)))
                else:
                    failure.append(error)  # Hydra would print a report of its own

        title = f"go1exp {self.title or self.name}"
        formatwarning = warnings.formatwarning  # usually two lines, one of them of code
        warnings.formatwarning = lambda message, *rest, **keywords: f"{title}: warning: {message}\n"
        try:
            _refuse_stray_words(arguments, title)
            overrides, folders = _without_config_dir(choices_from_files(arguments, self.name))
            sys.argv = [title, *map(protected, as_hydra_takes_them(overrides))]
            with seen_by(self.name, folders), _composed_once(overrides, folders):
                self._under_hydra(task, status)
            if failure:
                raise failure[0]
            sys.stdout.flush()
        except BrokenPipeError:  # the command line's to answer
            raise
        except (Exception, Refused) as caught:
            error = caught.error if isinstance(caught, Refused) else caught
            if wants_traceback:
                raise error from None
            code, message = self._explain(error, arguments)
            print(f"{title}: {message}", file=sys.stderr)
            return code
        finally:
            stop_bars()
            warnings.formatwarning = formatwarning
            if before is None:
                os.environ.pop("HYDRA_FULL_ERROR", None)
        return next((s for s in status if s), 0) or 0

    def _under_hydra(self, task: Callable[[DictConfig], None], status: list[int | None]) -> None:
        """Have Hydra compose and call ``task``, and do the work for which that leaves Hydra."""
        version = {"version_base": "1.3"} if hydra.__version__ < "1.4" else {}
        try:
            hydra.main(**version, config_path=None, config_name=self.name)(task)()
        except Left as left:
            status.append(left.work())

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
        if isinstance(error, HydraException | OmegaConfBaseException | ValueError):
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


@contextmanager
def _composed_once(overrides: Sequence[str], folders: Sequence[Path]) -> Iterator[None]:
    """Spare a third of the time of starting: Hydra composes everything twice, first only to read ``hydra.mode``.

    None of our files sets it, so that Hydra goes by ``--multirun``, as it does for None. Where an override or a user's
    file may set it, Hydra looks.
    """
    before = Hydra.get_mode
    if not folders and not any(re.match(r"-(?!m$|-multirun$)|[+~]*hydra(\.mode|[/=@])", o) for o in overrides):
        Hydra.get_mode = lambda self, config_name, overrides: None  # type: ignore[method-assign]
    try:
        yield
    finally:
        Hydra.get_mode = before  # type: ignore[method-assign]


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


class Refused(BaseException):
    """Carries a refusal out of Hydra's callbacks, which turn every ``Exception`` into a warning."""

    def __init__(self, error: ConfigError) -> None:
        super().__init__(str(error))
        self.error = error


class Left(BaseException):
    """Leaves Hydra for work that it has no part in; its callbacks would turn an ``Exception`` into a warning."""

    def __init__(self, work: Callable[[], int | None]) -> None:
        super().__init__()
        self.work = work


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


def run_dir() -> Path:
    """Return the folder that Hydra gave to this job."""
    return Path(HydraConfig.get().runtime.output_dir)


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
