"""Paths with spaces, ``=`` or letters that Hydra's grammar does not have: as users type them, and in hints for them."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

PATH_KEYS = {
    *("run", "resume", "start_from", "policy", "checkpoint", "logs", "recordings", "files", "file", "path", "bundle"),
    *("out", "dir", "mjcf", "baseline", "folder", "options", "columns", "motion", "feet", "plugins"),
}
"""Last words of the keys whose value is a file, a folder or a name, which may hold =."""

FILE_OF_COMMANDS = re.compile(r"command=.*\.csv$")
"""``command`` is a group of choices, too, which must stay without quotes."""

_MEANT_FOR_HYDRA = re.compile(r"""$|null$|['"\[{]|.*\$\{|\w+\(.*\)$""")
"""A value with quotes of its own, a list, an interpolation, a function such as ``glob(*)``."""


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
