"""Which runs there are: run folders below any folders, the jobs of sweeps, and what became of each."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from go1exp.config.schema.registry import ConfigError
from go1exp.train import run_state

SWEEP = "sweep.json"
"""Index of a sweep, in its folder; any folder of runs will do without it."""


@dataclass(frozen=True)
class Run:
    """One training run.

    Attributes:
        folder: its run folder.
        label: its name in reports, which no other run has.
        config: its resolved configuration.
        seed: of the training.
        state: done, running, stopped, failed, or not started.
        cause: why it failed.
        job: its name in the sweep; empty without one.
    """

    folder: Path
    label: str
    config: dict[str, Any]
    seed: int
    state: str
    cause: str = ""
    job: str = ""


@dataclass(frozen=True)
class Absent:
    """A run or job that does not count: its name, its state, and why."""

    label: str
    state: str
    cause: str


@dataclass
class Study:
    """What folders hold.

    Attributes:
        runs: those that count.
        absent: those that do not.
        notes: what a reader should know, one line each.
    """

    runs: list[Run]
    absent: list[Absent] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Job:
    name: str
    state: str
    cause: str
    folder: Path


def study(folders: Sequence[str], unfinished: bool) -> Study:
    """Return the runs below ``folders``, each once.

    Args:
        folders: run folders, sweeps, or folders above them.
        unfinished: count runs that are not done, too.

    Raises:
        ConfigError: if a folder is not there or holds no run, or if none of them has begun.
    """
    given = [Path(folder) for folder in folders]
    if missing := [f"folders: {str(f)!r}: {_why_none(f)}" for f in given if not f.is_dir()]:
        raise ConfigError(missing)
    jobs: dict[Path, _Job] = {}
    notes: list[str] = []
    places: dict[Path, Path] = {}  # resolved -> as the user would name it
    empty = []
    for folder in given:
        below = list(_below(folder, jobs, notes))
        places |= {place.resolve(): place for place in below if place.resolve() not in places}
        if not below and not any(job.folder.is_relative_to(folder.resolve()) for job in jobs.values()):
            empty.append(f"folders: {str(folder)!r}: there is no run in it (no folder with config.yaml)")
    if empty:
        raise ConfigError(empty)
    runs, damaged = _read(places, jobs)
    counted = _counted(runs, damaged, jobs, places, unfinished)
    counted.notes += dict.fromkeys(notes)  # folders that were given may cover each other
    return counted


def _why_none(place: Path) -> str:
    """Return why a place that is no folder holds no runs, and what would be right."""
    if not place.exists():
        return "there is no such folder"
    right = "a run folder (with config.yaml), a sweep, or a folder above them, such as runs"
    return f"is a file; give {right}"


def _below(folder: Path, jobs: dict[Path, _Job], notes: list[str]) -> Iterator[Path]:
    """Yield the run folders in and below a folder; note the jobs of sweeps on the way, and indices that are damaged."""
    for place, below, files in os.walk(folder):
        path = Path(place)
        if SWEEP in files:
            jobs.update({job.folder: job for job in _jobs(path, notes)})
        if "config.yaml" in files:
            yield path
            below.clear()
        below[:] = sorted(name for name in below if not name.startswith("."))


def _jobs(sweep: Path, notes: list[str]) -> Iterator[_Job]:
    """Yield the jobs of a sweep's index; of one that cannot be read those before the damage, and note it."""
    try:
        for job in json.loads((sweep / SWEEP).read_text())["jobs"]:
            yield _Job(
                str(job["name"]), str(job["state"]), str(job.get("cause", "")), (sweep / job["run_folder"]).resolve()
            )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:100]}"
        notes.append(
            f"{sweep / SWEEP}: is damaged ({reason}); names of jobs, and those that have not begun, are not known"
        )


def _read(places: dict[Path, Path], jobs: dict[Path, _Job]) -> tuple[list[Run], list[Absent]]:
    """Return the runs in these folders, and those whose configuration is damaged."""
    labels = _labels(list(places.values()))
    damaged, runs = [], []
    for place, shown in places.items():
        try:
            config = yaml.load((place / "config.yaml").read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
            seed = int(config["seed"])
        except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError):
            cause = f"{shown / 'config.yaml'} is not the configuration of a run"
            damaged.append(Absent(labels[place], "damaged", cause))
            continue
        known, job = run_state.read(place), jobs.get(place)
        state: str = known.state
        if state == "not started" and (place / "metrics.csv").is_file():
            state = "done" if job is None else job.state  # of a version that kept no state
        runs.append(Run(place, labels[place], config, seed, state, known.cause, job.name if job else ""))
    return runs, damaged


def _labels(places: Sequence[Path]) -> dict[Path, str]:
    """Return the shortest ends of the paths that tell the folders apart."""
    parts = {place.resolve(): place.resolve().parts for place in places}
    labels: dict[Path, str] = {}
    for place, names in parts.items():
        length = 1
        while length < len(names) and any(
            other != place and theirs[-length:] == names[-length:] for other, theirs in parts.items()
        ):
            length += 1
        labels[place] = "/".join(names[-length:])
    return labels


def _counted(
    runs: list[Run], damaged: list[Absent], jobs: dict[Path, _Job], places: dict[Path, Path], unfinished: bool
) -> Study:
    """Return the runs that count, and the others with their reasons."""
    kept: list[Run] = []
    absent = [
        Absent(job.name or job.folder.name, job.state, job.cause or "has no run folder yet")
        for job in jobs.values()
        if job.folder not in places
    ]
    absent += damaged
    for run in runs:
        begun = (run.folder / "metrics.csv").is_file() or any((run.folder / "checkpoints").glob("*.pt"))
        if not begun:
            absent.append(Absent(run.label, run.state, run.cause or "has no metrics.csv and no checkpoint"))
        elif run.state != "done" and not unfinished:
            absent.append(Absent(run.label, run.state, run.cause or "is not done; unfinished=true counts it"))
        else:
            kept.append(run)
    if not kept:
        listed = "; ".join(f"{a.label}: {a.state} ({a.cause})" for a in absent[:5])
        raise ConfigError([f"folders: none of the {len(absent)} runs in them counts: {listed}"])
    return Study(kept, absent)
