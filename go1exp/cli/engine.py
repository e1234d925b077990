"""Judging a policy on another engine than MuJoCo: the group ``engine``."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from go1exp.config.schema.backends import BackendConfig

GROUP = "engine"


def split(container: dict[str, Any]) -> tuple[BackendConfig, dict[str, Any]]:
    """Return the checked engine, and what is left of the configuration.

    Raises:
        ConfigError: with every problem of its settings, or if it is not installed.
    """
    from go1exp.config.schema.backends import PhysxBackend
    from go1exp.config.schema.registry import ConfigError
    from go1exp.sim.task import parse_parts

    parts, problems = parse_parts(container, (GROUP,))
    if isinstance(parts.get(GROUP), PhysxBackend) and importlib.util.find_spec("sapien") is None:
        problems.append("engine = physx: needs the package sapien: pip install 'go1exp[physx]', or use engine=mujoco")
    if problems:
        raise ConfigError(problems)
    return parts[GROUP], {name: value for name, value in container.items() if name != GROUP}
