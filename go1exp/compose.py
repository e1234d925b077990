"""Hydra's side of the configuration: where it lies, its groups, composition outside an application."""

from __future__ import annotations

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


def compose(name: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Compose ``conf/<name>.yaml`` with command-line overrides outside a Hydra application."""
    register_groups()
    GlobalHydra.instance().clear()
    with initialize_config_dir(config_folder(), version_base="1.3"):
        return as_container(hydra_compose(name, list(overrides)))


def key_values(container: Any, path: str = "") -> dict[str, Any]:
    """Flatten nested mappings: every key path, with its value (a mapping's own path is there too, with None)."""
    if not isinstance(container, dict):
        return {path: container}
    values: dict[str, Any] = {path: None} if path else {}
    for key, value in container.items():
        values |= key_values(value, f"{path}.{key}" if path else str(key))
    return values


def flat_keys(name: str, overrides: Sequence[str] = ()) -> list[str]:
    """Return every key path of ``conf/<name>.yaml`` composed with ``overrides``, groups included."""
    return list(key_values(compose(name, overrides)))
