"""A verb as a Hydra application: its command line, its jobs, and the work for which Hydra is left."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, RangeSweep
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from go1exp.base.wording import NOT_FOR_TRAINING
from go1exp.config.choices import UNREADABLE, choice_files, config_folder, groups_in, groups_of, why_unreadable
from go1exp.config.hydra_adapter import (
    MAIN,
    composed_once,
    jobs_of_sweep,
    plain,
    read_yaml,
    seen_by,
    store_choice,
    stored_choices,
)
from go1exp.config.schema.registry import ConfigError


class Left(BaseException):
    """Leaves Hydra for work that it has no part in; its callbacks would turn an ``Exception`` into a warning."""

    def __init__(self, work: Callable[[], int | None]) -> None:
        super().__init__()
        self.work = work


@dataclass(frozen=True)
class Sweep:
    """A requested sweep."""

    folder: Path  # of the sweep
    jobs: list[list[str]]  # overrides of each job
    launcher: dict[str, Any]  # ``hydra.launcher``, as plain data


@dataclass(frozen=True)
class Job:
    """The job that is running."""

    folder: Path  # run folder
    multirun: bool  # whether it is one of several
    number: int  # among them
    overrides: list[str]  # of the configuration, as given
    of_hydra: list[str]  # overrides of Hydra's own configuration
    study: str | None  # chosen study that lists values to sweep over, if there is one
    launcher: dict[str, Any]  # ``hydra.launcher``, as plain data


def output_folder() -> Path:
    """Return the folder of the job that is running."""
    return Path(HydraConfig.get().runtime.output_dir)


def overrides() -> list[str]:
    """Return what the command line of the running job changes; nothing outside of a job."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def job() -> Job:
    """Return the job that is running."""
    about = HydraConfig.get()
    multirun = about.mode == RunMode.MULTIRUN
    return Job(
        output_folder(),
        multirun,
        about.job.num if multirun else 0,
        overrides(),
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

    def on_multirun_start(self, config: DictConfig, **kwargs: object) -> None:
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
    task: Callable[[DictConfig], None],
    on_sweep: Callable[[Sweep], int | None] | None = None,
) -> int | None:
    """Compose ``conf/<verb>.yaml`` with Hydra's command line and call ``task`` with each job's configuration.

    ``argv`` are title and arguments, ``folders`` the user's folders of choices; ``task`` must not raise. ``on_sweep``
    runs a sweep in place of Hydra's sweeper. Return the exit status of work for which Hydra was left, None if it was
    not left.
    """
    before = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises, in place of a report and an exit
    sys.argv = list(argv)
    _on_sweep[:] = [on_sweep] if on_sweep else []
    try:
        with seen_by(verb, folders), composed_once(argv[1:], folders):
            hydra.main(**MAIN, config_path=None, config_name=verb)(task)()
    except Left as left:
        return left.work()
    finally:
        if before is None:
            os.environ.pop("HYDRA_FULL_ERROR", None)
    return None


def sweep_range(text: str) -> tuple[str, dict[str, Any]]:
    """Return key and range (low, high, step, log) or choices of a sweep's override; raise ValueError if it is none."""
    try:
        (override,) = OverridesParser.create().parse_overrides([text])
    except HydraException as error:
        raise ValueError(text) from error
    value = override.value()
    if isinstance(value, IntervalSweep) and value.start is not None and value.end is not None:
        return override.key_or_group, {"low": value.start, "high": value.end, "log": "log" in value.tags}
    if isinstance(value, RangeSweep) and isinstance(value.start, int) and isinstance(value.stop, int):
        return override.key_or_group, {"low": value.start, "high": value.stop - 1, "step": int(value.step)}
    if isinstance(value, ChoiceSweep):
        return override.key_or_group, {"choices": tuple(override.sweep_string_iterator())}
    raise ValueError(text)


PATHS = {"model": "mjcf"}
"""Group -> key of its files that names another file, from where the file itself lies."""

GROUP_IS_FILE = re.compile(r"^(?P<add>\+?)(?P<group>[a-z_]+)=(?P<value>\[?.*\.ya?ml\b.*)$")


ITEM = re.compile(r"'(?:\\.|[^'])*'|\"(?:\\.|[^\"])*\"|[^\[\],]+")
"""One name or path of a list, with the quotes round it."""


def choices_from_files(arguments: Sequence[str], verb: str) -> list[str]:
    """Return the arguments with every ``group=FILE.yaml`` turned into a choice that Hydra knows.

    A list may mix files and names: ``effect=[mine.yaml,payload]``. Quotes round a path are taken off. Raise ConfigError
    with every file that is missing, empty, no YAML or no mapping, and every choice that is there twice.
    """
    chosen: list[str] = []
    problems: list[str] = []
    for argument in arguments:
        group, _, value = argument.lstrip("+").partition("=")
        lists = re.findall(r"\[[^\]]*", value) if group in groups_of(verb) else []  # of a sweep there are several
        for items in ([item.strip() for item in ITEM.findall(one[1:])] for one in lists):
            problems.extend(f"{argument}: {item} is chosen twice" for item, n in Counter(items).items() if n > 1)
        match = GROUP_IS_FILE.match(argument)
        group = match["group"] if match else ""
        if match is None or not (group in groups_of(verb) or (match["add"] and group in groups_in(config_folder()))):
            chosen.append(argument)
            continue

        def name_of(item: re.Match[str], group: str = group) -> str:
            file = item[0].strip()
            if file[:1] in ("'", '"'):
                file = re.sub(r"\\(.)", r"\1", file[1:-1])
            if not re.search(r"\.ya?ml$", file):
                return item[0]
            try:
                return _choice(group, file, verb)
            except ConfigError as error:
                problems.extend(error.problems)
                return ""

        chosen.append(f"{match['add']}{group}={ITEM.sub(name_of, match['value'])}")
    if problems:
        raise ConfigError(problems)
    return chosen


def _choice(group: str, file: str, verb: str) -> str:
    """Make a file a choice of ``group`` and return its name there; warn if ``verb`` is what the file is not for."""
    path, key = Path(file).expanduser(), f"{group}={file}"
    none = "none" in choice_files(group, [config_folder()])
    content = _mapping(
        path,
        key,
        f"without any, use {group}=none" if none else "it must describe one",
        f"as the files of conf/{group} are",
    )
    if verb == "train" and NOT_FOR_TRAINING in path.read_text(encoding="utf-8").partition("\n")[0]:
        warnings.warn(f"{key}: not for training, as its first line says; effect.yaml beside it is", stacklevel=2)
    named = content.get(PATHS.get(group, ""))
    if isinstance(named, str):
        content[PATHS[group]] = str((path.parent / named).resolve())
    name = _free_name(group, path)
    store_choice(group, name, content, path)
    return name


def mapping_of(given: Mapping[str, Any] | str | None, key: str) -> dict[str, Any]:
    """Return a setting that is a mapping or its ``FILE.yaml``, {} for None; raise ConfigError of a bad file."""
    if given is None:
        return {}
    if not isinstance(given, str):
        return dict(given)
    path = Path(given).expanduser()
    content = _mapping(
        path, f"{key}={given}", f"without any, leave {key} out", "or a FILE.yaml that holds one", resolve=True
    )
    return {str(k): v for k, v in content.items()}


def _mapping(path: Path, key: str, when_empty: str, like: str, resolve: bool = False) -> dict[str, Any]:
    """Return what a YAML file holds; raise ConfigError, beginning with ``key``, if that is no mapping."""
    if not path.exists():
        raise ConfigError([f"{key}: no such file"])
    try:
        content = read_yaml(path, resolve)
        lines = path.read_text(encoding="utf-8").splitlines()
    except UNREADABLE as error:
        raise ConfigError([f"{key}: {why_unreadable(error)}"]) from None
    if not any(line.strip() and not line.lstrip().startswith("#") for line in lines):
        raise ConfigError([f"{key}: is empty; {when_empty}"])
    # OmegaConf takes a file that is one text, such as XML, for a key without a value.
    if not isinstance(content, dict) or isinstance(yaml.safe_load("\n".join(lines)), str):
        raise ConfigError([f"{key}: must be a mapping, {like}"])
    return content


def _free_name(group: str, path: Path) -> str:
    """Return a name for a file that no choice of the group has: Hydra would silently take that in place of the file."""
    name = re.sub(r"\W", "_", str(path.with_suffix("")), flags=re.ASCII)  # else Hydra's grammar refuses it
    shipped = choice_files(group, [config_folder()])
    stored = stored_choices(group)
    parser = OverridesParser.create()  # a name such as 1 or null is none to Hydra
    while (
        name in shipped
        or stored.get(name, str(path)) != str(path)
        or not isinstance(parser.parse_override(f"{group}={name}").value(), str)
    ):
        name += "_file"
    return name
