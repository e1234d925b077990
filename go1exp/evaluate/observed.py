"""What a policy observes: columns of the terms, and which velocity of the trunk."""

from __future__ import annotations

from typing import Literal

from go1exp.config.schema.history import frame_width, width
from go1exp.sim.task import TaskConfig

TrunkVelocity = Literal["exact", "estimated"]
"""Velocity of the trunk that is observed: the true one, or what the filter makes of the sensors."""


def columns(task: TaskConfig, term: str) -> slice | None:
    """Return the columns of a term's newest values in the observation; None if the policy does not observe it."""
    start = 0
    for t in task.observation:
        if t.entry.name == term:
            return slice(start, start + frame_width(t))
        start += width(t)
    return None
