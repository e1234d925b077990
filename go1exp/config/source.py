"""Where Hydra finds configuration: ``conf/`` and a user's folder like it, each verb with its own groups only."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, ClassVar

import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigLoadError, ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf
from omegaconf._utils import get_yaml_loader

from go1exp.config.choices import FOLDERS, config_folder, folder_of, hidden_from


@cache
def _fast_loader() -> Any:
    """Return OmegaConf's YAML loader on libyaml's parser, a tenth of the time; as it is where there is no libyaml."""
    rules: Any = get_yaml_loader()
    if not hasattr(yaml, "CSafeLoader"):
        return rules

    class Loader(yaml.cyaml.CParser, rules):
        def __init__(self, stream: str) -> None:
            yaml.cyaml.CParser.__init__(self, stream)
            yaml.constructor.SafeConstructor.__init__(self)
            yaml.resolver.Resolver.__init__(self)

    return Loader


@lru_cache(maxsize=1024)
def _pickled(file: Path, mtime_ns: int, size: int) -> bytes:
    """Return a file's content and header, pickled; what a file holds is read once, as long as it does not change."""
    text = file.read_text(encoding="utf-8")
    try:
        content = yaml.load(text, Loader=_fast_loader())
    except yaml.YAMLError:
        content = 0
    config: Any
    if content is None or isinstance(content, dict | list | str):
        config = OmegaConf.create({} if content is None else content)
    else:
        config = OmegaConf.load(file)  # its words for what is wrong: they show the line
    return pickle.dumps((config, FileConfigSource._get_header_dict(text[:512])))


HYDRAS_OWN = ("hydra/launcher/basic",)
"""Choices that Hydra has itself; our file is for help and completion."""


class VerbSource(FileConfigSource):
    """Files of a folder without the groups that a verb does not have; the group ``rand`` is the folder of its files."""

    hidden: ClassVar[frozenset[str]] = frozenset()
    """Folders that sources made from now on do not show."""

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
        if path in HYDRAS_OWN:
            return None
        for group in (g for g in FOLDERS if "/" in g and (path == g or path.startswith(f"{g}/"))):
            return None if FOLDERS[group] in self._hidden else FOLDERS[group] + path.removeprefix(group)
        first, slash, rest = path.partition("/")
        if first in self._hidden or first in FOLDERS.values() or FOLDERS.get(first) in self._hidden:
            return None
        return folder_of(first, Path(self.path)).name + slash + rest if first else ""

    def load_config(self, config_path: str) -> ConfigResult:
        """Read one file, by its name in the group.

        Hydra changes what it gets, so each call gets a copy. Unpickling takes a thirtieth of the time of parsing.
        """
        place = self._place(config_path)
        name = self._normalize_file_name(config_path if place is None else place)
        file = Path(self.path, name).resolve()
        if not file.is_file():
            raise ConfigLoadError(f"Config not found : {file}")
        stamp = file.stat()
        config, header = pickle.loads(_pickled(file, stamp.st_mtime_ns, stamp.st_size))
        return ConfigResult(self.provider, f"{self.scheme()}://{self.path}", config, header)

    def is_group(self, config_path: str) -> bool:
        """Say whether there is a folder for the verb to see."""
        place = self._place(config_path)
        return place is not None and super().is_group(place)

    def is_config(self, config_path: str) -> bool:
        """Say whether there is a file for the verb to see."""
        place = self._place(config_path)
        return place is not None and super().is_config(place)

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Return the names below a group."""
        place = self._place(config_path)
        return [] if place is None else super().list(place, results_filter)


class _Folders(SearchPathPlugin):
    """Puts the folders on Hydra's search path."""

    folders: ClassVar[tuple[Path, ...]] = ()

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in self.folders:
            search_path.append("main" if folder == config_folder() else "user", f"{VerbSource.scheme()}://{folder}")


def shown_folders() -> tuple[Path, ...]:
    """Return ``conf/`` and the user's folders that Hydra looks into now."""
    return _Folders.folders or (config_folder(),)


@contextmanager
def seen_by(verb: str, folders: Sequence[Path] = ()) -> Iterator[None]:
    """Let Hydra find ``conf/`` and the user's ``folders`` as ``verb`` sees them, for what is set up meanwhile."""
    for plugin in (VerbSource, _Folders):
        Plugins.instance().register(plugin)
    before = VerbSource.hidden, _Folders.folders
    VerbSource.hidden, _Folders.folders = hidden_from(verb), (config_folder(), *folders)
    try:
        yield
    finally:
        VerbSource.hidden, _Folders.folders = before
