"""Hydra and OmegaConf behind plain data; private names of them are here alone.

Tested with hydra-core 1.3.8 (omegaconf 2.3) and 1.4.0rc3 (omegaconf 2.4). Private names in use: ``Hydra.get_mode``,
``Hydra.create_main_hydra2``, ``ConfigLoaderImpl._apply_overrides_to_config``, ``FileConfigSource``, ``BasicSweeper``,
``get_yaml_loader``.
"""

from __future__ import annotations

import math
import os
import pickle
import re
import traceback
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, Literal

import hydra
import yaml
from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.plugins.config_source import ConfigLoadError, ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.basecontainer import get_yaml_loader
from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

from go1exp.config.choices import (
    FOLDERS,
    UNREADABLE,
    config_folder,
    folder_of,
    groups_of,
    hidden_from,
    loaded,
    why_unreadable,
)
from go1exp.config.schema.registry import ConfigError

OLD = hydra.__version__ < "1.4"

MAIN: dict[str, Any] = (
    {"version_base": "1.3"} if OLD else {"execution_whitelist": ("go1exp.*", "hydra.*", "hydra_plugins.*")}
)
"""Arguments of ``hydra.main`` that depend on its version."""

REFUSED = (HydraException, OmegaConfBaseException, RecursionError, TypeError, ValueError)
"""What composing raises where an override or a file does not fit."""

GRAMMAR = re.compile(r"See https://hydra\.cc/docs/\S+/basic for details")
"""Link at the end of Hydra's messages on a value."""

# ---------------------------------------------------------------------- YAML and containers


def read_yaml(file: Path, resolve: bool = False) -> Any:
    """Return the content of a YAML file as plain data, ``1e3`` a number, as OmegaConf does; raise ``UNREADABLE``."""
    return OmegaConf.to_container(OmegaConf.create(loaded(file.read_text("utf-8"), get_yaml_loader())), resolve=resolve)


def to_yaml(container: Mapping[str, object]) -> str:
    """Return plain data as the text of a YAML file."""
    return OmegaConf.to_yaml(OmegaConf.create(dict(container)))


def with_values(container: Mapping[str, object], settings: Sequence[str]) -> dict[str, Any]:
    """Return plain data with ``key.path=value`` settings merged into it."""
    config = OmegaConf.create(dict(container))
    config.merge_with_dotlist(list(settings))
    return plain(config, resolve=False)


def plain(config: DictConfig, resolve: bool = True) -> dict[str, Any]:
    """Return a mapping of OmegaConf as plain data, by default with interpolations resolved."""
    container = OmegaConf.to_container(config, resolve=resolve)
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


# ---------------------------------------------------------------------- sources of configuration


@cache
def _fast_loader() -> Any:
    """Return OmegaConf's YAML loader on libyaml's parser, which takes a tenth of the time, where there is libyaml."""
    rules: Any = get_yaml_loader()
    if not hasattr(yaml, "CSafeLoader") or issubclass(rules, yaml.CSafeLoader):
        return rules

    class Loader(yaml.cyaml.CParser, rules):
        def __init__(self, stream: str) -> None:
            yaml.cyaml.CParser.__init__(self, stream)
            yaml.constructor.SafeConstructor.__init__(self)
            yaml.resolver.Resolver.__init__(self)

    return Loader


@lru_cache(maxsize=1024)
def _pickled(file: Path, mtime_ns: int, size: int) -> bytes:
    """Return a file's content and header, pickled, as long as the file does not change."""
    try:
        config = OmegaConf.create(loaded(text := file.read_text("utf-8"), _fast_loader()))
    except UNREADABLE as error:
        raise ConfigError([f"{file}: {why_unreadable(error)}"]) from None
    return pickle.dumps((config, FileConfigSource._get_header_dict(text[:512])))


class VerbSource(FileConfigSource):
    """Files of a folder without the groups that a verb does not have; the group ``rand`` is the folder of its files."""

    hidden: ClassVar[frozenset[str]] = frozenset()
    """Folders that sources made from now on do not show."""
    last: ClassVar[Path | None] = None
    """File that was read last."""

    def __init__(self, provider: str, path: str) -> None:
        super().__init__(provider, path)
        self._hidden = type(self).hidden  # of the instance: a launcher may carry it to another process

    @staticmethod
    def scheme() -> str:
        """Return what stands before ``://`` in a search path."""
        return "go1exp"

    def _place(self, config_path: str) -> str | None:
        """Return where a configuration lies below the folder; None if the verb does not see it."""
        path = config_path.strip("/")
        if path == "hydra/launcher/basic":  # Hydra's own; our file is for help and completion
            return None
        for group in (g for g in FOLDERS if "/" in g and (path == g or path.startswith(f"{g}/"))):
            return None if FOLDERS[group] in self._hidden else FOLDERS[group] + path.removeprefix(group)
        first, slash, rest = path.partition("/")
        if first in self._hidden or first in FOLDERS.values() or FOLDERS.get(first) in self._hidden:
            return None
        return folder_of(first, Path(self.path)).name + slash + rest if first else ""

    def load_config(self, config_path: str) -> ConfigResult:
        """Read one file, by its name in the group; each call returns a copy, since Hydra changes what it gets."""
        place = self._place(config_path)
        name = self._normalize_file_name(config_path if place is None else place)
        file = Path(self.path, name).resolve()
        if not file.is_file():
            raise ConfigLoadError(f"Config not found : {file}")
        VerbSource.last = file
        stamp = file.stat()
        config, header = pickle.loads(_pickled(file, stamp.st_mtime_ns, stamp.st_size))
        return ConfigResult(self.provider, f"{self.scheme()}://{self.path}", config, header)

    def is_group(self, config_path: str) -> bool:
        """Return whether there is a folder for the verb to see."""
        place = self._place(config_path)
        return place is not None and super().is_group(place)

    def is_config(self, config_path: str) -> bool:
        """Return whether there is a file for the verb to see."""
        place = self._place(config_path)
        return place is not None and super().is_config(place)

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Return the names below a group."""
        place = self._place(config_path)
        return [] if place is None else super().list(place, results_filter)


class _Folders(SearchPathPlugin):
    folders: ClassVar[tuple[Path, ...]] = ()

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in self.folders:
            search_path.append("main" if folder == config_folder() else "user", f"{VerbSource.scheme()}://{folder}")


def shown_folders() -> tuple[Path, ...]:
    """Return ``conf/`` and the user's folders that Hydra looks into now."""
    return _Folders.folders or (config_folder(),)


@contextmanager
def seen_by(verb: str, folders: Sequence[Path]) -> Iterator[None]:
    """Let Hydra find ``conf/`` and the user's ``folders`` with the groups of ``verb``."""
    for plugin in (VerbSource, _Folders):
        Plugins.instance().register(plugin)
    before = VerbSource.hidden, _Folders.folders
    VerbSource.hidden, _Folders.folders = hidden_from(verb), (config_folder(), *folders)
    try:
        yield
    finally:
        VerbSource.hidden, _Folders.folders = before


def store_choice(group: str, name: str, content: object, file: Path) -> None:
    """Make the content of a user's file a choice of a group."""
    replace: dict[str, Any] = {} if OLD else {"replace": True}
    ConfigStore.instance().store(group=group, name=name, node=content, provider=str(file), **replace)


def forget_choices(groups: Iterable[str]) -> None:
    """Forget the choices that were made of users' files: another verb may have a setting with a group's name."""
    for group in groups:
        ConfigStore.instance().repo.pop(group, None)


def stored_choices(group: str) -> dict[str, str]:
    """Return the choices of a group that were made of users' files, each with its file."""
    stored = ConfigStore.instance().repo.get(group, {})
    return {name.removesuffix(".yaml"): str(getattr(node, "provider", "")) for name, node in stored.items()}


# ---------------------------------------------------------------------- composition


@contextmanager
def hydra_for(verb: str, folders: Sequence[Path] = ()) -> Iterator[None]:
    """Set Hydra up for what ``conf/<verb>.yaml`` may choose from, with a user's ``folders`` of further choices."""
    GlobalHydra.instance().clear()
    with seen_by(verb, folders):
        if OLD:
            version.setbase("1.3")
        # hydra.initialize would first look through the call stack for a folder
        Hydra.create_main_hydra2("go1exp", create_config_search_path(None))
        try:
            yield
        finally:
            GlobalHydra.instance().clear()


def composed(verb: str, overrides: Sequence[str], folders: Sequence[Path] = (), resolve: bool = True) -> dict[str, Any]:
    """Return ``conf/<verb>.yaml`` composed with overrides, as plain data.

    The chosen files are composed once and kept; other values are set on a copy, in a tenth of the time.
    """
    with hydra_for(verb, folders):
        try:
            choices, values = _parsed(overrides)
            if not any(_needs_hydra(o) for o in (*choices, *values)):
                config = _with_choices(verb, choices, tuple(folders))
                ConfigLoaderImpl._apply_overrides_to_config(values, config)
                return plain(config, resolve)
        except REFUSED:
            pass  # the message is that of a whole composition
        return plain(hydra.compose(verb, list(overrides)), resolve)


def _parsed(overrides: Sequence[str]) -> tuple[list[Override], list[Override]]:
    """Return the overrides that choose a group's file, and those that set a value; Hydra must be set up."""
    is_group = GlobalHydra.instance().config_loader().repository.group_exists  # type: ignore[attr-defined]
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    return [o for o in parsed if is_group(o.key_or_group)], [o for o in parsed if not is_group(o.key_or_group)]


def _needs_hydra(o: Override) -> bool:
    """Return whether an override is a sweep, sets a package or Hydra itself, or names a user's file."""
    if o.is_sweep_override() or o.package or re.match(r"hydra(\.|/|$)", o.key_or_group):
        return True
    value, stored = o.value(), stored_choices(o.key_or_group)
    return any(isinstance(n, str) and n in stored for n in (value if isinstance(value, list) else [value]))


def _with_choices(verb: str, choices: Sequence[Override], folders: tuple[Path, ...]) -> DictConfig:
    state = tuple(_stamps(folder) for folder in (config_folder(), *folders))
    return pickle.loads(_kept(verb, tuple(str(o.input_line) for o in choices), folders, state))


@lru_cache(maxsize=64)
def _kept(verb: str, choices: tuple[str, ...], folders: tuple[Path, ...], state: tuple[object, ...]) -> bytes:
    """Return ``conf/<verb>.yaml`` with choices, pickled; ``state`` is that of the files it may be made of."""
    return pickle.dumps(hydra.compose(verb, list(choices)))


def _stamps(folder: str | Path) -> tuple[tuple[str, int, int], ...]:
    stamps = []
    for top, _, names in os.walk(folder, followlinks=True):
        for file in (os.path.join(top, name) for name in names):
            stat = os.stat(file)
            stamps.append((file, stat.st_mtime_ns, stat.st_size))
    return tuple(sorted(stamps))


@dataclass(frozen=True)
class Refusal:
    """Why a composition was refused; the subject is ``group/choice``, an override or a key, the text is Hydra's.

    Of kind choice: a group has no such file; key: no such key; present: an added key exists; type: a number or a
    mapping for a group.
    """

    kind: Literal["choice", "grammar", "key", "present", "type", "other"]
    subject: str
    text: str = ""


def refusal(error: Exception, verb: str, overrides: Sequence[str], folders: Sequence[Path]) -> Refusal | None:
    """Return why ``overrides`` of ``conf/<verb>.yaml`` were refused with ``error``; None if they were not."""
    if isinstance(error, MissingConfigException):
        return Refusal("choice", error.missing_cfg_file or "", str(error).split("\n")[0])
    if isinstance(error, OverrideParseException):
        return Refusal("grammar", error.override)
    if isinstance(error, RecursionError):
        in_defaults = any(f.filename.endswith("defaults_list.py") for f in traceback.extract_tb(error.__traceback__))
        return Refusal("other", "", f"{VerbSource.last}: its defaults lead back to itself") if in_defaults else None
    if not isinstance(error, REFUSED):
        return None
    with suppress(*REFUSED), hydra_for(verb, folders):
        if culprit := _culprit(verb, overrides, tuple(folders)):
            return culprit
    if not isinstance(error, HydraException | OmegaConfBaseException):
        return None
    if isinstance(error, InterpolationResolutionError):
        why = str(error.msg or error).partition("while resolving interpolation: ")[2].partition("\n")[0].strip("'\"")
        return Refusal("other", "", f"{error.full_key}: {why or str(error).partition(chr(10))[0]}")
    return Refusal("other", "", " ".join(GRAMMAR.sub("", str(error.__cause__ or error)).split()))


def _culprit(verb: str, overrides: Sequence[str], folders: tuple[Path, ...]) -> Refusal | None:
    choices, values = _parsed(overrides)
    for o in choices:
        chosen = o.value()
        named = chosen if isinstance(chosen, list) else [chosen]
        if not o.is_delete() and not all(isinstance(name, str) for name in named):
            return Refusal("type", str(o.input_line))
        if o.key_or_group not in groups_of(verb) and not (o.is_add() or o.is_force_add() or o.is_sweep_override()):
            return Refusal("key", o.key_or_group)
    config = _with_choices(verb, [o for o in choices if not _needs_hydra(o)], folders)
    for o in values:
        if o.package or o.is_sweep_override() or o.key_or_group.startswith("hydra."):  # Hydra's own, not in ``config``
            continue
        exists = False
        with suppress(OmegaConfBaseException):  # a word as the index of a list
            exists = OmegaConf.select(config, o.key_or_group, throw_on_missing=False) is not None
        try:
            ConfigLoaderImpl._apply_overrides_to_config([o], config)
        except REFUSED as error:
            if o.is_add() and exists:
                return Refusal("present", o.key_or_group)
            no_index = not isinstance(error, HydraException | OmegaConfBaseException)
            missing = isinstance(error.__cause__, AttributeError | KeyError | IndexError)
            if no_index or missing or (o.is_delete() and not exists):
                return Refusal("key", getattr(error.__cause__ if exists else None, "full_key", None) or o.key_or_group)
            return None
    return None


# ---------------------------------------------------------------------- runs and sweeps


@contextmanager
def composed_once(words: Sequence[str], folders: Sequence[Path]) -> Iterator[None]:
    """Spare a third of the time of starting: Hydra composes everything a first time only to read ``hydra.mode``.

    None of our files sets it. Where an option, an override or a user's file may set it, Hydra looks.
    """
    before = Hydra.get_mode
    if not folders and not any(re.match(r"-(?!m$|-multirun$)|[+~]*hydra(\.mode|[/=@])", word) for word in words):
        Hydra.get_mode = lambda *arguments, **keywords: None  # type: ignore[method-assign]
    try:
        yield
    finally:
        Hydra.get_mode = before  # type: ignore[method-assign]


MOST_JOBS = 10_000
"""Jobs of the largest sweep: each is composed and checked, in about 10 ms, before the first one starts."""


def jobs_of_sweep(config: DictConfig) -> list[list[str]] | None:
    """Return the overrides of every job, as Hydra's own sweeper makes them; None if another sweeper decides.

    A key on the command line replaces that of ``hydra.sweeper.params``. Raises ConfigError beyond ``MOST_JOBS``.
    """
    if not str(config.hydra.sweeper["_target_"]).endswith(f".{BasicSweeper.__name__}"):
        return None
    params = config.hydra.sweeper.get("params") or {}
    parser = OverridesParser.create(config_loader=GlobalHydra.instance().config_loader())
    typed = parser.parse_overrides([str(override) for override in config.hydra.overrides.task])
    keys = {override.key_or_group for override in typed}
    listed = parser.parse_overrides([f"{key}={value}" for key, value in params.items()])
    parsed = [*(override for override in listed if override.key_or_group not in keys), *typed]
    swept = {o.input_line: o.sweep_string_iterator() for o in parsed if o.is_sweep_override()}
    counts = {line: sum(1 for _ in islice(values, MOST_JOBS + 1)) for line, values in swept.items()}
    if math.prod(counts.values()) > MOST_JOBS:
        raise ConfigError([f"{max(counts, key=counts.__getitem__)}: a sweep has at most {MOST_JOBS:,} jobs"])
    return [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]
