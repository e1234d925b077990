"""Recordings as they are named on the command line."""

from __future__ import annotations

import contextlib
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

    files: list[Path] = []
    for path in map(Path, [places] if isinstance(places, str) else places):
        inside = sorted(path.glob("*.parquet"))
        if path.is_dir() and not inside:
            raise RecordingError(f"{path}: no *.parquet in it")
        files += inside if path.is_dir() else [path]
    return files


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


def remove_empty(folder: Path) -> None:
    """Delete a folder for results that got none, and the folders above it that hold nothing else."""
    with contextlib.suppress(OSError):  # the first that is not empty
        for path in (folder, *folder.parents):
            path.rmdir()


def long_enough(recordings: list[Recording], least: float) -> list[Recording]:
    """Return the recordings of at least ``least`` s, and say which are left out.

    Raises:
        go1exp.recording.RecordingError: if there is none.
    """
    from go1exp.recording import RecordingError

    lengths = [float(r.t[-1] - r.t[0]) for r in recordings]
    short = [
        f"{r.meta.episode}: {len(r.t)} rows, {length:g} s: too short; windows take {least:g} s"
        for r, length in zip(recordings, lengths, strict=True)
        if length < least
    ]
    if len(short) == len(recordings):
        raise RecordingError("\n".join(short))
    for line in short:
        print(f"left out: {line}")
    return [r for r, length in zip(recordings, lengths, strict=True) if length >= least]


def read_all(places: str | Sequence[str]) -> list[Recording]:
    """Read the recordings of folders and files; raise RecordingError if one is missing or damaged."""
    from go1exp.recording import read

    return [read(path) for path in files_of(places)]
