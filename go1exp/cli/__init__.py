"""The command line: ``go1exp VERB key=value ...``. Every verb is a Hydra application in a module of its own.

This module imports nothing heavy, so that help and tab completion answer at once.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from collections import namedtuple
from types import FrameType

from go1exp.base import errors, signals
from go1exp.cli.verbs import EVERY, LISTS, MODULES, ONE_BLAS_THREAD, POSITIONAL, SUBVERBS, VERBS, parted, quoted

__all__ = ["EVERY", "LISTS", "MODULES", "ONE_BLAS_THREAD", "POSITIONAL", "SUBVERBS", "VERBS", "main"]

HELP = """usage: go1exp VERB [key=value ...]

{verbs}

  go1exp VERB --help       what a verb does, its settings, examples
  go1exp train reward=paper rand=table1
  go1exp train -m experiment=ablation/no_gait,ablation/no_noise
  go1exp eval run=runs/NAME
  go1exp record 'excitation=[chirp,steps]' effect=coulomb
  eval "$(go1exp -sc install=bash)"      tab completion
"""

HELP_WORDS = ("-h", "--help", "help")  # ask for help; a verb may come after


def main() -> int:
    """Run the verb on the command line; return the exit status (``go1exp.base.errors.STATUSES``).

    Every error, interrupt and closed stream of every verb ends here, in one line. ``HYDRA_FULL_ERROR=1`` shows the
    traceback instead. Ctrl-C, SIGTERM and SIGHUP do so at any time; verbs that have something to save handle them
    first.
    """
    wants_traceback = os.environ.get("HYDRA_FULL_ERROR") == "1"
    verb, rest = _verb(sys.argv[1:])
    title = f"go1exp {verb}".strip().replace("_", " ")
    received: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(number)
        signals.interrupt(number, frame)

    try:
        _need_streams()
        with signals.handled(interrupt):
            status = _run(verb, rest)
            sys.stdout.flush()
            return status
    except SystemExit:
        raise
    except BaseException as error:
        stopped = received or isinstance(error, KeyboardInterrupt)
        if stopped:  # a library that is interrupted while it is loaded may raise something else
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # a second Ctrl-C shall not be a traceback
            # Where it came while Python ran text, as dataclasses do, Python under -m would end by the signal, not with
            # our status, unless more text is run, as by namedtuple (run_eval_code_obj in CPython's pythonrun.c).
            namedtuple("Nothing", "")
            return errors.end(KeyboardInterrupt(), title)
        if wants_traceback and not isinstance(error, BrokenPipeError):
            raise
        if "go1exp.cli.app" not in sys.modules:
            return errors.end(error, title)
        from go1exp.cli.app import explained

        return errors.end(error, title, explained)


def _verb(arguments: list[str]) -> tuple[str, list[str]]:
    """Return the verb that is meant, such as ``record_audit``, and its arguments; an option in place of a verb too."""
    if len(arguments) > 1 and arguments[0] in HELP_WORDS:
        arguments = [*arguments[1:], "--help"]
    verb, rest = (arguments[0], arguments[1:]) if arguments else ("", [])
    return (f"{verb}_{rest[0]}", rest[1:]) if rest and rest[0] in SUBVERBS.get(verb, ()) else (verb, rest)


def _need_streams() -> None:
    """Point closed standard streams, whose numbers files would get, to nowhere; raise Expected if that of output is."""
    closed = [number for number, stream in enumerate((sys.stdin, sys.stdout, sys.stderr)) if stream is None]
    for number in closed:
        nowhere = os.open(os.devnull, os.O_RDWR)
        os.dup2(nowhere, number)
        if nowhere != number:
            os.close(nowhere)
    sys.stdout, sys.stderr = (s or io.StringIO() for s in (sys.stdout, sys.stderr))
    if 1 in closed:
        raise errors.Expected("standard output is closed; use >/dev/null for none")


def _run(verb: str, rest: list[str]) -> int:
    os.environ.setdefault(*ONE_BLAS_THREAD)
    if verb == "-sc" and rest:
        from go1exp.cli import completion

        return completion.serve(rest[0])
    if not verb or verb in HELP_WORDS:
        print(HELP.format(verbs="\n".join(f"  {name:12} {text}" for name, text in VERBS.items())), end="")
        return 0
    if verb in ("-V", "--version"):
        from go1exp import __version__

        print(f"go1exp {__version__}")
        return 0
    if verb not in EVERY:
        import difflib

        close = difflib.get_close_matches(verb, VERBS, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(VERBS)}"
        raise errors.Expected(f"unknown verb {verb!r}; {hint}", status=errors.REFUSED)
    from go1exp.cli.app import app_of, defer

    defer("torch")  # before the modules of the verb, which import it
    if {"-h", "--help"} & {*rest}:
        from go1exp.cli.helptext import show

        show(verb, rest)
        return 0
    return app_of(verb).run(_by_name(verb, rest))


def _by_name(verb: str, arguments: list[str]) -> list[str]:
    """Turn words by position into ``key=value``, options first: Hydra's parser takes none between overrides."""
    options, settings, words = parted(arguments)
    named = []
    for key in POSITIONAL.get(verb, ()):
        if key in LISTS and words:
            return [*options, *settings, f"{key}=[{','.join(quoted(w) for w in words)}]"]
        if words:
            named.append(f"{key}={quoted(words.pop(0))}")
    return [*options, *settings, *named, *words]
