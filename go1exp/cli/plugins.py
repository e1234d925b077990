"""The user's files and packages of terms, before a verb reads its configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from go1exp.config.schema import plugins

MEANING = "files and packages with terms of your own, such as [my_terms.py] (docs/extending.md)"
"""Of the key ``plugins``, for the help."""

BY_CONFIGURATION = ("train",)
"""Verbs whose configuration is parsed with its plugins; the others have the key for themselves."""


def begin(verb: str, container: dict[str, Any]) -> dict[str, Any]:
    """Load the plugins of a command line, and those of the run that it names; return the rest of the configuration.

    Raises:
        ConfigError: if a plugin is missing, fails, or registers nothing.
    """
    if verb in BY_CONFIGURATION:
        plugins.begin()
        return container
    wanted = plugins.names(container.get(plugins.KEY))
    plugins.begin(wanted)
    run = container.get("run")
    if isinstance(run, str) and (Path(run) / "config.yaml").is_file():
        from go1exp.train import run_folder

        plugins.use(run_folder.with_kept_plugins(Path(run), {})[plugins.KEY])
    return {key: value for key, value in container.items() if key != plugins.KEY}
