"""Runs, shipped policies and checkpoints as they are named on the command line; nothing heavy is imported."""

from __future__ import annotations

from pathlib import Path

from go1exp.base.paths import data_root
from go1exp.config.schema.registry import ConfigError, unknown_name


def run_folder(path: str, key: str = "run") -> Path:
    """Return the run folder ``path``; raise ConfigError if it is none, before anything heavy is imported."""
    folder = Path(path)
    if not (folder / "config.yaml").is_file():
        why = "it has no config.yaml" if folder.is_dir() else "a file" if folder.exists() else "there is no such folder"
        raise ConfigError([f"{key} = {path!r}: not a run folder ({why})"])
    return folder


def shipped_policies() -> dict[str, Path]:
    """Return the run folders of the policies that come with the package, by name."""
    return {f.parent.name: f.parent for f in sorted((data_root() / "assets" / "policies").glob("*/config.yaml"))}


def trained(run: str | None, policy: str | None, file: str, out: str | None) -> tuple[Path, Path]:
    """Return the folder of the run or of the shipped policy that is meant, and the file that results go to.

    Args:
        run: run folder.
        policy: name of a shipped policy, in its place.
        file: what the results are called, in the run folder; those of a shipped policy go to the present one.
        out: the user's own file.

    Raises:
        ConfigError: unless there is exactly one of the two, or if ``out`` cannot be the name of a file.
    """
    if run is None and policy is None:
        raise ConfigError(["run: required, such as run=runs/NAME, or a shipped policy, such as policy=paper"])
    if run is not None and policy is not None:
        raise ConfigError([f"run = {run!r} and policy = {policy!r}: only one of them"])
    if out and Path(out).is_dir():
        raise ConfigError([f"out = {out!r}: is a folder; name the file, such as out={Path(out) / file}"])
    if policy is None:
        assert run is not None
        folder = run_folder(run)
        return folder, Path(out or folder / file)
    known = shipped_policies()
    if policy not in known:
        hint = f"; for a run folder use run={policy}" if (Path(policy) / "config.yaml").is_file() else ""
        raise ConfigError([unknown_name("policy", policy, known, "shipped policy") + hint])
    return known[policy], Path(out or f"{policy}_{file}")


def checkpoint_file(run: Path, name: str | None) -> Path | None:
    """Return the checkpoint ``name``, looked for in the run folder, its ``checkpoints/`` and as it stands."""
    if name is None:
        return None
    places = [run / name, run / "checkpoints" / name, Path(name)]
    file = next((p for p in places if p.is_file()), None)
    if file is None:
        existing = ", ".join(p.name for p in sorted((run / "checkpoints").glob("*.pt"))) or "none"
        raise ConfigError([f"checkpoint = {name!r}: no such file in {run}; it has {existing}"])
    return file
