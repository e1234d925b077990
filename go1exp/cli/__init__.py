"""The command line: ``go1exp VERB key=value ...``. Every verb is a Hydra application in a module of its own.

This module imports nothing heavy, so that help and tab completion answer at once.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

from go1exp.base import signals
from go1exp.cli.verbs import EVERY as EVERY
from go1exp.cli.verbs import LISTS as LISTS
from go1exp.cli.verbs import MODULES as MODULES
from go1exp.cli.verbs import ONE_BLAS_THREAD as ONE_BLAS_THREAD
from go1exp.cli.verbs import POSITIONAL as POSITIONAL
from go1exp.cli.verbs import SUBVERBS as SUBVERBS
from go1exp.cli.verbs import VALUED as VALUED
from go1exp.cli.verbs import VERBS as VERBS

HELP = """usage: go1exp VERB [key=value ...]

{verbs}

  go1exp VERB --help       what a verb does, its settings, examples
  go1exp train reward=paper rand=table1
  go1exp train -m experiment=ablation/no_gait,ablation/no_noise
  go1exp eval run=runs/NAME
  go1exp record 'excitation=[chirp,steps]' effect=coulomb
  eval "$(go1exp -sc install=bash)"      tab completion
"""

HELP_WORDS = ("-h", "--help", "help")
"""Ask for help; a verb may come after."""

READER_LEFT = 141
"""Exit status of a closed pipe, 128 + 13 as shells count."""


def main() -> int:
    """Run the verb on the command line; return the exit status.

    Ctrl-C, SIGTERM and SIGHUP end it with one line at any time; verbs that have something to save handle them first.
    """
    arguments = sys.argv[1:]
    received: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(number)
        signals.interrupt(number, frame)

    try:
        with signals.handled(interrupt):
            status = _run(arguments)
            sys.stdout.flush()
            return status
    except BrokenPipeError:  # the reader of our output has closed it, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return READER_LEFT
    except BaseException as error:
        # A library that is interrupted while it is loaded may raise something else.
        if not received and not isinstance(error, KeyboardInterrupt):
            raise
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a second Ctrl-C shall not be a traceback
        signals.say(f"{' '.join(['go1exp', *arguments[:1]])}: stopped")
        return signals.STOPPED


def _run(arguments: list[str]) -> int:
    os.environ.setdefault(*ONE_BLAS_THREAD)
    if arguments[:1] == ["-sc"] and len(arguments) > 1:
        from go1exp.cli import completion

        return completion.serve(arguments[1])
    if len(arguments) > 1 and arguments[0] in HELP_WORDS:
        arguments = [*arguments[1:], "--help"]
    if not arguments or arguments[0] in HELP_WORDS:
        print(HELP.format(verbs="\n".join(f"  {verb:12} {text}" for verb, text in VERBS.items())), end="")
        return 0
    if arguments[0] in ("-V", "--version"):
        from go1exp import __version__

        print(f"go1exp {__version__}")
        return 0
    verb, rest = arguments[0], arguments[1:]
    if verb not in VERBS:
        import difflib

        close = difflib.get_close_matches(verb, VERBS, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(VERBS)}"
        print(f"go1exp: unknown verb {verb!r}; {hint}", file=sys.stderr)
        return 2
    if rest and rest[0] in SUBVERBS.get(verb, ()):
        verb, rest = f"{verb}_{rest[0]}", rest[1:]
    if {"-h", "--help"} & {*rest}:
        from go1exp.cli.app import defer
        from go1exp.cli.helptext import show

        defer("torch")  # help computes nothing
        show(verb, f"go1exp {verb.replace('_', ' ')}", rest)
        return 0
    from go1exp.cli.app import app_of

    return app_of(verb).run(_by_name(verb, rest))


def _by_name(verb: str, arguments: list[str]) -> list[str]:
    """Turn arguments by position into ``key=value``: those that are no override, no option and no option's value.

    Options come first: Hydra's parser takes none between overrides.
    """
    from go1exp.cli.verbs import quoted

    keys = list(POSITIONAL.get(verb, ()))
    words: list[str] = []
    options: list[str] = []
    settings: list[str] = []
    for before, word in zip(["", *arguments], arguments, strict=False):
        if word.startswith("-") or before in VALUED:
            options.append(word)
        elif "=" in word or word.startswith("~") or not keys:
            settings.append(word)
        else:
            words.append(word)
    named = []
    for key in keys:
        if key in LISTS and words:
            return [*options, *settings, f"{key}=[{','.join(quoted(w) for w in words)}]"]
        if words:
            named.append(f"{key}={quoted(words.pop(0))}")
    return [*options, *settings, *named, *words]
