"""Files that are whole or not there: each is written beside its name and takes it when it is complete and on the disk.

A full disk, a signal or a crash in the middle leaves the older file, if there was one. This module imports nothing of
the package, for the robot's computer uses it too.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

PARTIAL = ".partial"
"""Last part of the name of a file that is being written."""


@contextlib.contextmanager
def replacing(path: str | Path, keep_suffix: bool = False) -> Iterator[Path]:
    """Give the name of a file beside ``path`` to write to; it becomes ``path`` when the block ends without an error.

    A link is followed. What is no plain file (a pipe, ``/dev/stdout``) is written directly: it cannot be replaced.

    Args:
        path: the file.
        keep_suffix: let the name beside it end as ``path`` does, for writers that take the format from that.

    Raises:
        OSError: if it cannot be written; the message names ``path``.
    """
    given = Path(path)
    if given.exists() and not given.is_file() and not given.is_dir():  # a pipe's link leads to no name: not resolved
        yield given
        return
    final = given.resolve()
    partial = _beside(final, keep_suffix)
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, final)
    except OSError as error:
        if error.filename is None or Path(os.fsdecode(error.filename)) == partial:
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()


@contextlib.contextmanager
def opened(path: str | Path) -> Iterator[IO[bytes]]:
    """Open a binary file that becomes ``path`` when the block ends without an error (see ``replacing``)."""
    with replacing(path) as partial, partial.open("wb") as file:
        yield file
        file.flush()


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write a whole file (see ``replacing``)."""
    with opened(path) as file:
        file.write(data)


def write_text(path: str | Path, text: str) -> None:
    """Write a whole file of UTF-8 text (see ``replacing``)."""
    write_bytes(path, text.encode())


def write_json(path: str | Path, content: object, **options: Any) -> None:
    """Write a whole JSON file (see ``replacing``); ``options`` go to ``json.dumps``."""
    write_text(path, json.dumps(content, **{"indent": 2, **options}) + "\n")


def remove_partial(folder: Path) -> None:
    """Delete what a killed process left half-written in ``folder``, of which the caller must be the only writer."""
    for file in folder.glob(f"*{PARTIAL}"):
        with contextlib.suppress(OSError):
            file.unlink()


def _beside(final: Path, keep_suffix: bool) -> Path:
    """Return a name of its own for every writer: two that write one file at a time do not mix."""
    name = f"{final.name}.{secrets.token_hex(4)}{PARTIAL}"
    return final.with_name(name + final.suffix if keep_suffix else name)
