"""Measures of gait and contact: registered functions of one ``Trace``, a value for each robot, NaN where undefined.

Importing the package registers every measure, from this explicit list.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from go1exp.config.schema.registry import Entry, Term, members
from go1exp.mdp.measures import body, gait
from go1exp.mdp.measures.trace import NotMeasured, Trace

__all__ = ["NotMeasured", "Trace", "body", "gait", "measured"]


def every_measure() -> list[Term]:
    """Return all registered measures with their defaults."""
    return [Term(name, entry, entry.check({}, name)[0]) for name, entry in members("measure").items()]


def measured(trace: Trace, terms: list[Term] | None = None) -> dict[str, np.ndarray | None]:
    """Return each measure's values, None for one that needs a column which the trace does not have."""
    values: dict[str, np.ndarray | None] = {}
    for term in every_measure() if terms is None else terms:
        try:
            values[term.key] = term(trace)
        except NotMeasured:
            values[term.key] = None
    return values


def units() -> Mapping[str, str]:
    """Return the unit of each measure by its name."""
    return {name: str(entry.traits["unit"]) for name, entry in members("measure").items()}


def per_foot(entry: Entry) -> bool:
    """Return whether a measure has a value for each foot, and not one for the robot."""
    return entry.traits.get("per", "robot") == "foot"
