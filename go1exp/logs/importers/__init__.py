"""Recordings of other tools and robots, converted to the format of ``go1exp.logs.recording``; one module a source.

An importer is ``f(path, *, options) -> list[Recording]``; ``path`` is a file of its source, or a folder of them. It
converts what the source measured, writes the known flaws of the source into ``notes``, and never invents a channel.
Importing the package registers every importer, from this explicit list.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from go1exp.config.schema.registry import ConfigError, find, members, unknown_name
from go1exp.logs.importers import (
    ak80_double_pendulum,
    csv,
    go1_walk_snippet,
    go2_in_air,
    mcap_joint_state,
    scaler_walk_mocap,
    servo_pendulum_xl330,
    so101_arm,
)
from go1exp.logs.recording import Recording

__all__ = [
    "ak80_double_pendulum",
    "csv",
    "go1_walk_snippet",
    "go2_in_air",
    "import_recordings",
    "mcap_joint_state",
    "scaler_walk_mocap",
    "servo_pendulum_xl330",
    "so101_arm",
]


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
