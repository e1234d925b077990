"""Runs, shipped policies, recordings and folders for results, as they are named on the command line."""

from __future__ import annotations

import contextlib
import tempfile
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from go1exp.base.paths import data_root
from go1exp.config.schema.registry import ConfigError, unknown_name

if TYPE_CHECKING:
    from go1exp.logs.recording import Recording


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
    """Return the folder of the run or shipped policy that is meant, and the file for results: ``out``, or ``file``.

    That is in the run folder, or of a shipped policy in the present one. Raise ConfigError unless just one of ``run``
    and ``policy`` is given, or if ``out`` cannot be the name of a file.
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


FEWEST_ROWS = 4  # rows that a window must have


def files_of(places: str | Sequence[str]) -> list[Path]:
    """Return the recordings' files of a folder or file, or of several; raise RecordingError if a folder has none."""
    from go1exp.logs.recording import RecordingError

    files: list[Path] = []
    for path in map(Path, [places] if isinstance(places, str) else places):
        inside = sorted(path.glob("*.parquet"))
        if path.is_dir() and not inside:
            raise RecordingError(f"{path}: no *.parquet in it")
        files += inside if path.is_dir() else [path]
    return files


def writable(folder: str, key: str = "out") -> Path:
    """Make a folder for results before the work begins, and return it; raise ConfigError if it cannot be written to."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise ConfigError([f"{key} = {folder!r}: cannot be written to ({error.strerror})"]) from None
    return path


def remove_empty(folder: Path) -> None:
    """Delete a folder for results that got none, and the folders above it that hold nothing else."""
    with contextlib.suppress(OSError):  # the first that is not empty
        for path in (folder, *folder.parents):
            path.rmdir()


def long_enough(recordings: list[Recording], least: float) -> list[Recording]:
    """Return the recordings that windows of ``least`` s can be cut from; print which are left out, and why."""
    import numpy as np

    from go1exp.logs.audit.signals import Log
    from go1exp.logs.audit.single import wrong_steps

    fit = []
    for recording in recordings:
        t, name = recording.t, recording.meta.episode
        length, step = float(t[-1] - t[0]), float(np.median(np.diff(t))) if len(t) > 1 else 0.0
        short = length < least
        if not short and step <= least / FEWEST_ROWS:
            fit.append(recording)
            continue
        wrong = wrong_steps(Log(recording)) if len(t) > 1 else None
        window = f"windows take {least:g} s"
        why = f"{len(t)} rows, {length:g} s: too short; {window}" if short else f"t steps by {step:g} s; {window}"
        print(f"left out: {name}: " + (f"{len(t)} rows, {length:g} s; t {wrong}" if wrong else why))
    return fit


def read_all(places: str | Sequence[str]) -> list[Recording]:
    """Read the recordings of folders and files, each under a name of its own.

    Recordings of one name are named after their folders, too (``day1/run_0``), in one folder after their files. Raise
    RecordingError if one is missing or damaged, or given twice, also as a copy.
    """
    import numpy as np

    from go1exp.logs.recording import RecordingError, read

    files = files_of(places)
    twice = [str(path) for path, times in Counter(path.resolve() for path in files).items() if times > 1]
    if twice:
        raise RecordingError(f"{twice[0]}: given twice")
    recordings = [read(path) for path in files]
    shared = {name for name, times in Counter(r.meta.episode for r in recordings).items() if times > 1}
    if not shared:
        return recordings
    folders = _apart([path.resolve().parent for path in files])
    together: dict[tuple[str, str], list[int]] = {}  # by folder and name
    for k, recording in enumerate(recordings):
        together.setdefault((folders[k], recording.meta.episode), []).append(k)
    renamed = [_renamed(r, folder, shared) for r, folder in zip(recordings, folders, strict=True)]
    for (folder, _), (first, *others) in together.items():
        for k in others:
            if all(np.array_equal(x, recordings[first].channels.get(c, ())) for c, x in recordings[k].channels.items()):
                raise RecordingError(f"{files[k]}: is a copy of {files[first]}")
        for k in (first, *others) if others else ():
            meta = replace(renamed[k].meta, episode=f"{folder}/{files[k].stem}")
            renamed[k] = replace(renamed[k], meta=meta)
    return renamed


def names_of(files: Sequence[Path]) -> list[str]:
    """Return a name for each file: its stem, after the end of its folder's path where there are several folders."""
    folders = _apart([path.resolve().parent for path in files])
    return [f.stem if len({*folders}) == 1 else f"{folder}/{f.stem}" for f, folder in zip(files, folders, strict=True)]


def _apart(folders: list[Path]) -> list[str]:
    """Return the shortest ends of the paths by which the folders differ."""
    parts = next(n for n in count(1) if len({f.parts[-n:] for f in folders}) == len({*folders}))
    return ["/".join(folder.parts[-parts:]) for folder in folders]


def _renamed(recording: Recording, folder: str, shared: Collection[str]) -> Recording:
    """Return a recording whose name, and that of what it repeats, has its folder in it if others have that name."""
    meta, repeats = recording.meta, recording.meta.repeat_of
    episode = f"{folder}/{meta.episode}" if meta.episode in shared else meta.episode
    repeats = f"{folder}/{repeats}" if repeats in shared else repeats
    return replace(recording, meta=replace(meta, episode=episode, repeat_of=repeats))
