"""The run folder: what was run, with what, and where its results are.

``config.yaml`` (resolved), ``meta.json`` (git commit, versions, machine, hashes of assets), ``git.diff`` (what was not
committed), ``metrics.csv``, ``timing.csv``, ``checkpoints/``, ``actuator.npz`` (a copy of the actuator net, if there is
one), ``plugins/`` (copies of the user's files with terms; of a package, ``meta.json`` has version and commit). Whatever
comes later reads the run's own configuration, never today's ``conf/``; reading a run executes its plugins.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import warnings
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from go1exp import __version__
from go1exp.base.files import write_bytes, write_json, write_text
from go1exp.base.paths import data_root
from go1exp.config.choices import UNREADABLE, why_unreadable
from go1exp.config.hydra_adapter import read_yaml, to_yaml
from go1exp.config.schema import plugins
from go1exp.config.schema.plugins import Plugin
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.actuator.net import find
from go1exp.sim.task import MANY_TERMS, ONE_TERM, REGISTERED_AS, TrainConfig, parse_train

NET = "actuator.npz"
"""A run's own copy of its actuator net."""

DIFF, LONGEST_DIFF = "git.diff", 5_000_000
"""What was not committed when the run began, and how many letters of it are kept."""

PACKAGES = ("torch", "stable-baselines3", "gymnasium", "mujoco-core", "numpy", "hydra-core", "mujoco-warp", "warp-lang")


def write(run: Path, container: Mapping[str, object]) -> None:
    """Create a run folder with configuration and versions of the run.

    Raises:
        OSError: if the folder cannot be written; the message names it.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
        meta = {**_meta(container), "plugins": keep_plugins(run, container)}
        if meta["git_dirty"]:
            write_text(run / DIFF, (_git("diff", "HEAD") or "")[:LONGEST_DIFF] + "\n")
        write_text(run / "config.yaml", to_yaml(container))
        write_json(run / "meta.json", meta)
        for settings in _with_files(container.get("actuator")):
            source = find(settings["file"])
            if not (run / NET).exists() or not (run / NET).samefile(source):
                write_bytes(run / NET, source.read_bytes())
    except OSError as error:
        raise OSError(error.errno, f"run folder cannot be written: {error.strerror}", str(run)) from error


def _with_files(actuator: object) -> Iterator[dict[str, Any]]:
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
    container = with_kept_plugins(run, read_as_written(run))
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
        container = read_yaml(path)
    except UNREADABLE as error:
        raise ConfigError([f"{path}: {why_unreadable(error)}"]) from None
    if not isinstance(container, dict) or not container:
        raise ConfigError([f"{path}: is not the configuration of a run"])
    return {str(k): v for k, v in container.items()}


def _meta(container: Mapping[str, object]) -> dict[str, object]:
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
        "installed": _installed(),
        "python": platform.python_version(),
        "machine": {"processor": _processor(), "cores": os.cpu_count(), **_gpus()},
        "assets_sha256": {str(p.relative_to(data_root())): hashlib.sha256(p.read_bytes()).hexdigest() for p in assets},
    }


@cache
def _installed() -> dict[str, str]:
    packages = [(d.name, d.version) for d in importlib.metadata.distributions()]
    return dict(sorted(packages, key=lambda pair: pair[0]))


def _git(*arguments: str, folder: Path | None = None) -> str | None:
    command = ["git", "-C", str(folder or data_root()), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _gpus() -> dict[str, object]:
    """Return NVIDIA's driver and the GPUs, as the driver reports them; empty without one."""
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


PLUGINS = "plugins"
"""In the run folder."""


def keep_plugins(run: Path, container: Mapping[str, Any]) -> list[dict[str, object]]:
    """Copy the files of a configuration's plugins into ``run``; return their records for ``meta.json``.

    One that the configuration does not name (of ``GO1EXP_PLUGINS`` or an entry point) counts if a term of it is used.

    Raises:
        ConfigError: if a plugin is missing.
        OSError: if a file cannot be written.
    """
    named = plugins.names(container.get(plugins.KEY))
    plugins.use(with_kept_plugins(run, container)[plugins.KEY])
    used = set(_used(container))
    records = []
    for plugin in plugins.in_force():
        terms = [f"{e.group}.{e.name}" for e in plugin.entries if (e.group, e.name) in used]
        if terms or plugin.name in named or _copy_of(run, plugin):
            records.append({**(_kept_file(run, plugin) if plugin.file else _kept_package(plugin)), "terms": terms})
    return records


def with_kept_plugins(run: Path, container: Mapping[str, object]) -> dict[str, Any]:
    """Return the configuration with the run's copies of its plugins in the place of what it names.

    Raises:
        ConfigError: if a copy, or a package, is not there.
    """
    records = _records(run)
    if not records:
        return {**container, plugins.KEY: plugins.names(container.get(plugins.KEY))}
    problems: list[str] = []
    names = []
    for record in records:
        if "file" in record:
            copy = run / record["file"]
            names.append(str(copy))
            if not copy.is_file():
                problems.append(f"{copy}: missing; the run was trained with this plugin {_terms_of(record)}")
            elif plugins.sha256(copy) != record["sha256"]:
                problems.append(f"{copy}: is not the file that the run was trained with (its SHA-256 differs)")
        else:
            names.append(record["name"])
            problems += _missing_package(run, record)
    if problems:
        raise ConfigError(problems)
    return {**container, plugins.KEY: names}


def differing_plugins(run: Path, container: Mapping[str, object]) -> list[str]:
    """Return the names of a configuration's plugins whose content is another than that of the run's copy."""
    kept = {r["name"]: r["sha256"] for r in _records(run) if "file" in r}
    given = [n for n in plugins.names(container.get(plugins.KEY)) if n in kept and Path(n).is_file()]
    return [name for name in given if plugins.sha256(Path(name)) != kept[name]]


def _records(run: Path) -> list[dict[str, Any]]:
    """What the run says of its plugins; older runs and shipped policies say nothing."""
    file = run / "meta.json"
    if not file.is_file():
        return []
    try:
        content = json.loads(file.read_text())
        records: list[dict[str, Any]] = content.get("plugins", [])
        if not all({"name", "file", "sha256"} <= r.keys() or {"name", "version"} <= r.keys() for r in records):
            raise TypeError
    except (ValueError, AttributeError, TypeError, RecursionError):
        raise ConfigError([f"{file}: damaged; it must be JSON whose plugins are a list of records"]) from None
    return records


def _terms_of(record: Mapping[str, Any]) -> str:
    terms = record.get("terms")
    return f"(it has {', '.join(terms)})" if terms else "(none of its terms is used)"


def _missing_package(run: Path, record: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with a package here; warn if its version is another one."""
    name, version = record["name"], record["version"]
    try:
        missing = importlib.util.find_spec(name) is None
    except ModuleNotFoundError:
        missing = True
    if missing:
        known = f" {version}" if version else ""
        return [f"{run}: was trained with package {name}{known} {_terms_of(record)}, which is not installed"]
    installed = _version(name)
    if installed != version:
        warnings.warn(f"{run}: was trained with {name} {version}, here it is {installed}", stacklevel=4)
    return []


def _used(container: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for group in MANY_TERMS:
        for key, settings in (container.get(group) or {}).items():
            yield REGISTERED_AS.get(group, group), str((settings or {}).get("term", key))
    for group in ONE_TERM:
        inner = container.get(group)
        while isinstance(inner, Mapping):  # an actuator may wrap another
            yield group, str(inner.get("term"))
            inner = inner.get("drive")


def _copy_of(run: Path, plugin: Plugin) -> bool:
    return plugin.file is not None and plugin.file.parent == (run / PLUGINS).resolve()


def _kept_file(run: Path, plugin: Plugin) -> dict[str, object]:
    """Copy a plugin's file, unless it is the run's copy already."""
    assert plugin.file is not None
    assert plugin.content is not None
    if _copy_of(run, plugin):
        for record in _records(run):
            if record.get("sha256") == plugin.sha256:
                return record
    target = run / PLUGINS / plugin.file.name
    if target.is_file() and plugins.sha256(target) != plugin.sha256:  # two plugins with one name
        target = target.with_stem(f"{target.stem}_{str(plugin.sha256)[:8]}")
    target.parent.mkdir(exist_ok=True)
    if not target.is_file():
        partial = target.with_suffix(".partial")
        partial.write_bytes(plugin.content)
        partial.replace(target)
    return {"name": plugin.name, "file": target.relative_to(run).as_posix(), "sha256": plugin.sha256}


def _kept_package(plugin: Plugin) -> dict[str, object]:
    """Say which package it is: its version, and its commit if it lies in a git repository."""
    spec = importlib.util.find_spec(plugin.module)
    commit = _git("rev-parse", "HEAD", folder=Path(spec.origin).parent) if spec is not None and spec.origin else None
    return {"name": plugin.name, "version": _version(plugin.module), "commit": commit}


def _version(module: str) -> str | None:
    root = module.split(".")[0]
    for distribution in importlib.metadata.packages_distributions().get(root, []):
        return importlib.metadata.version(distribution)
    try:
        return getattr(importlib.import_module(root), "__version__", None)
    except Exception:  # loading it properly says what is wrong
        return None
