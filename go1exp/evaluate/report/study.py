"""Training runs below any folders, and groups of runs that share a configuration but for the seed."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from go1exp.base.wording import counted
from go1exp.config.schema.registry import ConfigError
from go1exp.train import run_state

SWEEP = "sweep.json"  # index of a sweep, in its folder; any folder of runs will do without it

WITHOUT = (
    *("seed", "resume", "logger", "checkpoint", "torch_threads", "device", "devices", "plugins", "eval", "video"),
    *("stop", "backend.threads", "backend.device"),
)
"""Keys that change what a run saves or where it runs, and not what is learnt; and paths."""

LONGEST = 70  # letters of a name made of keys; the name of the sweep's job, or a number, replaces a longer one

COMPARABLE = {
    "reward": "returns are of different rewards",
    "command": "training commands differ, so that returns and lengths are of different tasks",
    "terrain": "training ground differs, so that returns and lengths are of different tasks",
}
"""Section whose difference makes learning curves incomparable -> note."""


@dataclass(frozen=True)
class Run:
    """One training run."""

    folder: Path
    label: str  # unique name in reports
    config: dict[str, Any]
    seed: int
    state: str  # done, running, stopped, failed, or not started
    cause: str = ""  # reason of a failure
    job: str = ""  # name in the sweep; empty without one


@dataclass(frozen=True)
class Absent:
    """A run or job without results, or that is excluded: its name, its state, and the reason."""

    label: str
    state: str
    cause: str


@dataclass
class Study:
    """Contents of folders."""

    runs: list[Run]
    absent: list[Absent] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class Group:
    """Runs that differ in their seed alone."""

    name: str
    settings: dict[str, object]  # keys in which groups differ, with this group's values; "-" for a missing key
    runs: list[Run]


def study(folders: Sequence[str], unfinished: bool) -> Study:
    """Return the runs below ``folders``, each once; those not done if ``unfinished``; raise ConfigError without any."""
    given = [Path(folder) for folder in folders]
    if missing := [f"folders: {str(f)!r}: {_no_folder(f)}" for f in given if not f.is_dir()]:
        raise ConfigError(missing)
    jobs: dict[Path, Absent] = {}  # jobs of sweeps by their run folders
    notes: list[str] = []
    places: dict[Path, Path] = {}  # resolved -> as the user would name it
    empty = []
    for folder in given:
        below = list(_below(folder, jobs, notes))
        places |= {place.resolve(): place for place in below if place.resolve() not in places}
        if not below and not any(place.is_relative_to(folder.resolve()) for place in jobs):
            empty.append(f"folders: {str(folder)!r}: there is no run in it (no folder with config.yaml)")
    if empty:
        raise ConfigError(empty)
    runs, absent = _read(places, jobs)
    waiting = [
        Absent(job.label or place.name, job.state, job.cause or "has no run folder yet")
        for place, job in jobs.items()
        if place not in places
    ]
    return _included(runs, waiting + absent, list(dict.fromkeys(notes)), unfinished)


def _no_folder(place: Path) -> str:
    if not place.exists():
        return "there is no such folder"
    return "is a file; give a run folder (with config.yaml), a sweep, or a folder above them, such as runs"


def _below(folder: Path, jobs: dict[Path, Absent], notes: list[str]) -> Iterator[Path]:
    """Yield the run folders in and below a folder; collect the jobs of sweeps, and notes on damaged indices."""
    for place, below, files in os.walk(folder):
        path = Path(place)
        if SWEEP in files:
            jobs.update(_jobs(path, notes))
        if "config.yaml" in files:
            yield path
            below.clear()
        below[:] = sorted(name for name in below if not name.startswith("."))


def _jobs(sweep: Path, notes: list[str]) -> Iterator[tuple[Path, Absent]]:
    """Yield run folder and job of a sweep's index; of a damaged one those before the damage, with a note."""
    try:
        for job in json.loads((sweep / SWEEP).read_text())["jobs"]:
            made = Absent(str(job["name"]), str(job["state"]), str(job.get("cause", "")))
            yield (sweep / job["run_folder"]).resolve(), made
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:100]}"
        lost = "names of jobs, and jobs without a run folder, are unknown"
        notes.append(f"{sweep / SWEEP}: is damaged ({reason}); {lost}")


def _read(places: dict[Path, Path], jobs: dict[Path, Absent]) -> tuple[list[Run], list[Absent]]:
    labels = _labels(list(places))
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
            state = "done" if job is None else job.state  # written by a version without a state file
        runs.append(Run(place, labels[place], config, seed, state, known.cause, job.label if job else ""))
    return runs, damaged


def _labels(places: Sequence[Path]) -> dict[Path, str]:
    """Return the shortest unique end of each path."""
    labels: dict[Path, str] = {}
    for place in places:
        length = 1
        ends = [other.parts for other in places if other != place]
        while length < len(place.parts) and any(e[-length:] == place.parts[-length:] for e in ends):
            length += 1
        labels[place] = "/".join(place.parts[-length:])
    return labels


def _included(runs: Sequence[Run], absent: list[Absent], notes: list[str], unfinished: bool) -> Study:
    kept: list[Run] = []
    for run in runs:
        begun = (run.folder / "metrics.csv").is_file() or any((run.folder / "checkpoints").glob("*.pt"))
        if begun and (run.state == "done" or unfinished):
            kept.append(run)
            continue
        reason = "is not done; unfinished=true includes it" if begun else "has no metrics.csv and no checkpoint"
        absent.append(Absent(run.label, run.state, run.cause or reason))
    if not kept:
        listed = "; ".join(f"{a.label}: {a.state} ({a.cause})" for a in absent[:5])
        raise ConfigError([f"folders: none of the {len(absent)} runs in them counts: {listed}"])
    return Study(kept, absent, notes)


def groups(study: Study) -> list[Group]:
    """Return the groups of a study in the order of their settings; repeated runs are excluded."""
    entries: dict[str, list[Run]] = {}
    settings: dict[str, dict[str, object]] = {}
    for run in study.runs:
        values = _flat(run.config)
        key = json.dumps(values, sort_keys=True, default=str)
        entries.setdefault(key, []).append(run)
        settings[key] = values
    keys = dict.fromkeys(key for values in settings.values() for key in values)
    dumped = {k: {json.dumps(v.get(k, "-"), sort_keys=True, default=str) for v in settings.values()} for k in keys}
    differing = [k for k in keys if len(dumped[k]) > 1]
    made = [Group("", {k: settings[key].get(k, "-") for k in differing}, _once(r, study)) for key, r in entries.items()]
    made.sort(key=_place)
    for group, name in zip(made, _names(made), strict=True):
        group.name = name
    sections = {key.partition(".")[0] for key in differing}
    study.notes += [text for section, text in COMPARABLE.items() if section in sections]
    if single := [g.name for g in made if len(g.runs) == 1]:
        listed = ", ".join(single[:4]) + (", ..." if len(single) > 4 else "")
        have = "has" if len(single) == 1 else "have"
        study.notes.append(
            f"{counted(len(single), 'group')} {have} one run, so the spread over seeds is unknown: {listed}"
        )
    return made


def baseline(made: Sequence[Group], wanted: str | None) -> Group:
    """Return the group named, or that with most runs, to compare others with; raise ConfigError unless one matches."""
    if wanted is None:
        return max(made, key=lambda g: len(g.runs))
    exact = [g for g in made if g.name == wanted]
    meant = exact or [g for g in made if wanted in g.name or _has(g, wanted)]
    if len(meant) != 1:
        those = "no group" if not meant else f"{len(meant)} groups"
        listed = ", ".join(repr(g.name) for g in meant or made)
        raise ConfigError([f"baseline = {wanted!r}: {those} of these: {listed}"])
    return meant[0]


def _has(group: Group, wanted: str) -> bool:
    """Return whether a group has the settings written as ``key=value, key=value``."""
    pairs = [part.strip().partition("=") for part in wanted.split(",")]
    return all(
        equals and key in group.settings and _as_text(group.settings[key]) == value for key, equals, value in pairs
    )


def _flat(config: Mapping[str, object], path: str = "") -> dict[str, object]:
    """Return every value of nested mappings by its path, without keys that do not change training; lists are values."""
    values: dict[str, object] = {}
    for key, value in config.items():
        name = f"{path}.{key}" if path else str(key)
        if name in WITHOUT:
            continue
        values |= _flat(value, name) if isinstance(value, Mapping) and value else {name: value}
    return values


def _as_text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _place(group: Group) -> list[tuple[int, float, str]]:
    """Return the sort key of a group: its settings, numbers by size and before names."""
    values = group.settings.values()
    return [(0, float(v), "") if isinstance(v, int | float) else (1, 0.0, _as_text(v)) for v in values]


def _once(runs: Sequence[Run], study: Study) -> list[Run]:
    """Return one run of each seed, the first: a repeated run is no independent sample."""
    by_seed: dict[int, Run] = {}
    for run in runs:
        first = by_seed.setdefault(run.seed, run)
        if first is not run:
            cause = f"has the settings and the seed {run.seed} of {first.label}; each seed counts once"
            study.absent.append(Absent(run.label, run.state, cause))
    return [by_seed[seed] for seed in sorted(by_seed)]


def _names(made: Sequence[Group]) -> list[str]:
    """Return a name for each group: of its job if unique and short, else of the settings that set it apart."""
    if len(made) == 1:
        return ["all runs"]
    by_jobs = [_by_job(group.runs) for group in made]
    if all(by_jobs) and len(set(by_jobs)) == len(made):
        return by_jobs
    usual = {key: Counter(_as_text(g.settings[key]) for g in made).most_common(1)[0][0] for key in made[0].settings}
    by_keys = [_by_keys(group, usual, len(made)) for group in made]
    names = []
    for number, (keys, job) in enumerate(zip(by_keys, by_jobs, strict=True), 1):
        if len(keys) <= LONGEST and by_keys.count(keys) == 1:
            names.append(keys)
        else:
            names.append(job if job and by_jobs.count(job) == 1 else f"{keys[: LONGEST - 6]}… ({number})")
    return names


def _by_keys(group: Group, usual: Mapping[str, str], count: int) -> str:
    """Return the settings of a group as text: all of few keys, of many those that most groups do not have."""
    few, known = len(group.settings) <= 2 or count == 2, _flat(group.runs[0].config)
    shown = {k: v for k, v in group.settings.items() if few or _as_text(v) != usual[k]}
    parts = [f"{k}={_as_text(v)}" for k, v in shown.items() if v != "-"]
    parts += [f"no {name}" for name in dict.fromkeys(_missing(k, known) for k, v in shown.items() if v == "-")]
    return ", ".join(parts) or "as most"


def _missing(key: str, known: Collection[str]) -> str:
    """Return the longest part of a key's path that a configuration does not have: a term, rather than each setting."""
    parts = key.split(".")
    paths = [".".join(parts[:length]) for length in range(1, len(parts) + 1)]
    absent = (p for p in paths if not any(name == p or name.startswith(f"{p}.") for name in known))
    return next(absent, key)


def _by_job(runs: Sequence[Run]) -> str:
    """Return the job name that runs of a sweep have in common, without their seeds."""
    names = {" ".join(_short(o) for o in run.job.split(" ") if not o.startswith("seed=")) for run in runs}
    return names.pop() if len(names) == 1 else ""


def _short(override: str) -> str:
    """Return an override without Hydra's plus and the folders of its group: ``ablation=none``."""
    key, equals, value = override.lstrip("+").partition("=")
    return f"{key.rpartition('/')[2]}{equals}{value}"
