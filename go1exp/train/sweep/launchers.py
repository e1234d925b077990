"""The launchers by name: where the jobs of a sweep run, how many at once, with what.

``conf/launcher`` has a file for each; Hydra knows them as ``hydra/launcher``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from go1exp.config.schema.registry import ConfigError, nearest
from go1exp.config.schema.settings import parse
from go1exp.train.sweep import local, ray_cluster, slurm
from go1exp.train.sweep.command import Launcher

LAUNCHERS: dict[str, Any] = {
    "basic": local.BasicSettings,
    "joblib": local.JoblibSettings,
    "slurm": slurm.SlurmSettings,
    "ray": ray_cluster.RaySettings,
}
"""Name -> class of its settings."""

HYDRAS_BASIC = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
"""What ``hydra/launcher=basic``, Hydra's default, is called in a composed configuration."""


def chosen(container: Mapping[str, Any]) -> Any:
    """Return the settings of the launcher that ``hydra.launcher`` describes, checked.

    Raises:
        ConfigError: with everything that is wrong with them, or if it is not one of ours.
    """
    if container.get("_target_") == HYDRAS_BASIC:
        return local.BasicSettings(name="basic")
    name = container.get("name")
    if name not in LAUNCHERS:
        given = container.get("_target_", name)
        close = nearest(str(name), list(LAUNCHERS))
        hint = f"did you mean {close[0]!r}?" if close else f"there are: {', '.join(LAUNCHERS)}"
        raise ConfigError([f"hydra/launcher: {given!r} is no launcher of sweeps; {hint}"])
    try:
        return parse(LAUNCHERS[name], container)
    except ConfigError as error:
        raise ConfigError([f"hydra.launcher.{problem}" for problem in error.problems]) from None


def built(settings: Any) -> Launcher:
    """Return the launcher with these settings; what it runs on is imported now."""
    kinds: dict[str, Any] = {"joblib": local.Local, "slurm": slurm.Slurm, "ray": ray_cluster.Ray}
    return local.Basic() if settings.name == "basic" else kinds[settings.name](settings)
