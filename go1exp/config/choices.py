"""The files of ``conf/`` and of a user's folder like it, read without Hydra: groups and their choices.

Tab completion reads them at every key press, so this module imports nothing but a YAML parser.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from yaml import MarkedYAMLError, YAMLError

from go1exp.base.paths import data_root

CONFIG_DIR = ("--config-dir", "-cd")
"""Hydra's option for a user's own folder of choices."""

FOLDERS = {"rand": "randomization", "hydra/launcher": "launcher"}
"""Group -> its folder, where that has another name."""

_GROUP_OF_FOLDER = {folder: group for group, folder in FOLDERS.items()}
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def config_folder() -> Path:
    """Return the absolute path of ``conf/``."""
    return data_root() / "conf"


def load(file: Path) -> dict[str, Any]:
    """Read one YAML file; what is not a mapping counts as empty."""
    content = yaml.load(file.read_text(encoding="utf-8"), Loader=_Loader)
    return content if isinstance(content, dict) else {}


@cache
def groups_of(verb: str) -> dict[str, str | None]:
    """Return the groups that ``conf/VERB.yaml`` names in its defaults, each with its default choice."""
    chosen: dict[str, str | None] = {}
    for item in load(config_folder() / f"{verb}.yaml").get("defaults", ()):
        if isinstance(item, dict):
            for group, choice in item.items():
                name = str(group).removeprefix("override ")
                if name == str(group) or name in FOLDERS:  # Hydra's own groups are ours where they have a folder
                    chosen[name.removeprefix("optional ")] = choice
    # A choice may follow that of another group: ppo: ${backend}.
    return {name: chosen.get(str(choice).strip("${}"), choice) for name, choice in chosen.items()}


def folder_of(group: str, folder: Path) -> Path:
    """Return where the files of a group lie in a folder: of ``rand`` in ``randomization``, or in a user's ``rand``."""
    place = folder / FOLDERS.get(group, group)
    return place if place.is_dir() else folder / group


def groups_in(folder: Path) -> list[str]:
    """Return the groups that have files below ``folder``."""
    names = sorted(path.name for path in folder.iterdir() if path.is_dir() and any(path.rglob("*.yaml")))
    return list(dict.fromkeys(_GROUP_OF_FOLDER.get(name, name) for name in names))


def hidden_from(verb: str) -> frozenset[str]:
    """Return the folders of ``conf/`` that are no group of the verb.

    Hydra takes ``robot=sim`` for a file of ``conf/robot`` wherever it sees that folder, also for a verb that has a
    plain setting of that name. A user's own groups are seen by every verb.
    """
    theirs = groups_of(verb)
    return frozenset(FOLDERS.get(group, group) for group in groups_in(config_folder()) if group not in theirs)


def choice_files(group: str, folders: Sequence[Path]) -> dict[str, Path]:
    """Return the choices of a group, as ``ablation/no_gait``, each with its file; the first folder goes first."""
    files: dict[str, Path] = {}
    for folder in folders:
        place = folder_of(group, folder)
        for file in sorted(place.rglob("*.yaml")) if place.is_dir() else ():
            files.setdefault(file.relative_to(place).with_suffix("").as_posix(), file)
    return files


def given_folders(arguments: Sequence[str]) -> list[Path]:
    """Return ``conf/`` and the folder that ``--config-dir`` names among the arguments."""
    folders = [config_folder()]
    for option, value in zip(arguments, [*arguments[1:], ""], strict=False):
        name, equals, attached = option.partition("=")
        if name in CONFIG_DIR and (attached or value):
            folders.append(Path(attached if equals else value).absolute())
    return folders


def about(file: Path) -> str:
    """Return the first sentence of the comment at the head of a file."""
    comments = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            comments.append(line[1:].strip())
    return " ".join(comments).split(". ")[0].rstrip(".")


MOST_VALUES = 100_000
"""In a YAML file, each alias written out."""


class NotTaken(YAMLError):
    """A YAML file that OmegaConf cannot take."""


def loaded(text: str, loader: Any) -> Any:
    """Return the content of a YAML file's text, {} of an empty one; raise one of ``UNREADABLE``."""
    content = yaml.load(text, Loader=loader)
    if content is not None and not isinstance(content, dict | list | str):
        raise NotTaken("must be a mapping")
    if _written_out(content, {}) > MOST_VALUES:
        raise NotTaken(f"an alias leads back to itself, or there are more than {MOST_VALUES:,} values")
    return {} if content is None else content


def _written_out(content: object, known: dict[int, int]) -> int:
    """Return how many values there are when every alias is written out; too many where one leads back."""
    if not isinstance(content, dict | list):
        return 1
    if id(content) not in known:
        known[id(content)] = MOST_VALUES + 1
        inside = content.values() if isinstance(content, dict) else content
        known[id(content)] = 1 + sum(_written_out(value, known) for value in inside)
    return known[id(content)]


UNREADABLE = (UnicodeDecodeError, YAMLError, OSError, RecursionError)
"""What reading a YAML file raises."""


def why_unreadable(error: Exception) -> str:
    """Return what is wrong with a file whose reading raised one of ``UNREADABLE``, with the line where there is one."""
    if isinstance(error, UnicodeDecodeError):
        return f"not UTF-8 (byte {error.start})"
    if isinstance(error, MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        return f"no YAML ({f'line {mark.line + 1}: ' if mark else ''}{error.problem})"
    if isinstance(error, NotTaken):
        return str(error)
    if isinstance(error, RecursionError):
        return "nests too deeply"
    why = error.strerror if isinstance(error, OSError) else str(error).splitlines()[0]
    return f"cannot be read ({why})"
