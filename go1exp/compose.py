"""Hydra's side of the configuration: where it lies, its groups, composition outside an application."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from go1exp.config_source import seen_by


def as_container(config: DictConfig) -> dict[str, Any]:
    """Resolve interpolations and return plain dicts and lists."""
    container = OmegaConf.to_container(config, resolve=True)
    assert isinstance(container, dict)
    return {str(k): v for k, v in container.items()}


@contextmanager
def hydra_for(name: str, folders: Sequence[Path] = ()) -> Iterator[None]:
    """Set Hydra up for what ``conf/<name>.yaml`` may choose from, with a user's ``folders`` of further choices."""
    GlobalHydra.instance().clear()
    with seen_by(name, folders), initialize(config_path=None, version_base="1.3"):
        yield


def compose(name: str, overrides: Sequence[str] = (), folders: Sequence[Path] = ()) -> dict[str, Any]:
    """Compose ``conf/<name>.yaml`` with command-line overrides outside a Hydra application."""
    with hydra_for(name, folders):
        return as_container(hydra_compose(name, list(overrides)))


def key_values(container: Any, path: str = "") -> dict[str, Any]:
    """Flatten nested mappings: every key path, with its value (a mapping's own path is there too, with None)."""
    if not isinstance(container, dict):
        return {path: container}
    flat: dict[str, Any] = {path: None} if path else {}
    for key, value in container.items():
        flat |= key_values(value, f"{path}.{key}" if path else str(key))
    return flat


def flat_keys(name: str, overrides: Sequence[str] = (), folders: Sequence[Path] = ()) -> list[str]:
    """Return every key path of ``conf/<name>.yaml`` composed with ``overrides``, groups included."""
    return list(key_values(compose(name, overrides, folders)))
