"""Failures that are answers, exit statuses, and the end of a program in one line.

Every room uses this, also the runtime on the robot: it imports nothing but the standard library.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import tempfile
import traceback
from collections.abc import Callable

from go1exp.base import signals
from go1exp.base.signals import STOPPED

DONE, FAILED, REFUSED = 0, 1, 2
AUDIT = {"ok": 0, "suspect": 3, "bad": 4}
"""Verdict of ``go1exp record audit`` -> its status; the worst counts."""
READER_LEFT = 141
"""Status of a closed pipe, 128 + 13 as shells count."""

EXIT_CODES = {
    "no gap": 0,
    "explained": 10,
    "partly explained": 11,
    "unexplained": 12,
    "not excited": 13,
    "bad log": 14,
}
"""Verdict of ``go1exp gap`` -> its status."""
DOES_NOT_HOLD, NOT_SEPARABLE = 15, 16

FAULTS = (
    *("operator_stop", "stale_state", "not_finite", "attitude", "tilt", "joint_range", "torque", "power"),
    *("no_state", "estimator", "command", "runtime", "stand_up"),
)
"""Faults that end a walk (``deploy/runtime/safety.py``), in the order of their statuses."""
UNKNOWN_FAULT, FIRST_FAULT = 19, 20

STATUSES: dict[int, tuple[str, str]] = {
    DONE: ("every verb", "done; `gap`: no gap"),
    FAILED: ("every verb", "the work failed, or the answer is no: a check that was not passed, a loop without an end"),
    REFUSED: ("every verb", "refused before the work: a wrong setting, or a named file that cannot be used"),
    AUDIT["suspect"]: ("record audit", "suspect: a warning in at least one recording"),
    AUDIT["bad"]: ("record audit", "bad: an error in at least one recording"),
    **{status: ("gap", verdict) for verdict, status in EXIT_CODES.items() if status},
    DOES_NOT_HOLD: ("gap", "an effect is identified, but the files are not as good at the physics step of training"),
    NOT_SEPARABLE: ("gap next", "no recording distinguishes the remaining explanations"),
    UNKNOWN_FAULT: ("deploy", "a fault without a status of its own"),
    **{FIRST_FAULT + k: ("deploy", f"fault: {name}") for k, name in enumerate(FAULTS)},
    STOPPED: ("every verb", "stopped by Ctrl-C, SIGTERM or SIGHUP"),
    READER_LEFT: ("every verb", "the reader of the output left, as `| head -1` does"),
}
"""Every exit status: the verb that has it, and what it means."""


class Expected(RuntimeError):
    """Base of failures whose message says all there is to say; the command line prints it without a traceback.

    Attributes:
        status: exit status of the program that ends with it; REFUSED where something named cannot be used.
    """

    def __init__(self, *args: object, status: int = FAILED) -> None:
        """Set message and status."""
        super().__init__(*args)
        self.status = status


UNUSABLE = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)
NO_SUCH_PLACE = (errno.EROFS, errno.ELOOP, errno.ENAMETOOLONG)
"""What a system says of a path that cannot be used, by class and, where there is none, by number."""


def explained(error: BaseException) -> tuple[int, str] | None:
    """Return exit status and message of an error that is an answer; None of a fault of the program.

    Errors with a list ``problems`` are refusals with one line for each.
    """
    problems = getattr(error, "problems", None)
    if problems:
        lines = [_in_a_line(str(problem)) for problem in problems]
        return REFUSED, lines[0] if len(lines) == 1 else "\n  ".join([f"{len(lines)} problems", *lines])
    if isinstance(error, KeyboardInterrupt):
        return STOPPED, "stopped"
    if isinstance(error, BrokenPipeError):
        return READER_LEFT, ""
    if isinstance(error, Expected):
        return error.status, str(error)
    if isinstance(error, OSError):
        reason = error.strerror or str(error)
        return (
            REFUSED if isinstance(error, UNUSABLE) or error.errno in NO_SUCH_PLACE else FAILED,
            reason if error.filename is None else f"{reason}: {_in_a_line(os.fsdecode(error.filename))}",
        )
    if isinstance(error, RuntimeError) and str(error).startswith("Symlink loop from "):  # pathlib's, until Python 3.13
        return REFUSED, str(error)
    if isinstance(error, ModuleNotFoundError) and error.name and "." not in error.name:
        hint = "activate the environment that go1exp is installed in, or install it in this one"
        return REFUSED, f"{sys.executable} has no package {error.name!r}; {hint}"
    of_torch = type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in str(error)
    if isinstance(error, MemoryError) or of_torch:
        return FAILED, f"out of memory: {' '.join(str(error).split())}".rstrip(": ")
    return None


class Unusable(Expected):
    """Base of errors of a file that cannot be used."""

    def __init__(self, *args: object, status: int = REFUSED) -> None:
        """Set message and status."""
        super().__init__(*args, status=status)


def _in_a_line(text: str) -> str:
    """Return a text without line breaks and the like, which names of files may have."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def fault(error: BaseException) -> str:
    """Return a fault of the program in one line, which names the file that its traceback was written to."""
    last = traceback.extract_tb(error.__traceback__)[-1:]
    place = f" in {os.path.basename(last[0].filename)}:{last[0].lineno}" if last else ""
    text = " ".join(f"fault in go1exp: {type(error).__name__}: {error}".split())[:500].rstrip(": ")
    with contextlib.suppress(OSError):
        with tempfile.NamedTemporaryFile("w", prefix="go1exp_", suffix=".txt", delete=False) as file:
            traceback.print_exception(error, file=file)
        return f"{text}{place} (traceback: {file.name})"
    return f"{text}{place}"


Explain = Callable[[BaseException], tuple[int, str] | None]


def end(error: BaseException, title: str, explain: Explain = explained) -> int:
    """Print in one line what ended a program, ``title`` first, and return its exit status.

    What is left to print goes nowhere if it cannot be written: Python would complain again on its way out.
    """
    status, message = explain(error) or (FAILED, fault(error))
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            signals.silence(stream)
    if message:
        signals.say(f"{title}: {message}")
    return status
