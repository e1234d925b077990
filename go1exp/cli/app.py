"""What all verbs share: Hydra around a task function, and errors as one clean message."""

from __future__ import annotations

import importlib
import os
import shutil
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from go1exp.choices import CONFIG_DIR, given_folders
from go1exp.cli import FLAGS, VALUED
from go1exp.cli.files import choices_from_files
from go1exp.cli.quoting import protected
from go1exp.compose import as_container, composition_problem
from go1exp.config_source import seen_by
from go1exp.schema.registry import ConfigError, Expected

BAD_CONFIG, FAILED, STOPPED, READER_LEFT = 2, 1, 130, 141
"""Exit statuses: configuration refused before anything was built; the work failed; a signal ended it (the last: that of
a closed pipe, 128 + 13 as shells count)."""


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
                status.append(self.task(as_container(config)))
            except Exception as error:
                if HydraConfig.get().mode == RunMode.MULTIRUN:
                    raise  # the launcher, which may sit on another machine, has to know
                failure.append(error)  # Hydra would print a report of its own

        version = {"version_base": "1.3"} if hydra.__version__ < "1.4" else {}
        title = f"go1exp {self.title or self.name}"
        try:
            _refuse_stray_words(arguments, title)
            overrides, folders = _without_config_dir(choices_from_files(arguments, self.name))
            sys.argv = [title, *map(protected, overrides)]
            with seen_by(self.name, folders):
                hydra.main(**version, config_path=None, config_name=self.name)(task)()
            if failure:
                raise failure[0]
            sys.stdout.flush()
        except BrokenPipeError:  # who read our output has left, as `| head` does
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return READER_LEFT
        except Exception as error:
            if wants_traceback:
                raise
            code, message = self._explain(error, arguments)
            print(f"{title}: {message}", file=sys.stderr)
            return code
        finally:
            if before is None:
                os.environ.pop("HYDRA_FULL_ERROR", None)
        return next((s for s in status if s), 0) or 0

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
        raise error


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


def discard(run: Path) -> None:
    """Delete a run folder in which nothing ran: it holds no more than Hydra's notes."""
    if run.is_dir() and {p.name for p in run.iterdir()} <= {".hydra", "train.log"}:
        shutil.rmtree(run)


def spinner(total: int, what: str) -> Callable[[int, int], None]:
    """Return a callback ``(done, total)`` that shows a progress bar in a terminal and nothing elsewhere."""
    if not sys.stderr.isatty():
        return lambda done, total: None
    from rich.console import Console
    from rich.progress import Progress

    bar = Progress(console=Console(stderr=True), transient=True)
    task = bar.add_task(what, total=total)
    bar.start()

    def update(done: int, total: int) -> None:
        bar.update(task, completed=done, total=total)
        if done >= total:
            bar.stop()

    return update
