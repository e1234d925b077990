"""What a test session asks for hundreds of times, and computes once: merged files, checks of a recording."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.importlib_resources_config_source import ImportlibResourcesConfigSource
from hydra.core.config_store import ConfigStore

from go1exp.config.hydra_adapter import VerbSource, _stamps
from go1exp.logs.audit import checks
from go1exp.logs.recording import Recording

OWN = frozenset(ConfigStore.instance().repo)
"""Names of Hydra's own nodes; others come from a user's file, for one command."""

merge, choices_of = ConfigLoaderImpl._compose_config_from_defaults_list, defaults_list._create_interpolation_map
read_packaged = ImportlibResourcesConfigSource.load_config
kept: dict[tuple[Any, ...], bytes] = {}


def copied(key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
    """Return a copy of what ``make`` returned when it was called for this key first."""
    if key not in kept:
        kept[key] = pickle.dumps(make())
    return pickle.loads(kept[key])


def packaged_once(self: ImportlibResourcesConfigSource, config_path: str) -> Any:
    """Return a copy of a file that Hydra brings along."""
    return copied((self.path, config_path), lambda: read_packaged(self, config_path))


def merged_once(self: ConfigLoaderImpl, defaults: Sequence[Any], repo: Any) -> Any:
    """Return a copy of what Hydra merges of the same unchanged files; overrides of values come after it."""
    if not OWN.issuperset(ConfigStore.instance().repo):
        return merge(self, list(defaults), repo)
    sources = tuple((source.scheme(), source.path) for source in repo.get_sources())
    state = tuple(_stamps(path) for scheme, path in sources if scheme in ("file", VerbSource.scheme()))
    return copied((repr(defaults), sources, state), lambda: merge(self, list(defaults), repo))


def choices_where_needed(overrides: Any, listed: Sequence[Any], *rest: Any) -> Any:
    """Return Hydra's map of choices for ``${...}`` in a defaults list; of a list without any, nobody reads it."""
    return choices_of(overrides, list(listed), *rest) if any(d.is_interpolation() for d in listed) else None


def of_a_recording(check: Callable[[Any], Any], recording_of: Callable[[Any], Recording]) -> Callable[[Any], Any]:
    """Return ``check`` with its answers kept by the content of the recording; nobody writes into an answer."""
    kept: dict[bytes, Any] = {}

    def once(about: Any) -> Any:
        recording = recording_of(about)
        content = hashlib.blake2b(repr(recording.meta).encode())
        for name, values in recording.channels.items():
            content.update(f"{name} {values.dtype} {values.shape}".encode())
            content.update(np.ascontiguousarray(values).data)
        key = content.digest()
        if key not in kept:
            kept[key] = check(about)
        return kept[key]

    return once


def install() -> None:
    """Let this process work so."""
    ConfigLoaderImpl._compose_config_from_defaults_list = merged_once  # type: ignore[method-assign]
    ImportlibResourcesConfigSource.load_config = packaged_once  # type: ignore[method-assign]
    defaults_list._create_interpolation_map = choices_where_needed  # type: ignore[assignment]
    checks._run_checks = of_a_recording(checks._run_checks, lambda log: log.recording)  # type: ignore[assignment]
