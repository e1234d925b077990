"""A job of a sweep as a command in a process of its own, and what a launcher gets and reports.

The standard library alone: Ray carries this module by value to workers that need not find the package.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

UNSAID = "ended without a word"

LONGEST = 4096
"""Bytes of the end of an output that are kept for its last line."""

PARENT = "{parent}"
"""Word of a command that becomes the id of the process that starts it."""

CORES = "{cores}"
"""Word of a command that becomes the numbers of its cores; nothing where it may use all."""


@dataclass(frozen=True)
class Command:
    """What to run.

    Attributes:
        words: the interpreter, its options, the module, and the arguments; ``PARENT`` and ``CORES`` stand for what is
            known later.
        cwd: folder to run it from.
        log: file that its output is appended to.
        variables: environment variables beside those that are there.
        cores: numbers of the cores that it may use; none for all.
    """

    words: tuple[str, ...]
    cwd: str
    log: str
    variables: dict[str, str] = field(default_factory=dict)
    cores: tuple[int, ...] = ()


@dataclass(frozen=True)
class Ended:
    """How a process ended: its exit status (negative: the signal) and the last line that it printed."""

    status: int
    last_line: str

    @property
    def cause(self) -> str:
        """What to tell of it where its run folder says nothing; empty if nothing went wrong."""
        if self.status == 0:
            return ""
        killed = f"killed by {signal.Signals(-self.status).name}" if self.status < 0 else ""
        return killed or self.last_line or f"{UNSAID}, with status {self.status}"


class Running:
    """A process that was started, in a session of its own: a Ctrl-C in the terminal is the launcher's to hear."""

    def __init__(self, command: Command) -> None:
        self._command = command
        known = {PARENT: str(os.getpid()), CORES: ",".join(map(str, command.cores))}
        words = [known.get(word, word) for word in command.words]
        self.process = subprocess.Popen(
            words,
            cwd=command.cwd,
            env={**os.environ, **command.variables},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            bufsize=0,
        )
        self._end = b""

    def wait(self) -> Ended:
        """Copy what it prints to the log until it ends; a log that cannot be written ends nothing."""
        assert self.process.stdout is not None
        with self.process.stdout:
            self._copy()
        return Ended(self.process.wait(), self._end.decode(errors="replace").strip().rpartition("\n")[2].strip())

    def outlast(self) -> None:
        """Wait until it has ended, also inside a signal's handler: ``Popen.wait`` holds a lock meanwhile."""
        self._copy()
        with contextlib.suppress(ChildProcessError):
            os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOWAIT)

    def _copy(self) -> None:
        """Copy its output to its end. Without buffers, so that a signal's handler can go on where it interrupted."""
        assert self.process.stdout is not None
        with _log(self._command.log) as log, contextlib.suppress(OSError):
            while part := os.read(self.process.stdout.fileno(), 65536):
                self._end = (self._end + part)[-LONGEST:]
                with contextlib.suppress(OSError):
                    os.write(log, part)

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Ask it to end with a checkpoint (SIGTERM), or end it (SIGKILL)."""
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(number)


@contextlib.contextmanager
def _log(path: str) -> Iterator[int]:
    try:
        log = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    except OSError:
        log = os.open(os.devnull, os.O_WRONLY)
    try:
        yield log
    finally:
        os.close(log)


def run(command: Command) -> Ended:
    """Run a job's command to its end; at an exception meanwhile (Ctrl-C), stop it and wait for its checkpoint."""
    running = Running(command)
    try:
        return running.wait()
    except BaseException:
        running.stop()
        running.outlast()
        raise


@dataclass(frozen=True)
class Task:
    """A job to run.

    Attributes:
        name: what tells it from the others.
        run_folder: relative to the sweep's folder.
        command: in a process of its own.
        in_process: in this process; returns when it is done, raises KeyboardInterrupt when a person stopped it.
    """

    name: str
    run_folder: str
    command: Command
    in_process: Callable[[], None]


class Watch(Protocol):
    """What a launcher tells of its jobs."""

    def changed(self) -> None:
        """Some job may have begun or ended: the index is written anew."""

    def ended(self, task: Task, how: Ended) -> None:
        """A job's process has ended."""


class Launcher(Protocol):
    """Runs jobs until none is left that can run."""

    remote: bool
    """Whether jobs run on other machines: what is missing on this one does not matter."""

    def check(self) -> None:
        """Refuse what cannot work, before anything is written; raise ConfigError or ``Expected``."""

    def launch(self, folder: Path, tasks: Sequence[Task], watch: Watch) -> None:
        """Run the tasks of the sweep in ``folder``.

        Raises:
            KeyboardInterrupt: after a person stopped it; what ran has saved a checkpoint, or goes on elsewhere.
            go1exp.base.errors.Expected: if the cluster is not there, or leaves.
        """
