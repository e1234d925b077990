"""Recordings of other tools and robots, converted to the format of ``go1exp.logs.recording``.

An importer is ``f(path, *, options) -> list[Recording]``; ``path`` is a file of its source, or a folder of them. It
converts what the source measured, writes the known flaws of the source into ``notes``, and never invents a channel.
Importing the package registers every importer, from this explicit list.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from go1exp.config.schema.registry import ConfigError, find, members, unknown_name
from go1exp.logs.importers import csv, published, ros, scaler_walk_mocap
from go1exp.logs.recording import Recording, RecordingError

__all__ = ["csv", "import_recordings", "published", "ros", "scaler_walk_mocap"]


def import_recordings(name: str, path: Path, options: Mapping[str, Any]) -> list[Recording]:
    """Read recordings of another source.

    Args:
        name: a registered importer.
        path: a file of that source, or a folder that holds some.
        options: values of the importer's options; the others keep their defaults.

    Raises:
        ConfigError: if there is no such importer, or it has no such option or value.
        RecordingError: if a file is missing or damaged, or lacks data.
    """
    entry = find("importer", name)
    if entry is None:
        raise ConfigError([unknown_name("importer", name, members("importer"), "importer")])
    values, problems = entry.check(options, f"importer.{name}")
    if problems:
        raise ConfigError(problems)
    return _named_apart(Path(path), entry.target(Path(path), **values))


def _named_apart(path: Path, recordings: list[Recording]) -> list[Recording]:
    """Return recordings named apart by the folders of their files; RecordingError, with the files, if that fails."""
    names = Counter(r.meta.episode for r in recordings)
    result = []
    for r in recordings:
        name = r.meta.episode
        folders: tuple[str, ...] = ()
        if names[name] > 1 and r.origin is not None and path.is_dir():
            folders = r.origin.parent.relative_to(path).parts
        note = f"Called {name} in the source, as others are." if folders else ""
        meta = replace(r.meta, episode="_".join((*folders, name)), notes=" ".join(filter(None, (r.meta.notes, note))))
        result.append(replace(r, meta=meta))
    for name, times in Counter(r.meta.episode for r in result).items():
        if times > 1:
            origins = ", ".join(str(r.origin) for r in result if r.meta.episode == name)
            raise RecordingError(f"{path}: {times} recordings would be called {name}; rename a file of {origins}")
    return result
