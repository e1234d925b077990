"""Recordings as they are named on the command line."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from go1exp.schema.registry import ConfigError

if TYPE_CHECKING:
    from go1exp.recording import Recording


def files_of(places: str | Sequence[str]) -> list[Path]:
    """Return the recordings' files of a folder or file, or of several.

    Raises:
        go1exp.recording.RecordingError: if a folder has none.
    """
    from go1exp.recording import RecordingError

    found: list[Path] = []
    for path in map(Path, [places] if isinstance(places, str) else places):
        inside = sorted(path.glob("*.parquet"))
        if path.is_dir() and not inside:
            raise RecordingError(f"{path}: no *.parquet in it")
        found += inside if path.is_dir() else [path]
    return found


def writable(folder: str, key: str = "out") -> Path:
    """Make a folder for results and return it, before the work begins.

    Raises:
        ConfigError: if nothing can be written there.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise ConfigError([f"{key} = {folder!r}: cannot be written to ({error.strerror})"]) from None
    return path


def read_all(places: str | Sequence[str]) -> list[Recording]:
    """Read the recordings of folders and files; raise RecordingError if one is missing or damaged."""
    from go1exp.recording import read

    return [read(path) for path in files_of(places)]
