"""What goes with error and falls: settings that were swept, and what was drawn for each robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from go1exp.evaluate.quantities import ROBOT, Column
from go1exp.evaluate.report.evaluations import Evaluated, Judged, draws
from go1exp.evaluate.report.figures import means
from go1exp.evaluate.report.groups import Group
from go1exp.evaluate.statistics.association import Association, associations
from go1exp.evaluate.statistics.compare import holm

Source = Literal["setting", "drawn"]


@dataclass(frozen=True)
class Sensitivity:
    """One quantity and one figure.

    Attributes:
        source: a setting that was swept (over runs), or what was drawn for a robot (over robots).
        column: the figure.
        association: how they go together.
        adjusted_p: after Holm's correction over the quantities of the same source and figure.
    """

    source: Source
    column: Column
    association: Association
    adjusted_p: float


def sensitivities(judged: Judged, made: Sequence[Group]) -> list[Sensitivity]:
    """Return what goes with the main figures of an evaluation."""
    columns = [c for c in judged.columns if c.name in judged.main]
    entries: list[Sensitivity] = []
    for column in columns:
        entries += _corrected("setting", column, _of_settings(judged, made, column))
        entries += _corrected("drawn", column, _of_draws(judged, column))
    return entries


def _corrected(source: Source, column: Column, those: Sequence[Association]) -> list[Sensitivity]:
    adjusted = holm([a.p for a in those])
    return [Sensitivity(source, column, a, p) for a, p in zip(those, adjusted, strict=True)]


def _of_settings(judged: Judged, made: Sequence[Group], column: Column) -> list[Association]:
    """Return how each swept key goes with a figure of runs."""
    if len(made) < 2:
        return []
    figure = np.concatenate([means(judged, group, column) for group in made])
    quantities = {
        key: _quantity([group.settings[key] for group in made for _ in group.runs]) for key in made[0].settings
    }
    return associations(quantities, figure)


def _quantity(values: Sequence[Any]) -> NDArray[Any]:
    """Return values as numbers where all are; else as names."""
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    return np.array(values, dtype=np.float64) if numbers else np.array([str(v) for v in values])


def _of_draws(judged: Judged, column: Column) -> list[Association]:
    """Return how each drawn quantity goes with a figure of robots.

    Policies of one evaluation met the same robots, which are one observation: its figure is the mean over runs of what
    each robot had beyond the mean of its run under the same command.
    """
    names: list[str] = []
    robots: dict[tuple[float, ...], list[float]] = {}
    for evaluated in judged.runs.values():
        if column.name not in evaluated.table:
            continue
        drawn = draws(evaluated)
        names = names or list(drawn)
        if not drawn or set(drawn) != set(names):
            continue  # trained, and therefore evaluated, with another randomisation
        beyond = _beyond_mean(evaluated, judged.keys, column)
        keys = [evaluated.table[k] for k in (*judged.keys, ROBOT) if evaluated.table[k].dtype.kind == "f"]
        table = np.column_stack([*(drawn[name] for name in names), *keys])
        for row, value in zip(table.tolist(), beyond.tolist(), strict=True):
            robots.setdefault(tuple(row), []).append(value)
    if not names:
        return []
    table = np.array([row[: len(names)] for row in robots])
    figure = np.array([_mean(values) for values in robots.values()])
    return associations({name: table[:, k] for k, name in enumerate(names)}, figure)


def _mean(values: Sequence[float]) -> float:
    known = [v for v in values if np.isfinite(v)]
    return float(np.mean(known)) if known else np.nan


def _beyond_mean(evaluated: Evaluated, keys: Sequence[str], column: Column) -> NDArray[np.float64]:
    """Return a column (n,) less its mean over the robots of the same condition."""
    values = evaluated.table[column.name].astype(np.float64)
    conditions = np.stack([np.unique(evaluated.table[k], return_inverse=True)[1] for k in keys], axis=1)
    _, which = np.unique(conditions, axis=0, return_inverse=True)
    which = which.ravel()
    known = np.isfinite(values)
    counts = np.maximum(np.bincount(which[known], minlength=which.max() + 1), 1)
    centres = np.bincount(which[known], values[known], minlength=which.max() + 1) / counts
    return np.asarray(values - centres[which])
