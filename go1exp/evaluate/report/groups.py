"""Runs of one configuration but for the seed are a group, and groups are named by the keys that differ."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from go1exp.config.schema.registry import ConfigError
from go1exp.evaluate.report.runs import Absent, Run, Study

WITHOUT = (
    *("seed", "resume", "logger", "checkpoint", "torch_threads", "device", "devices", "plugins", "eval", "video"),
    *("stop", "backend.threads", "backend.device"),
)
"""Keys that change what a run leaves behind or where it runs, and not what is learnt; and paths."""

LONGEST = 70
"""Letters of a name made of keys; the name of the sweep's job, or a number, stands for a longer one."""

COMPARABLE = {
    "reward": "returns are of different rewards",
    "command": "training commands differ, so that returns and lengths are of different tasks",
    "terrain": "training ground differs, so that returns and lengths are of different tasks",
}
"""Sections whose difference makes learning curves those of other tasks, and how that is put."""

Flat = dict[str, Any]


@dataclass
class Group:
    """Runs that differ in their seed alone.

    Attributes:
        name: which no other group has.
        settings: keys in which groups differ, with this one's values; "-" for one that it does not have.
        runs: by seed.
    """

    name: str
    settings: dict[str, Any]
    runs: list[Run]


def flat(config: Mapping[str, Any], path: str = "") -> Flat:
    """Return every value of nested mappings by its path, without what is not learnt; lists are values."""
    values: Flat = {}
    for key, value in config.items():
        name = f"{path}.{key}" if path else str(key)
        if name in WITHOUT:
            continue
        if isinstance(value, Mapping) and value:
            values |= flat(value, name)
        else:
            values[name] = value
    return values


def _as_text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def groups(study: Study) -> list[Group]:
    """Return the groups of a study in the order of their settings; runs that repeat another are left out."""
    entries: dict[str, list[Run]] = {}
    settings: dict[str, Flat] = {}
    for run in study.runs:
        values = flat(run.config)
        key = json.dumps(values, sort_keys=True, default=str)
        entries.setdefault(key, []).append(run)
        settings[key] = values
    differing = _differing(list(settings.values()))
    made = []
    for key, runs in entries.items():
        own_values = {k: settings[key].get(k, "-") for k in differing}
        made.append(Group("", own_values, _once(runs, study)))
    made.sort(key=_place)
    for group, name in zip(made, _names(made), strict=True):
        group.name = name
    study.notes += _notes(made)
    return made


def _place(group: Group) -> list[tuple[int, float, str]]:
    """Return where a group stands among others: by its settings, numbers by their size and before names."""
    numbers = [isinstance(v, int | float) for v in group.settings.values()]
    pairs = zip(numbers, group.settings.values(), strict=True)
    return [(0, float(v), "") if is_number else (1, 0.0, _as_text(v)) for is_number, v in pairs]


def _differing(settings: Sequence[Flat]) -> list[str]:
    keys = dict.fromkeys(key for values in settings for key in values)
    return [k for k in keys if len({json.dumps(v.get(k, "-"), sort_keys=True, default=str) for v in settings}) > 1]


def _once(runs: list[Run], study: Study) -> list[Run]:
    """Return one run of each seed, the first; a second one is the same study twice and would count as independent."""
    by_seed: dict[int, Run] = {}
    for run in runs:
        first = by_seed.setdefault(run.seed, run)
        if first is not run:
            cause = f"has the settings and the seed {run.seed} of {first.label}; each seed counts once"
            study.absent.append(Absent(run.label, run.state, cause))
    return [by_seed[seed] for seed in sorted(by_seed)]


def _names(made: Sequence[Group]) -> list[str]:
    """Return a name for each group: its job's where sweeps name all of them apart, else the settings that are its own.

    Where those are many, the job's name stands for them alone.
    """
    if len(made) == 1:
        return ["all runs"]
    by_jobs = [_by_job(group.runs) for group in made]
    if all(by_jobs) and len(set(by_jobs)) == len(made):
        return by_jobs
    usual = {key: Counter(_as_text(g.settings[key]) for g in made).most_common(1)[0][0] for key in made[0].settings}
    by_keys = [_by_keys(group.settings, usual, len(made), flat(group.runs[0].config)) for group in made]
    names = []
    for number, (keys, job) in enumerate(zip(by_keys, by_jobs, strict=True), 1):
        if len(keys) <= LONGEST and by_keys.count(keys) == 1:
            names.append(keys)
        elif job and by_jobs.count(job) == 1:
            names.append(job)
        else:
            names.append(f"{keys[: LONGEST - 6]}… ({number})")
    return names


def _by_keys(values: Mapping[str, Any], usual: Mapping[str, str], count: int, known: Flat) -> str:
    """Write the settings of a group: all of few keys, of many those that are not what most groups have."""
    few = len(values) <= 2 or count == 2
    shown = {k: v for k, v in values.items() if few or _as_text(v) != usual[k]}
    parts = [f"{k}={_as_text(v)}" for k, v in shown.items() if v != "-"]
    parts += [f"no {name}" for name in dict.fromkeys(_missing(k, known) for k, v in shown.items() if v == "-")]
    return ", ".join(parts) or "as most"


def _missing(key: str, known: Flat) -> str:
    """Return the longest part of a key's path that a configuration lacks: a term, rather than each of its settings."""
    parts = key.split(".")
    for length in range(1, len(parts) + 1):
        path = ".".join(parts[:length])
        if not any(name == path or name.startswith(f"{path}.") for name in known):
            return path
    return key


def _by_job(runs: Sequence[Run]) -> str:
    """Return the job name that runs of a sweep have in common, without their seeds."""
    names = {" ".join(_short(o) for o in run.job.split(" ") if not o.startswith("seed=")) for run in runs}
    return names.pop() if len(names) == 1 else ""


def _short(override: str) -> str:
    """Return an override without Hydra's plus and the folders of its group: ``ablation=none``."""
    key, equals, value = override.lstrip("+").partition("=")
    return f"{key.rpartition('/')[2]}{equals}{value}"


def _notes(made: Sequence[Group]) -> list[str]:
    sections = {key.partition(".")[0] for key in made[0].settings} if made else set()
    notes = [text for section, text in COMPARABLE.items() if section in sections]
    single = [g.name for g in made if len(g.runs) == 1]
    if single:
        listed = ", ".join(single[:4]) + (", ..." if len(single) > 4 else "")
        notes.append(f"{len(single)} groups have one run, which tells nothing of other seeds: {listed}")
    return notes


def baseline(made: Sequence[Group], wanted: str | None) -> Group:
    """Return the group that others are compared with.

    Raises:
        ConfigError: if none, or more than one, is meant.
    """
    if wanted is None:
        most = max(len(g.runs) for g in made)
        return next(g for g in made if len(g.runs) == most)
    exact = [g for g in made if g.name == wanted]
    meant = exact or [g for g in made if wanted in g.name or _has(g, wanted)]
    if len(meant) != 1:
        those = "no group" if not meant else f"{len(meant)} groups"
        listed = ", ".join(repr(g.name) for g in meant or made)
        raise ConfigError([f"baseline = {wanted!r}: {those} of these: {listed}"])
    return meant[0]


def _has(group: Group, wanted: str) -> bool:
    """Whether a group has the settings written as ``key=value, key=value``."""
    pairs = [part.strip().partition("=") for part in wanted.split(",")]
    return all(
        equals and key in group.settings and _as_text(group.settings[key]) == value for key, equals, value in pairs
    )
