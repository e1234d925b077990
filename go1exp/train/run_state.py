"""Lock and state of a run folder: who trains in it, and what became of the run (``state.json``).

One process at a time: two trainings would mix their rows and delete each other's checkpoints.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from filelock import BaseFileLock, FileLock, SoftFileLease, Timeout

from go1exp.base.errors import Expected
from go1exp.base.files import remove_partial, write_json

LOCK, LEASE, HOLDER = ".lock", ".lease", ".holder.json"
"""Files of a run folder: what the operating system locks, what stands in for it where it cannot, and who holds it."""

FILES = (LOCK, LEASE, HOLDER)

NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL}
"""What a file system answers that knows no locks (NFS without its lock daemon, some of FUSE and Lustre)."""

LEASE_S = 120.0
"""Where there are no locks: time without a sign of life after which the holder counts as dead, s."""


class RunInUse(Expected):
    """Another process trains in the folder; the message names host, process and since when."""


@contextmanager
def locked(run: Path) -> Iterator[None]:
    """Be the only one that trains in ``run``, which is made if it is not there.

    A lock of the operating system (``flock``, on NFS as well) ends with the process, however that ends; the file stays.
    What a killed process left half-written is deleted.

    Raises:
        RunInUse: if another process has it.
        OSError: if the folder cannot be written.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
        lock = _acquired(run)
    except OSError as error:
        raise OSError(error.errno, f"run folder cannot be written: {error.strerror}", str(run)) from error
    since = f"{datetime.now():%Y-%m-%d %H:%M:%S}"
    holder = {"host": socket.gethostname(), "pid": os.getpid(), "since": since}
    with lock:
        (run / HOLDER).write_text(json.dumps(holder) + "\n")
        remove_partial(run)
        remove_partial(run / "checkpoints")
        try:
            yield
        finally:
            (run / HOLDER).unlink(missing_ok=True)
            lock.release()


def in_use(run: Path) -> bool:
    """Whether a process trains in the folder now."""
    if not (run / LOCK).exists() and not (run / LEASE).exists():
        return False
    try:
        _acquired(run).release(force=True)
    except RunInUse:
        return True
    except OSError:  # a folder that this user can only read
        return False
    return False


def _acquired(run: Path) -> BaseFileLock:
    try:
        try:
            lock: BaseFileLock = FileLock(run / LOCK, timeout=0, preserve_lock_file=True)
            lock.acquire()
        except OSError as error:
            if isinstance(error, Timeout) or error.errno not in NO_LOCKS:
                raise
            warnings.warn(
                f"{run}: its file system has no locks; a lease that is extended every {LEASE_S / 3:.0f} s guards the "
                "folder instead, and that of a run that was killed on another computer counts for two minutes",
                stacklevel=3,
            )
            lock = SoftFileLease(run / LEASE, timeout=0, lease_duration=LEASE_S)
            lock.acquire()
    except Timeout:
        raise RunInUse(f"{run}: in use by {_described(run)}; wait for it, stop it, or use another folder") from None
    return lock


def _described(run: Path) -> str:
    """Say who holds the lock; the file is written just after the lock was taken, and may not be there yet."""
    try:
        holder = json.loads((run / HOLDER).read_text())
        return f"process {holder['pid']} on {holder['host']} since {holder['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process, which has just begun"


FILE = "state.json"
KILLED = "was killed"
"""Cause of what ended without a word."""

State = Literal["running", "done", "stopped", "failed", "not started"]


@dataclass(frozen=True)
class RunState:
    """A run's state, and why if it failed."""

    state: State
    cause: str = ""


def write(run: Path, state: State, cause: str = "") -> None:
    """Note the state; ``cause`` is the message of an error.

    Raises:
        OSError: if it cannot be written.
    """
    write_json(run / FILE, asdict(RunState(state, cause)))


def note_failure(run: Path, cause: str) -> None:
    """Note that a run failed, if that can be written: a full disk may be the cause itself."""
    with contextlib.suppress(OSError):
        write(run, "failed", cause)


def read(run: Path) -> RunState:
    """Return the state of a run; of one that was killed, which could not say so, ``failed``."""
    try:
        content = json.loads((run / FILE).read_text())
        known = RunState(content["state"], content["cause"])
    except (OSError, ValueError, KeyError, TypeError):
        return RunState("not started")
    if known.state == "running" and not in_use(run):
        return RunState("failed", KILLED)
    return known
