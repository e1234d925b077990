"""The run folder: what was run, with what, and where its results are.

``config.yaml`` (resolved), ``meta.json`` (git commit, versions, machine, hashes of assets), ``git.diff`` (what was not
committed), ``metrics.csv``,
``timing.csv``, ``checkpoints/``, ``actuator.npz`` (a copy of the actuator net, if there is one), ``plugins/`` (copies
of the user's files with terms). Whatever comes later reads the run's own configuration, never today's ``conf/``.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from go1exp import __version__
from go1exp.base.files import write_bytes, write_json, write_text
from go1exp.base.paths import data_root
from go1exp.config.schema.registry import ConfigError
from go1exp.config.schema.yaml_file import UNREADABLE, why_unreadable
from go1exp.sim.actuator.net import find
from go1exp.sim.task import TrainConfig, parse_train
from go1exp.train import kept_plugins

NET = "actuator.npz"
"""A run's own copy of its actuator net."""

DIFF, LONGEST_DIFF = "git.diff", 5_000_000
"""What was not committed when the run began, and how many letters of it are kept."""

PACKAGES = ("torch", "stable-baselines3", "gymnasium", "mujoco-core", "numpy", "hydra-core", "mujoco-warp", "warp-lang")


def write(run: Path, container: dict[str, Any]) -> None:
    """Create a run folder and say what is about to run in it.

    Raises:
        OSError: if the folder cannot be written; the message names it.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
        meta = {**_meta(container), "plugins": kept_plugins.keep(run, container)}
        if meta["git_dirty"]:
            write_text(run / DIFF, (_git("diff", "HEAD") or "")[:LONGEST_DIFF] + "\n")
        write_text(run / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(container)))
        write_json(run / "meta.json", meta)
        for settings in _with_files(container.get("actuator")):
            source = find(settings["file"])
            if not (run / NET).exists() or not (run / NET).samefile(source):
                write_bytes(run / NET, source.read_bytes())
    except OSError as error:
        raise OSError(error.errno, f"run folder cannot be written: {error.strerror}", str(run)) from error


def _with_files(actuator: Any) -> Iterator[dict[str, Any]]:
    """The settings of an actuator, or of one that it wraps, which name a file."""
    if isinstance(actuator, dict):
        if isinstance(actuator.get("file"), str):
            yield actuator
        for inner in actuator.values():
            yield from _with_files(inner)


def read_config(run: Path) -> dict[str, Any]:
    """Return the run's own resolved configuration; an actuator's file and plugins are the run's own copies.

    Raises:
        FileNotFoundError: if ``run`` is not a run folder.
        go1exp.config.schema.registry.ConfigError: if a plugin that it was trained with is missing.
    """
    container = kept_plugins.with_copies(run, read_as_written(run))
    for settings in _with_files(container.get("actuator")):
        if (run / NET).is_file():
            settings["file"] = str(run / NET)
    return container


def read_parsed(run: Path) -> TrainConfig:
    """Return what ``read_config`` reads, checked.

    Raises:
        FileNotFoundError: if ``run`` is not a run folder.
        go1exp.config.schema.registry.ConfigError: if this version does not know its configuration; names the file.
    """
    container = read_config(run)
    try:
        return parse_train(container)
    except ConfigError as error:
        raise ConfigError([f"{run / 'config.yaml'}: {problem}" for problem in error.problems]) from None


def read_as_written(run: Path) -> dict[str, Any]:
    """Return the configuration that the run was started with.

    Raises:
        FileNotFoundError: if ``run`` is not a run folder.
        go1exp.config.schema.registry.ConfigError: if its config.yaml is damaged.
    """
    path = run / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"{run}: not a run folder (it has no config.yaml)")
    try:
        container = OmegaConf.to_container(OmegaConf.load(path))
    except UNREADABLE as error:
        raise ConfigError([f"{path}: {why_unreadable(error)}"]) from None
    if not isinstance(container, dict) or not container:
        raise ConfigError([f"{path}: is not the configuration of a run"])
    return {str(k): v for k, v in container.items()}


def _meta(container: dict[str, Any]) -> dict[str, Any]:
    def version(package: str) -> str | None:
        try:
            return importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            return None

    assets = sorted(p for p in (data_root() / "assets").rglob("*.xml"))
    return {
        "go1exp": __version__,
        "git": _git("rev-parse", "HEAD"),
        "git_dirty": bool(_git("status", "--porcelain", "--untracked-files=no")),
        "seed": container.get("seed"),
        "packages": {name: version(name) for name in PACKAGES},
        "installed": {d.name: d.version for d in sorted(importlib.metadata.distributions(), key=lambda d: d.name)},
        "python": platform.python_version(),
        "machine": {"processor": _processor(), "cores": os.cpu_count(), **_gpus()},
        "assets_sha256": {str(p.relative_to(data_root())): hashlib.sha256(p.read_bytes()).hexdigest() for p in assets},
    }


def _git(*arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(data_root()), *arguments], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _gpus() -> dict[str, Any]:
    """Return NVIDIA's driver and the GPUs, as the driver tells them; nothing where there is none."""
    place = Path("/proc/driver/nvidia")
    try:
        driver = (place / "version").read_text().splitlines()[0].strip()
        named = [file.read_text() for file in sorted(place.glob("gpus/*/information"))]
    except (OSError, IndexError):
        return {}
    models = [line.split(":", 1)[1].strip() for text in named for line in text.splitlines() if line.startswith("Model")]
    return {"driver": driver, "gpus": models}


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
