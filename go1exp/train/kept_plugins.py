"""What a run folder keeps of the plugins that it was trained with, and how they are there again for whoever reads it.

A file is copied to ``plugins/``; of a package, ``meta.json`` has version and commit. To read a run is to execute its
files.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import subprocess
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from go1exp.config.schema import plugins
from go1exp.config.schema.plugins import Plugin
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.task import MANY_TERMS, ONE_TERM, REGISTERED_AS

FOLDER = "plugins"
"""In the run folder."""


def keep(run: Path, container: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Copy the files of a configuration's plugins into ``run``; return what ``meta.json`` tells of all its plugins.

    One that the configuration does not name (of ``GO1EXP_PLUGINS`` or an entry point) counts if a term of it is used.

    Raises:
        ConfigError: if a plugin is missing.
        OSError: if a file cannot be written.
    """
    named = plugins.names(container.get(plugins.KEY))
    plugins.use(with_copies(run, container)[plugins.KEY])
    used = set(_used(container))
    records = []
    for plugin in plugins.in_force():
        terms = [f"{e.group}.{e.name}" for e in plugin.entries if (e.group, e.name) in used]
        if terms or plugin.name in named or _copy_of(run, plugin):
            records.append({**(_file(run, plugin) if plugin.file else _package(plugin)), "terms": terms})
    return records


def with_copies(run: Path, container: Mapping[str, Any]) -> dict[str, Any]:
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


def differing(run: Path, container: Mapping[str, Any]) -> list[str]:
    """Return the names of a configuration's plugins whose content is another than that of the run's copy."""
    kept = {r["name"]: r["sha256"] for r in _records(run) if "file" in r}
    given = [n for n in plugins.names(container.get(plugins.KEY)) if n in kept and Path(n).is_file()]
    return [name for name in given if plugins.sha256(Path(name)) != kept[name]]


def _records(run: Path) -> list[dict[str, Any]]:
    """What the run says of its plugins; older runs and shipped policies say nothing."""
    file = run / "meta.json"
    if not file.is_file():
        return []
    records: list[dict[str, Any]] = json.loads(file.read_text()).get("plugins", [])
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
    """Yield group and name of every term in a configuration."""
    for group in MANY_TERMS:
        for key, settings in (container.get(group) or {}).items():
            yield REGISTERED_AS.get(group, group), str((settings or {}).get("term", key))
    for group in ONE_TERM:
        inner: Any = container.get(group)
        while isinstance(inner, Mapping):  # an actuator may wrap another
            yield group, str(inner.get("term"))
            inner = inner.get("drive")


def _copy_of(run: Path, plugin: Plugin) -> bool:
    return plugin.file is not None and plugin.file.parent == (run / FOLDER).resolve()


def _file(run: Path, plugin: Plugin) -> dict[str, Any]:
    """Copy a plugin's file, unless it is the run's copy already."""
    assert plugin.file is not None
    assert plugin.content is not None
    if _copy_of(run, plugin):
        for record in _records(run):
            if record.get("sha256") == plugin.sha256:
                return record
    target = run / FOLDER / plugin.file.name
    if target.is_file() and plugins.sha256(target) != plugin.sha256:  # two plugins with one name
        target = target.with_stem(f"{target.stem}_{str(plugin.sha256)[:8]}")
    target.parent.mkdir(exist_ok=True)
    if not target.is_file():
        partial = target.with_suffix(".partial")
        partial.write_bytes(plugin.content)
        partial.replace(target)
    return {"name": plugin.name, "file": target.relative_to(run).as_posix(), "sha256": plugin.sha256}


def _package(plugin: Plugin) -> dict[str, Any]:
    """Say which package it is: its version, and its commit if it lies in a git repository."""
    spec = importlib.util.find_spec(plugin.module)
    commit = None
    if spec is not None and spec.origin:
        try:
            command = ["git", "-C", str(Path(spec.origin).parent), "rev-parse", "HEAD"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
            commit = done.stdout.strip()
        except (OSError, subprocess.SubprocessError):
            pass
    return {"name": plugin.name, "version": _version(plugin.module), "commit": commit}


def _version(module: str) -> str | None:
    """Return the version of the distribution that a module is of, or what the module itself says."""
    root = module.split(".")[0]
    for distribution in importlib.metadata.packages_distributions().get(root, []):
        return importlib.metadata.version(distribution)
    try:
        return getattr(importlib.import_module(root), "__version__", None)
    except Exception:  # loading it properly says what is wrong
        return None
