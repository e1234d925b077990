"""What ends a process from outside: Ctrl-C, SIGTERM, and SIGHUP, which the end of a terminal or of a login sends."""

from __future__ import annotations

import os
import signal
import stat
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import IO

STOPPED = 130
"""Exit status of what a signal ended."""

Handler = Callable[[int, FrameType | None], None]


def ending() -> tuple[signal.Signals, ...]:
    """Return the signals that end a process, but SIGHUP where ``nohup`` had it ignored."""
    both = (signal.SIGINT, signal.SIGTERM)
    return both if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (*both, signal.SIGHUP)


@contextmanager
def handled(handler: Handler) -> Iterator[None]:
    """Give the signals that end a process to ``handler``; put the handlers back. Only the main thread can do that."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in ending()}
    try:
        yield
    finally:
        for number, usual in before.items():
            signal.signal(number, usual)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, whichever signal it was."""
    if number == signal.SIGHUP:
        leave_terminal()
    raise KeyboardInterrupt


def say(text: str) -> None:
    """Print a line from a signal's handler, where an error may not end what goes on below it."""
    with suppress(OSError, ValueError, RuntimeError):
        print(text, file=sys.stderr, flush=True)


def silence(stream: IO[str] | None) -> None:
    """Send what is printed to a stream nowhere."""
    with suppress(OSError, ValueError, AttributeError):
        number = stream.fileno()  # type: ignore[union-attr]
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, number)
        os.close(nowhere)


def leave_terminal() -> None:
    """Send what would be printed to a terminal nowhere: after SIGHUP it is gone, and an error must not end the work.

    Pipes and files stay as they are.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            if stat.S_ISCHR(os.fstat(stream.fileno()).st_mode):
                silence(stream)
