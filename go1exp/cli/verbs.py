"""The words of the command line: verbs, their second words, settings by position, Hydra's options, quotes."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

VERBS = {
    "train": "train a policy from configuration",
    "tune": "search for settings of a training, several at once, with early stopping (pruning)",
    "eval": "run a trained policy through a grid of commands: errors, falls, a table and JSON",
    "compare": "compare policies on the same protocol and robots: paired differences, a page and JSON",
    "report": "training runs together: learning curves, intervals over seeds, verdicts against a baseline",
    "play": "watch a trained policy: a clip without a display, a live viewer with one",
    "record": "drive the simulated robot and log it; audit recordings, import others",
    "gap": "find where simulation and recordings disagree, name the missing effect, add it",
    "export": "pack a trained policy into one sealed file for the robot; check such a file; import others",
    "deploy": "run a bundle's policy in real time on a robot, or on a simulated one in another process",
    "sim": "the simulated robot alone, for any client that speaks the Go1's protocol",
    "fit-actuator": "learn an actuator net from recordings",
    "list": "list terms, groups and their choices, one line each",
    "bench": "measure speed as ratios in one run",
}
"""Verb -> one line; the module has the verb's name or is in ``MODULES``."""

MODULES = {
    "eval": "evaluate",
    "fit-actuator": "fit_actuator",
    "list": "helptext",
    "sim": "play_web",
    "record_audit": "record",
    "record_import": "record",
    "export_check": "export",
    "export_import": "export",
    "gap_loop": "gap_next",
}
"""Modules that do not have their verb's name."""

SUBVERBS = {"record": ("audit", "import"), "export": ("check", "import"), "gap": ("next", "loop")}
"""Second words of a verb that are verbs of their own; the configuration is called VERB_WORD."""

EVERY = (*VERBS, *(f"{verb}_{word}" for verb, words in SUBVERBS.items() for word in words))
"""All verbs that have a configuration."""

POSITIONAL: dict[str, tuple[str, ...]] = {
    "record_audit": ("files",),
    "record_import": ("source", "path"),
    "export_check": ("file",),
    "export_import": ("network",),
    "gap": ("stage",),
    "deploy": ("bundle",),
    "list": ("group",),
    "compare": ("subjects",),
    "report": ("folders",),
}
"""Settings that may be given by position alone; those of ``LISTS`` take all that are left."""

LISTS = ("files", "subjects", "folders")

VALUED = ("--cfg", "-c", "--info", "-i", "--package", "-p", "--config-dir", "-cd", "--config-name", "-cn")
"""Options of Hydra whose value is the word after them."""

FLAGS = (
    *("--hydra-help", "--version", "--resolve", "--run", "-r", "--multirun", "-m"),
    *("--config-path", "-cp", "--experimental-rerun"),
)
"""Hydra's other options."""

ONE_BLAS_THREAD = ("OPENBLAS_NUM_THREADS", "1")
"""Variable and value, read when NumPy is first imported: its matrices are small here, and threads that wait for each
other spin. On two busy cores matrix products of ``go1exp gap`` took 40 times as long with two threads as with one."""


PATH_KEYS = {
    *("run", "resume", "start_from", "policy", "checkpoint", "logs", "recordings", "files", "file", "path", "bundle"),
    *("out", "dir", "mjcf", "baseline", "folder", "options", "columns", "motion", "feet", "plugins"),
    *("network", "spec"),
}
"""Last words of the keys whose value is a file, a folder or a name, which may hold =."""

FILE_OF_COMMANDS = re.compile(r"command=.*\.csv$")
"""``command`` is a group of choices, too, which must stay without quotes."""

_MEANT_FOR_HYDRA = re.compile(r"""$|null$|['"\[{]|.*\$\{|\w+\(.*\)$""")
"""A value with quotes of its own, a list, an interpolation, a function such as ``glob(*)``."""


def parted(arguments: Sequence[str]) -> tuple[list[str], list[str], list[str]]:
    """Return options with their values, overrides, and other words."""
    options: list[str] = []
    overrides: list[str] = []
    words: list[str] = []
    for before, word in zip(["", *arguments], arguments, strict=False):
        is_option = word.startswith("-") or before in VALUED
        is_override = word.startswith("~") or ("=" in word and not _is_file(word))
        (options if is_option else overrides if is_override else words).append(word)
    return options, overrides, words


def _is_file(word: str) -> bool:
    """Return whether a word with ``=`` is a file or folder, and no setting: ``seed=1`` is one, ``./seed=1`` is not."""
    key = word.partition("=")[0]
    is_key = re.fullmatch(r"\+{0,2}[a-zA-Z_][\w./@:-]*", key) and not ("/" in key and Path(key).parent.is_dir())
    return not is_key and Path(word).exists()


def quoted(text: str) -> str:
    """Write a text so that Hydra takes it as it is: backslashes mean something before a quote only."""
    return "'" + re.sub(r"(\\+)$", r"\1\1", re.sub(r"(\\*)'", r"\1\1\'", text)) + "'"


def protected(argument: str) -> str:
    """Return a setting with its path in quotes, so that no character of it has a meaning for Hydra.

    Several paths with commas between them are a sweep, unless there is a file of that very name.
    """
    key, equals, value = argument.partition("=")
    names_path = key.lstrip("+").rsplit(".", 1)[-1] in PATH_KEYS or FILE_OF_COMMANDS.match(argument)
    is_path = equals and not key.startswith("-") and names_path
    if not is_path or _MEANT_FOR_HYDRA.match(value) or ("," in value and not Path(value).exists()):
        return argument
    return f"{key}={quoted(value)}"


def command(*words: str, settings: dict[str, Any] | None = None) -> str:
    """Return a command line to be copied: ``go1exp`` with words and settings, quoted for the shell where need be."""
    pairs = [f"{key}={shlex.quote(str(value))}" for key, value in (settings or {}).items()]
    return " ".join(["go1exp", *map(shlex.quote, words), *pairs])
