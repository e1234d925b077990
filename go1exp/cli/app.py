"""What all verbs share: Hydra around a task function, and errors as one clean message."""

from __future__ import annotations

import importlib
import os
import re
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
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from go1exp.cli import plugins
from go1exp.cli.files import choices_from_files
from go1exp.compose import as_container, config_folder, flat_keys, register_groups
from go1exp.schema.registry import ConfigError, Expected, nearest, unknown_name

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
        own_traceback = before == "1"
        os.environ["HYDRA_FULL_ERROR"] = "1"
        defer("torch")
        warnings.filterwarnings("ignore", message="The `render_mode` attribute is not defined")
        register_groups()
        status: list[int | None] = []
        failure: list[Exception] = []

        def task(config: DictConfig) -> None:
            try:
                status.append(self.task(plugins.begin(self.name, as_container(config))))
            except Exception as error:
                if HydraConfig.get().mode == RunMode.MULTIRUN:
                    raise  # the launcher, which may sit on another machine, has to know
                failure.append(error)  # Hydra would print a report of its own

        version = {"version_base": "1.3"} if hydra.__version__ < "1.4" else {}
        # Tab completion is installed for the program, whichever verb serves it.
        title = f"go1exp {self.title or self.name}"
        try:
            sys.argv = ["go1exp" if "-sc" in arguments else title, *choices_from_files(arguments)]
            hydra.main(**version, config_path=config_folder(), config_name=self.name)(task)()
            if failure:
                raise failure[0]
            sys.stdout.flush()
        except BrokenPipeError:  # who read our output has left, as `| head` does
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return READER_LEFT
        except Exception as error:
            if own_traceback:
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
        if isinstance(error, MissingConfigException):
            return BAD_CONFIG, _missing_choice(error)
        if isinstance(error, ValueError) and "override must be a string" in str(error):
            bad = next((a for a in arguments if _is_group(a.split("=")[0]) and not _is_choice(a)), "a group")
            return BAD_CONFIG, f"{bad}: a group takes the name of one of its files, such as reward=paper"
        if isinstance(error, HydraException | OmegaConfBaseException):
            return BAD_CONFIG, self._bad_override(error, arguments)
        if isinstance(error, OSError):
            return FAILED, f"{error.strerror}: {error.filename}" if error.strerror and error.filename else str(error)
        if isinstance(error, Expected):
            return FAILED, str(error)
        raise error

    def _bad_override(self, error: Exception, arguments: Sequence[str]) -> str:
        """Name the key that Hydra refused, the value, and the nearest keys that exist."""
        text = str(error)
        match = re.search(r"Could not (?:override|append to config|delete from config)[^']*'([^']+)'", text)
        if not match:
            cause = error.__cause__ or error
            return " ".join(line.strip() for line in str(cause).splitlines() if line.strip())
        key = match.group(1)
        given = next((a for a in arguments if a.lstrip("+~").split("=")[0].split("@")[0] == key), key)
        groups = [a for a in arguments if re.match(r"[a-z_]+=[a-z]", a) and a != given]
        try:
            known = [k for k in flat_keys(self.name, groups) if k != key]
        except Exception:  # one of the others is wrong too
            known = [k for k in flat_keys(self.name) if k != key]
        close = nearest(key, known) or nearest(key.rsplit(".", 1)[-1], known)
        hint = f"did you mean {' or '.join(repr(c) for c in close)}?" if close else "see go1exp list"
        return f"{given}: no such key {key!r}; {hint}"


def _folder(group: str) -> Path:
    return Path(config_folder()) / ("randomization" if group == "rand" else group)


def _is_group(name: str) -> bool:
    return bool(name) and _folder(name).is_dir()


def _is_choice(argument: str) -> bool:
    group, _, choice = argument.partition("=")
    return (_folder(group) / f"{choice}.yaml").is_file()


def _missing_choice(error: MissingConfigException) -> str:
    """Name the group, the choice that it does not have, and the nearest that it has."""
    group, _, choice = (error.missing_cfg_file or "").partition("/")
    folder = _folder(group)
    if not choice or not folder.is_dir():
        return str(error).split("\n")[0]
    known = [p.relative_to(folder).with_suffix("").as_posix() for p in folder.rglob("*.yaml")]
    return unknown_name(f"{group}={choice}", choice, known, f"choice of {group}")


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
