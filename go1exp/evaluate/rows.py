"""Rows of an evaluation, one for each robot, and the files that hold them (``eval.json``, ``eval.parquet``)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from go1exp import robot
from go1exp.base.files import replacing, write_json
from go1exp.evaluate.quantities import FELL, MOVING, ROBOT, Column, Row, add_measures

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.sim.env.core import Go1Core

DRAW = "draw."
"""First part of the name of a column with something that was drawn for the robot."""

ERRORS = (
    Column("error_xy", "m/s", "root mean square error of the horizontal velocity", better="lower"),
    Column("error_x", "m/s", "root mean square error of the forward velocity", better="lower"),
    Column("error_y", "m/s", "root mean square error of the lateral velocity", better="lower"),
    Column("error_yaw", "rad/s", "root mean square error of the yaw rate", better="lower"),
)

COLUMNS = (FELL, MOVING, *ERRORS)
"""Figures of a row beside its measures."""

KEYS = ("x", "y", "yaw")
"""Columns that say the command: m/s, m/s, rad/s."""

SEPARATE = 3
"""A draw of more numbers than these stands as their mean and their range."""


def rows_of(
    commands: NDArray[np.float64],
    episodes: int,
    errors: NDArray[np.float64],
    fell: NDArray[np.bool_],
    moving_s: NDArray[np.float64],
    draws: Mapping[str, NDArray[np.float64]],
    measures: Mapping[str, Any],
) -> list[dict[str, Any]]:
    """Return a row of plain data for each of N robots.

    Args:
        commands: (N, 3), m/s, m/s, rad/s.
        episodes: robots of each command, neighbours; the k-th of each has the number k in its row.
        errors: root mean square errors (N, 3), NaN where there is none.
        fell: (N,).
        moving_s: time until a fall (N,), s.
        draws: what was drawn for the robots, (N,) each by name.
        measures: measures of gait and contact, (N,) or (N, 4) each by name.
    """
    planar = np.hypot(errors[:, 0], errors[:, 1])
    figures = np.column_stack([planar, errors])
    rows: list[dict[str, Any]] = [
        {
            **dict(zip(KEYS, map(float, commands[i]), strict=True)),
            ROBOT: i % episodes,
            FELL.name: bool(fell[i]),
            MOVING.name: round(float(moving_s[i]), 4),
            **{c.name: _number(v) for c, v in zip(ERRORS, figures[i], strict=True)},
            **{f"{DRAW}{name}": _number(values[i]) for name, values in draws.items()},
        }
        for i in range(len(fell))
    ]
    add_measures(rows, measures, robot.LEGS)
    return rows


def _number(value: float) -> float | None:
    return float(f"{value:.7g}") if np.isfinite(value) else None


def drawn(core: Go1Core) -> dict[str, NDArray[np.float64]]:
    """Return what was drawn for each of the N robots, (N,) by name: of randomised model fields and spread effects.

    A term stands for its first field: a few numbers that vary each by itself (``center_of_mass_x``), many as mean and
    range. To be called after a reset.
    """
    quantities: dict[str, Tensor] = {}
    for term in core.task.rand:
        if term.entry.traits["kind"] == "model":
            quantities[term.key] = core.backend.field(term.entry.traits["fields"][0])
    for key, effect in core.plant.effects.effects.items():
        widths = next(t.slots.get("spread", {}) for t in core.task.effect if t.key == key)
        quantities |= {f"{key}.{name}": getattr(effect, name) for name in widths}
    columns: dict[str, NDArray[np.float64]] = {}
    for name, values in quantities.items():
        columns |= _columns(name, values.detach().cpu().double().reshape(core.num_envs, -1).numpy())
    return columns


def _columns(name: str, values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the columns of one draw (N, K), of which only entries that vary over robots count."""
    varying = values[:, np.ptp(values, axis=0) > 0.0] if len(values) else values
    count = varying.shape[1]
    if not count:
        return {}
    if count == 1:
        return {name: varying[:, 0]}
    if count <= SEPARATE:
        parts = "xyz" if count == SEPARATE else "12"
        return {f"{name}_{part}": varying[:, k] for k, part in enumerate(parts)}
    return {f"{name}_mean": varying.mean(1), f"{name}_range": np.ptp(varying, axis=1)}


# ---------------------------------------------------------------------- files

FILE = "eval.json"
"""In a run folder; the rows are beside it."""


def rows_file(report: Path) -> Path:
    """Return the file of the rows that belong to a report."""
    return report.with_suffix(".parquet")


def write(report: dict[str, Any], out: Path) -> None:
    """Write a report of ``evaluate`` as JSON, and its rows as Parquet beside it, unless ``out`` is no plain file."""
    rows = report.pop("rows")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, report)
    if out.is_file():
        write_rows(rows_file(out), rows, {"protocol": "grid"})


def write_rows(file: Path, rows: Sequence[Row], about: dict[str, str]) -> None:
    """Write rows as Parquet, ``about`` as its metadata; a figure that is not defined is null."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = list(dict.fromkeys(name for row in rows for name in row))
    columns = {name: [finite(row.get(name)) for row in rows] for name in names}
    table = pa.table(columns).replace_schema_metadata({f"go1exp.{k}": v for k, v in about.items()})
    with replacing(file) as partial:
        pq.write_table(table, partial)


def finite(value: Any) -> Any:
    """Return plain data for JSON: numbers that are not finite as None, NumPy's as Python's."""
    if isinstance(value, dict):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
