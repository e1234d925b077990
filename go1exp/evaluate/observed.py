"""Columns of the terms in an observation."""

from __future__ import annotations

from go1exp.config import TaskConfig


def columns(task: TaskConfig, term: str) -> slice | None:
    """Return the columns of a term in the observation; None if the policy does not observe it."""
    start = 0
    for t in task.observation:
        size = int(t.entry.traits["size"])
        if t.entry.name == term:
            return slice(start, start + size)
        start += size
    return None
