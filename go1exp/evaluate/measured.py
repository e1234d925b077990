"""Measures of gait and contact as plain data of a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from go1exp.config.schema.registry import Term
from go1exp.evaluate.statistics.intervals import Interval, mean_interval, phase_interval, share_interval
from go1exp.mdp.measures import measured, per_foot
from go1exp.mdp.measures.trace import Trace

DIGITS = 6
"""Significant digits of a figure."""


def described(terms: Sequence[Term], trace: Trace) -> dict[str, Any]:
    """Return each measure's mean over robots with its 95 % interval and n; lists of four for feet.

    A measure whose unit is ``name`` gives the number of robots by name; one that needs what was not recorded, None.
    """
    report: dict[str, Any] = {}
    values = measured(trace, list(terms))
    for term in terms:
        mean = phase_interval if term.entry.traits.get("circular") else mean_interval
        each = values[term.key]
        if each is None:
            report[term.key] = None
        elif each.dtype.kind == "U":
            report[term.key] = dict(Counter(str(name) for name in each if name).most_common())
        elif per_foot(term.entry):
            feet = [_plain(mean(foot)) for foot in each.T]
            report[term.key] = {name: [foot[name] for foot in feet] for name in feet[0]}
        else:
            report[term.key] = _plain(mean(each))
    return report


def interval(count: int, n: int) -> dict[str, Any]:
    """Return a share of robots with Wilson's 95 % interval."""
    return _plain(share_interval(count, n), "share")


def _plain(interval: Interval, name: str = "mean") -> dict[str, Any]:
    """Return an interval for JSON, None where it is not defined."""
    numbers = {name: interval.estimate, "low": interval.low, "high": interval.high}
    plain = {k: float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None for k, v in numbers.items()}
    return {**plain, "n": interval.n}
