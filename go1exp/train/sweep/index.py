"""``sweep.json``: which jobs a sweep has, with what overrides, where each one's run folder is, what became of it.

A job's state is what its run folder says (``go1exp/train/run_state.py``); the file has it as of the last time that
something changed while a launcher watched. ``read`` looks again.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from go1exp.base.errors import Expected
from go1exp.base.files import write_json
from go1exp.train import run_state

FILE = "sweep.json"
FORMAT = 1

JobState = Literal["waiting", "running", "done", "failed"]

LONGEST = 100
"""Letters of a run folder's name; a longer one ends in a part of its own hash."""


@dataclass(frozen=True)
class Job:
    """One training of a sweep.

    Attributes:
        number: place in the sweep, from 0.
        name: the overrides that tell it from the others; empty in a sweep of one job.
        overrides: all of its overrides, those that jobs have in common too.
        state: waiting (not begun, or stopped with a checkpoint), running, done, or failed.
        run_folder: relative to the sweep's folder.
        cause: why it failed, or stopped; one line.
    """

    number: int
    name: str
    overrides: tuple[str, ...]
    run_folder: str
    state: JobState = "waiting"
    cause: str = ""


@dataclass(frozen=True)
class Index:
    """The content of ``sweep.json``.

    Attributes:
        jobs: in the order of their numbers.
        launcher: settings of the launcher that ran the sweep last, with its ``name``.
        cwd: absolute path of the folder from which the jobs run: relative paths in their settings start there.
    """

    jobs: tuple[Job, ...]
    launcher: Mapping[str, Any]
    cwd: str
    format: int = field(default=FORMAT)


def read(folder: Path) -> Index:
    """Return a sweep's index, with the states that its run folders have now.

    Raises:
        Expected: if ``folder`` is no sweep folder, or its index is damaged.
    """
    try:
        content = json.loads((folder / FILE).read_text())
        if content["format"] != FORMAT:
            raise Expected(f"{folder / FILE}: has format {content['format']}; this version reads {FORMAT}")
        jobs = tuple(Job(**{**job, "overrides": tuple(job["overrides"])}) for job in content["jobs"])
        index = Index(jobs, content["launcher"], content["cwd"])
    except FileNotFoundError:
        raise Expected(f"{folder}: not a sweep folder (it has no {FILE})") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise Expected(f"{folder / FILE}: is damaged ({type(error).__name__}: {error})") from None
    return looked_at(index, folder)


def write(folder: Path, index: Index) -> None:
    """Write a sweep's index, whole or not at all.

    Raises:
        OSError: if it cannot be written; the older file stays.
    """
    write_json(folder / FILE, asdict(index))


def looked_at(index: Index, folder: Path, causes: Mapping[str, str] | None = None) -> Index:
    """Return the index with the states that the run folders have now.

    Args:
        index: with older states.
        folder: of the sweep.
        causes: run folder -> what a job said last, for those whose folder could not take it (a full disk).
    """
    return replace(index, jobs=tuple(_now(job, folder, (causes or {}).get(job.run_folder, "")) for job in index.jobs))


def _now(job: Job, folder: Path, heard: str) -> Job:
    known = run_state.read(folder / job.run_folder)
    if known.state == "failed":
        return replace(job, state="failed", cause=heard if heard and known.cause == run_state.KILLED else known.cause)
    if known.state == "done":
        return replace(job, state="done", cause="")
    if known.state == "running":
        return replace(job, state="running", cause="")
    if known.state == "stopped":
        if job.state == "done":  # a search ended it early
            return job
        return replace(job, state="waiting", cause="stopped; goes on from its checkpoint")
    heard = heard or (job.cause if job.state == "failed" else "")
    return replace(job, state="failed", cause=heard) if heard else replace(job, state="waiting", cause="")


def folder_names(names: Sequence[str]) -> list[str]:
    """Return names of folders for jobs: letters that neither a shell nor Hydra's grammar reads as its own.

    ``experiment=ablation/no_gait seed=0`` becomes ``experiment-ablation-no_gait_seed-0``, and a group's key loses
    what stands before its last slash. Two jobs never share a folder, whatever their overrides.
    """
    taken: set[str] = set()
    folders = []
    for name in names:
        plain = _plain(name) or "run"
        if len(plain) > LONGEST:
            plain = f"{plain[: LONGEST - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
        unique, copy = plain, 2
        while unique in taken:
            unique, copy = f"{plain}-{copy}", copy + 1
        taken.add(unique)
        folders.append(unique)
    return folders


BRACKETS = "[]{}()'\""
"""Round values of several words."""


def _plain(name: str) -> str:
    parts = []
    for override in name.split(" "):
        key, equals, value = override.partition("=")
        key = key.lstrip("+").rsplit("/", 1)[-1].replace("~", "no-")
        text = f"{key}{'-' if equals else ''}{value.strip(BRACKETS)}"
        parts.append(re.sub(r"[^A-Za-z0-9_.+-]+", "-", text).strip("-"))
    return "_".join(part for part in parts if part).lstrip(".")
