"""What became of a run: ``state.json`` in its folder, for sweeps, reports, and whoever looks at a cluster's jobs."""

from __future__ import annotations

import contextlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from go1exp.base.files import write_json
from go1exp.train import run_lock

FILE = "state.json"
KILLED = "was killed"
"""Cause of what ended without a word."""

State = Literal["running", "done", "stopped", "failed", "not started"]


@dataclass(frozen=True)
class RunState:
    """A run's state, and why if it failed."""

    state: State
    cause: str = ""


def write(run: Path, state: State, cause: str = "") -> None:
    """Note the state; ``cause`` is the message of an error.

    Raises:
        OSError: if it cannot be written.
    """
    write_json(run / FILE, asdict(RunState(state, cause)))


def note_failure(run: Path, cause: str) -> None:
    """Note that a run failed, if that can be written: a full disk may be the cause itself."""
    with contextlib.suppress(OSError):
        write(run, "failed", cause)


def read(run: Path) -> RunState:
    """Return the state of a run; of one that was killed, which could not say so, ``failed``."""
    try:
        content = json.loads((run / FILE).read_text())
        known = RunState(content["state"], content["cause"])
    except (OSError, ValueError, KeyError, TypeError):
        return RunState("not started")
    if known.state == "running" and not run_lock.in_use(run):
        return RunState("failed", KILLED)
    return known
