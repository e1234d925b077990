"""Group choices that are files of the user's own: ``effect=found/effect.yaml``."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from yaml import YAMLError

from go1exp.schema.registry import ConfigError

PATHS = {"model": "mjcf"}
"""Group -> key of its files that names another file, from where the file itself lies."""

GROUP_IS_FILE = re.compile(r"^(?P<add>\+?)(?P<group>[a-z_]+)=(?P<value>\[?.*\.ya?ml\b.*)$")


def choices_from_files(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with every ``group=FILE.yaml`` turned into a choice that Hydra knows.

    A list may mix files and names: ``effect=[found.yaml,payload]``.

    Raises:
        ConfigError: if a file is missing or holds no mapping.
    """
    found = []
    for argument in arguments:
        match = GROUP_IS_FILE.match(argument)
        if match is None:
            found.append(argument)
            continue
        group, value = match["group"], match["value"]
        items = [item.strip() for item in value.strip("[]").split(",")]
        names = [_choice(group, item) if re.search(r"\.ya?ml$", item) else item for item in items]
        chosen = f"[{','.join(names)}]" if value.startswith("[") else names[0]
        found.append(f"{match['add']}{group}={chosen}")
    return found


def _choice(group: str, file: str) -> str:
    """Make a file a choice of ``group`` and return its name there."""
    path = Path(file)
    if not path.is_file():
        raise ConfigError([f"{group}={file}: no such file"])
    try:
        content = OmegaConf.load(path)
    except (YAMLError, OSError) as error:
        raise ConfigError([f"{group}={file}: no YAML ({str(error).splitlines()[0]})"]) from None
    if not isinstance(content, DictConfig):
        raise ConfigError([f"{group}={file}: must be a mapping, as the files of conf/{group} are"])
    named = content.get(PATHS.get(group, ""))
    if isinstance(named, str):
        content[PATHS[group]] = str((path.parent / named).resolve())
    name = re.sub(r"\W", "_", str(path.with_suffix("")))
    ConfigStore.instance().store(group=group, name=name, node=content, provider=str(path))
    return name
