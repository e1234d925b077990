"""Recordings of other tools and robots, converted to the format of ``go1exp.logs.recording``.

An importer is ``f(path, *, options) -> list[Recording]``; ``path`` is a file of its source, or a folder of them. It
converts what the source measured, writes the known flaws of the source into ``notes``, and never invents a channel.
Importing the package registers every importer, from this explicit list.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from go1exp.config.schema.registry import ConfigError, find, members, unknown_name
from go1exp.logs.importers import arms, csv, mcap_joint_state, quadrupeds, scaler_walk_mocap
from go1exp.logs.recording import Recording

__all__ = ["arms", "csv", "import_recordings", "mcap_joint_state", "quadrupeds", "scaler_walk_mocap"]


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
    recordings: list[Recording] = entry.target(Path(path), **values)
    return recordings
