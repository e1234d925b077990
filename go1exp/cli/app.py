"""What all verbs share: Hydra around a task function, settings with their groups, errors as one clean message."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import go1exp.cli.hydra_main as hydra_main
from go1exp.base import errors
from go1exp.cli.hydra_main import choices_from_files
from go1exp.cli.verbs import FLAGS, MODULES, VALUED, protected
from go1exp.config.choices import CONFIG_DIR, choice_files, config_folder, given_folders, groups_in
from go1exp.config.compose import as_hydra_takes_them, composition_problem
from go1exp.config.hydra_adapter import REFUSED, forget_choices, plain, stored_choices
from go1exp.config.schema import plugins
from go1exp.config.schema import settings as schema
from go1exp.config.schema.registry import ConfigError, unknown_name


@dataclass(frozen=True)
class App:
    """One verb: ``conf/<name>.yaml`` and the function that gets the composed, resolved configuration.

    ``task`` returns an exit status, or None for 0; what it raises ends the command (``go1exp.base.errors``).
    """

    name: str
    task: Callable[[dict[str, object]], int | None]
    settings: type | None = None
    """Class of the settings that are no group's, for the help; None for ``train``, whose are in ``go1exp.sim.task``."""
    sweep: Callable[[App, Sequence[Path], hydra_main.Sweep], int] | None = None
    """Runs a sweep: ``(verb, the user's folders, sweep) -> exit status``; None leaves sweeps to Hydra."""

    @property
    def title(self) -> str:
        """What users call it."""
        return f"go1exp {self.name.replace('_', ' ')}"

    def run(self, arguments: Sequence[str]) -> int:
        """Run with arguments; return the exit status; raise ConfigError of wrong settings, and what the task raises."""
        warnings.filterwarnings("ignore", message="The `render_mode` attribute is not defined")
        status: list[int | None] = []
        failure: list[Exception] = []

        def task(config: Any) -> None:
            try:
                status.append(self.task(begin(self.name, self._plain(config))))
            except Exception as error:
                if hydra_main.in_multirun():
                    job = hydra_main.job()
                    status.append(self.failed_in_sweep(error, job.number, job.overrides))
                else:
                    failure.append(error)  # Hydra would print a report of its own

        formatwarning = warnings.formatwarning  # usually two lines, one of them of code
        warnings.formatwarning = lambda message, *rest, **keywords: f"{self.title}: warning: {message}\n"
        try:
            _refuse_stray_words(arguments, self.title)
            overrides, folders = _without_config_dir(choices_from_files(arguments, self.name))
            _refuse_unknown_schedule(overrides, folders)
            argv = [self.title, *map(protected, as_hydra_takes_them(overrides))]
            sweep = self.sweep
            on_sweep = None if sweep is None else lambda asked: sweep(self, folders, asked)
            status.append(hydra_main.run(self.name, argv, folders, task, on_sweep))
            if failure:
                raise failure[0]
        except Exception as error:
            refusal = self._as_refusal(error, arguments)
            if refusal is error:
                raise
            raise refusal from error
        finally:
            while _bars:  # one that an error leaves behind hides the terminal's cursor
                _bars.pop().stop()
            warnings.formatwarning = formatwarning
            forget_choices(groups_in(config_folder()))
        return next((s for s in status if s), 0) or 0

    def _plain(self, config: Any) -> dict[str, Any]:
        """Return the configuration with interpolations resolved; where one cannot be, no run folder stays."""
        try:
            return plain(config)
        except Exception:
            if self.name == "train":
                discard(hydra_main.output_folder())
            raise

    def failed_in_sweep(self, error: Exception, number: int, overrides: Sequence[str]) -> int:
        """Print what went wrong with a job of a sweep and return its status: the other jobs do not depend on it."""
        error = self._as_refusal(error, overrides)
        return errors.end(error, f"{self.title}: job {number} ({' '.join(overrides)})", explained)

    def cause(self, error: Exception, overrides: Sequence[str] = ()) -> str:
        """Return what went wrong in one line, whatever it was."""
        answer = explained(self._as_refusal(error, overrides))
        return " ".join((answer[1] if answer else f"{type(error).__name__}: {error}").split())

    def _as_refusal(self, error: Exception, arguments: Sequence[str]) -> Exception:
        """Return a ConfigError in place of an error that the arguments caused in Hydra; any other error as it is."""
        if isinstance(error, REFUSED) and not hasattr(error, "problems"):
            problem = composition_problem(error, self.name, arguments, given_folders(arguments)[1:])
            return ConfigError([problem]) if problem else error
        return error


def explained(error: BaseException) -> tuple[int, str] | None:
    """Return exit status and message of an error that is an answer, also of one in a user's plugin; None of others."""
    if answer := errors.explained(error):
        return answer
    library = os.environ.get("MUJOCO_GL")
    if library and any(f.filename.endswith("gl_context.py") for f in traceback.extract_tb(error.__traceback__)):
        return errors.REFUSED, f"MUJOCO_GL={library}: MuJoCo cannot load this GL library; leave the variable unset"
    if place := plugins.blamed(error):
        return errors.FAILED, f"{place}: {type(error).__name__}: {' '.join(str(error).split())}"
    return None


def app_of(verb: str) -> App:
    """Return a verb's application."""
    module = importlib.import_module(f"go1exp.cli.{MODULES.get(verb, verb)}")
    return next(app for app in vars(module).values() if isinstance(app, App) and app.name == verb)


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
        elif ("=" not in word and not word.startswith("~")) or word.lstrip("+").startswith("="):
            problems.append(f"{word}: not a setting, which is key=value; see {title} --help")
    modes = [word for word in arguments if word.partition("=")[0] in MODES]
    if len(modes) > 1:
        problems.append(f"{' and '.join(modes)} cannot be used together: --cfg and --info show one run, without -m")
    if problems:
        raise ConfigError(problems)


def _refuse_unknown_schedule(overrides: Sequence[str], folders: Sequence[Path]) -> None:
    """Raise ConfigError if a chosen schedule has no file; Hydra ignores that, as the group is optional."""
    for chosen in (o.partition("=")[2] for o in overrides if o.lstrip("+").startswith("schedule=")):
        known = choice_files("schedule", [config_folder(), *folders])
        taken = {*known, *stored_choices("schedule")}
        unknown = [name for name in chosen.split(",") if name not in taken and re.fullmatch(r"[\w/]+", name)]
        if unknown:
            raise ConfigError([unknown_name(f"schedule={unknown[0]}", unknown[0], known, "choice of schedule")])


def _without_config_dir(arguments: Sequence[str]) -> tuple[list[str], list[Path]]:
    """Return arguments without ``--config-dir DIR``, and DIR, which Hydra gets filtered; raise ConfigError if none."""
    folders = given_folders(arguments)[1:]
    if missing := [str(folder) for folder in folders if not folder.is_dir()]:
        raise ConfigError([f"--config-dir {folder}: no such folder" for folder in missing])
    rest = [
        word
        for before, word in zip(["", *arguments], arguments, strict=False)
        if before not in CONFIG_DIR and word.partition("=")[0] not in CONFIG_DIR
    ]
    return rest, folders


class _Nothing:
    """The class of nothing: as long as a module is not loaded, no object is of a class of it."""


class _Deferred(ModuleType):
    """Stands for a module until something of it is used (``importlib.util.LazyLoader`` loads at the next import)."""

    def __getattr__(self, attribute: str) -> Any:
        if attribute == "__file__":  # inspect asks every module for it, as Hydra does to find its caller
            raise AttributeError(attribute)
        if sys._getframe(1).f_code.co_name == "_issubclass_fast":  # scipy: is this array a torch.Tensor?
            return _Nothing
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

LINE_PERIOD = 5.0  # least time between two lines of progress when there is no terminal, s


def announce(what: str) -> None:
    """Print what begins where there is no terminal: libraries take seconds to load."""
    if not sys.stderr.isatty():
        print(f"{what} ...", file=sys.stderr, flush=True)


def spinner(total: int, what: str, at_once: bool = False) -> Callable[[int, int], None]:
    """Return a callback ``(done, total)``: a progress bar in a terminal, else lines, after a while or ``at_once``."""
    if at_once:
        announce(what)
    if not sys.stderr.isatty():
        printed_at = [time.monotonic()]

        def say(done: int, total: int) -> None:
            if done < total and time.monotonic() - printed_at[0] >= LINE_PERIOD:
                printed_at[0] = time.monotonic()
                print(f"{what}: {100 * done / total:.0f} %", file=sys.stderr, flush=True)

        return say
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


MEANING = "files and packages with terms of your own, such as [my_terms.py] (docs/extending.md)"
"""Of the key ``plugins``, for the help."""


def begin(verb: str, container: dict[str, object]) -> dict[str, Any]:
    """Load the plugins of a command line and its run; return the other settings; raise ConfigError if one fails."""
    if verb == "train":  # whose configuration is parsed with its plugins
        plugins.begin()
        return container
    wanted = plugins.names(container.get(plugins.KEY))
    plugins.begin(wanted)
    run = container.get("run")
    if isinstance(run, str) and (Path(run) / "config.yaml").is_file():
        from go1exp.train import run_folder

        plugins.use(run_folder.with_kept_plugins(Path(run), {})[plugins.KEY])
    return {key: value for key, value in container.items() if key != plugins.KEY}


T = TypeVar("T")

Reader = Callable[[Any], object]
"""Turns what stands under a key into what the verb works with; raises ConfigError."""


def parse_with_groups(
    kind: type[T], container: Mapping[str, object], groups: Sequence[str], **others: Reader
) -> tuple[T, dict[str, Any]]:
    """Return a verb's settings of class ``kind``, and by key what was read of its groups and further keys.

    ``groups`` are those of ``go1exp.sim.task``; ``others`` are functions that read further keys. Raise ConfigError with
    every problem of all of them.
    """
    from go1exp.sim.task import parse_parts

    parts, problems = parse_parts(container, tuple(groups))
    for key, read in others.items():
        try:
            parts[key] = read(container[key])
        except ConfigError as error:
            problems += error.problems
    try:
        separate = {*groups, *others} - {f.name for f in fields(kind)}  # type: ignore[arg-type]
        checked = parse(kind, {key: value for key, value in container.items() if key not in separate})
    except ConfigError as error:
        raise ConfigError([*problems, *error.problems]) from None
    if problems:
        raise ConfigError(problems)
    return checked, parts


EXAMPLES = {
    "space": """'space=["ppo.gamma=interval(0.97,0.995)"]'""",
    "run": "run=runs/NAME",
    "subjects": "go1exp compare clock paper protocol=kicks",
    "folders": "go1exp report runs/sweep_NAME",
    "files": "go1exp record audit recordings/NAME.parquet",
    "file": "go1exp export check runs/NAME/bundle.zip",
    "source": "go1exp record import go2_in_air PATH",
    "path": "go1exp record import go2_in_air PATH",
    "recordings": "recordings=recordings",
    "logs": "logs=recordings",
    "bundle": "go1exp deploy runs/NAME/bundle.zip",
}
"""Settings without a default, and how they are given."""


def parse(kind: type[T], container: Mapping[str, object]) -> T:
    """Validate a composed configuration as ``kind``; raise ConfigError with every problem."""
    return schema.parse(kind, container, EXAMPLES)
