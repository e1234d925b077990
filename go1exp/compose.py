"""Hydra's side of the configuration: where it lies, its groups, composition outside an application."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from go1exp import data_root


def config_folder() -> str:
    """Return the absolute path of ``conf/``."""
    return str(data_root() / "conf")


def register_groups() -> None:
    """Make the files of ``conf/randomization`` the group ``rand``: Hydra takes a group's name from its folder."""
    for file in sorted((data_root() / "conf/randomization").glob("*.yaml")):
        ConfigStore.instance().store(group="rand", name=file.stem, node=OmegaConf.load(file), provider=str(file))


def as_container(config: DictConfig) -> dict[str, Any]:
    """Resolve interpolations and return plain dicts and lists."""
    container = OmegaConf.to_container(config, resolve=True)
    assert isinstance(container, dict)
    return {str(k): v for k, v in container.items()}


VALUE_PER_JOINT = re.compile(
    r"(?P<add>\+{0,2})(?P<key>(effect\.[^.=]+|actuator(\.drive)*)\.(?!(drive|spread)=)[^.=@]+)=\s*[\[{]"
)
"""An override that writes a value per joint as a list or as a mapping."""


OPEN = re.compile(r"model\.tolerances[.=]")
"""An override of a mapping to which a user may add keys; the verb checks them."""


def as_hydra_takes_them(overrides: Sequence[str]) -> list[str]:
    """Return overrides in a form that Hydra accepts, where it is stricter than our documents.

    A value per joint may change its form: number, list or mapping. Hydra merges a mapping into what the file has, and
    refuses if that is a list, such as ``bound: [0.2, 0.2, 0.3]``. So such a value is removed first; a joint that the
    new mapping leaves out is without the effect. A tolerance may be given although the file names none (``++``).
    """
    accepted = []
    for override in overrides:
        if match := VALUE_PER_JOINT.match(override):
            # Two spellings of the key, since a sweep keeps only the last override of each.
            accepted += [f"{'++' if match['add'] else ''}{match['key']}=null", f"+{override.lstrip('+')}"]
        else:
            accepted.append(f"++{override}" if OPEN.match(override) else override)
    return accepted


def compose(name: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Compose ``conf/<name>.yaml`` with command-line overrides outside a Hydra application."""
    register_groups()
    GlobalHydra.instance().clear()
    with initialize_config_dir(config_folder(), version_base="1.3"):
        return as_container(hydra_compose(name, as_hydra_takes_them(overrides)))


def key_values(container: Any, path: str = "") -> dict[str, Any]:
    """Flatten nested mappings: every key path, with its value (a mapping's own path is there too, with None)."""
    if not isinstance(container, dict):
        return {path: container}
    found: dict[str, Any] = {path: None} if path else {}
    for key, value in container.items():
        found |= key_values(value, f"{path}.{key}" if path else str(key))
    return found


def flat_keys(name: str, overrides: Sequence[str] = ()) -> list[str]:
    """Return every key path of ``conf/<name>.yaml`` composed with ``overrides``, groups included."""
    return list(key_values(compose(name, overrides)))
