"""Rows, one for each robot in each condition: figures with n and a 95 % interval, and the files that hold them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from go1exp import robot
from go1exp.base.files import replacing, write_json
from go1exp.config.schema.registry import Term
from go1exp.evaluate.statistics import intervals
from go1exp.evaluate.statistics.intervals import Estimate, Interval, SummaryEntry
from go1exp.mdp.measures import measured, per_foot
from go1exp.mdp.measures.trace import Trace

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.sim.env.core import Go1Core

Row = dict[str, Any]
Summary = Sequence[SummaryEntry]  # of one subject
Summaries = Mapping[str, Summary]  # by the subject's label
Condition = tuple[float | str, ...]  # values of the columns that identify it
AXES = ("x", "y", "yaw")  # of a command, and its columns: m/s, m/s, rad/s
ROBOT = "robot"  # column with the robot's number: the same number is the same robot in all conditions' draws
FINGERPRINT = "fingerprint"  # column with a number that two robots share only if they did the same, bit for bit
DIGITS = 6  # significant digits in the file


@dataclass(frozen=True)
class Column:
    """One figure of a robot."""

    name: str  # of the column
    unit: str  # of its values; "" for a share
    meaning: str  # in words
    # mean over robots, share of robots for which it is true (Wilson), or phase on a circle
    how: Literal["mean", "share", "phase"] = "mean"
    # the direction that is better, for comparisons; None if neither is
    better: Literal["lower", "higher"] | None = None


FELL = Column("fell", "", "robots that fell", "share", "lower")
LEFT = Column("left_map", "", "robots that left the map, which is not surviving", "share", "lower")
MOVING = Column("moving_s", "s", "time under a command until a fall")
LIFE = (FELL, LEFT, MOVING)  # of every protocol; falls per moving robot-minute come from the first and the last


@dataclass(frozen=True)
class Derived:
    """A figure of all robots together, such as a threshold."""

    name: str  # of the figure
    unit: str  # of it
    meaning: str  # in words
    condition: Mapping[str, float | str]  # what it is about
    better: Literal["lower", "higher"] | None  # the direction that is better
    # figure of some rows; NaN where it is not defined. Its interval is by the bootstrap over robots
    function: Callable[[Sequence[Row]], float]


def distinct(rows: Iterable[Row], keys: Sequence[str], random: bool) -> list[Row]:
    """Return the rows without robots that did what one before them did in the same condition.

    Where nothing is random all did the same, whatever the last bits of a batched matrix product say.
    """
    first: dict[tuple[Condition, float | None], Row] = {}
    for row in rows:
        first.setdefault((tuple(row[k] for k in keys), row[FINGERPRINT] if random else None), row)
    return list(first.values())


def about(rows: Iterable[Row], condition: Mapping[str, float | str]) -> list[Row]:
    """Return the rows of which a condition is true."""
    return [row for row in rows if all(row.get(k) == v for k, v in condition.items())]


def by_condition(rows: Iterable[Row], keys: Sequence[str]) -> dict[Condition, list[Row]]:
    """Return the rows of each condition, in the order in which those come."""
    entries_so_far: dict[Condition, list[Row]] = {}
    for row in rows:
        entries_so_far.setdefault(tuple(row[k] for k in keys), []).append(row)
    return entries_so_far


def values(rows: Sequence[Row], name: str) -> NDArray[np.float64]:
    """Return a column as numbers, NaN where a row has none."""
    return np.array([math.nan if row.get(name) is None else float(row[name]) for row in rows])


def figure(rows: Sequence[Row], column: Column) -> Interval:
    """Return the figure of one column."""
    each = values(rows, column.name)
    if column.how == "share":
        known = each[np.isfinite(each)]
        return intervals.share_interval(int(known.sum()), len(known))
    return (intervals.phase_interval if column.how == "phase" else intervals.mean_interval)(each)


def summary(rows: Sequence[Row], keys: Sequence[str], columns: Sequence[Column]) -> list[SummaryEntry]:
    """Return an entry of plain data for each condition: its robots, and every figure with interval and n."""
    entries: list[SummaryEntry] = []
    for condition, those in by_condition(rows, keys).items():
        figures = {c.name: plain(figure(those, c), c.unit) for c in columns if any(c.name in row for row in those)}
        if FELL.name in figures and MOVING.name in figures:
            fell, moving_s = (float(np.nansum(values(those, column.name))) for column in (FELL, MOVING))
            figures["falls_per_minute"] = plain(intervals.rate_interval(int(fell), moving_s / 60.0), "1/min")
        entries.append({"condition": dict(zip(keys, condition, strict=True)), "n": len(those), "figures": figures})
    return entries


def plain(interval: Interval, unit: str) -> Estimate:
    """Return an interval for JSON."""
    numbers = (interval.estimate, interval.low, interval.high)
    estimate, low, high = (float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in numbers)
    return {"estimate": estimate, "low": low, "high": high, "n": interval.n, "unit": unit}


BETTER: dict[str, Literal["lower", "higher"]] = {
    **dict.fromkeys(("trot_error", "touchdown_speed_p95", "peak_force_p95", "slip_share_all", "slip_share"), "lower"),
    **dict.fromkeys(("cost_of_transport", "torque_share_p99", "joint_speed_share_p99", "slip_distance"), "lower"),
    **dict.fromkeys(("envelope_share_p99", "target_step_p99", "heave"), "lower"),
    **dict.fromkeys(("clearance", "phase_consistency", "gait_clarity"), "higher"),
}
"""Measures of which less or more is better; neither of the others."""


def columns_of(terms: Sequence[Term]) -> list[Column]:
    """Return the columns of measures, one for each foot where they have a value per foot; names have none."""
    entries_so_far = []
    for term in terms:
        unit, doc = str(term.entry.traits["unit"]), term.entry.doc.removesuffix(".")
        if unit == "name":
            continue
        unit = "" if unit == "-" else unit
        how: Literal["mean", "phase"] = "phase" if term.entry.traits.get("circular") else "mean"
        names = [f"{term.key}_{leg}" for leg in robot.LEGS] if per_foot(term.entry) else [term.key]
        entries_so_far += [Column(name, unit, doc, how, BETTER.get(term.entry.name)) for name in names]
    return entries_so_far


def add_measures(rows: Sequence[Row], measures: Mapping[str, np.ndarray | None]) -> None:
    """Write the measures, (N,) or (N, 4) each by name, None if not measured, into the rows of the N robots."""
    for name, each in measures.items():
        if each is None or each.dtype.kind == "U":
            continue
        for row, value in zip(rows, each, strict=True):
            of_legs = np.ndim(value) > 0
            names = [f"{name}_{leg}" for leg in robot.LEGS] if of_legs else [name]
            parts = dict(zip(names, np.atleast_1d(value), strict=True))
            row |= {k: float(v) if np.isfinite(v) else None for k, v in parts.items()}


def described(terms: Sequence[Term], trace: Trace) -> dict[str, object]:
    """Return the mean over robots of each measure with its 95 % interval and n; lists of four for feet.

    A measure whose unit is ``name`` gives the number of robots by name; one that needs what was not recorded, None.
    """
    report: dict[str, object] = {}
    by_name = measured(trace, list(terms))
    for term in terms:
        mean = intervals.phase_interval if term.entry.traits.get("circular") else intervals.mean_interval
        each = by_name[term.key]
        if each is None:
            report[term.key] = None
        elif each.dtype.kind == "U":
            report[term.key] = dict(Counter(str(name) for name in each if name).most_common())
        elif per_foot(term.entry):
            feet = [_named(mean(foot), "mean") for foot in each.T]
            report[term.key] = {name: [foot[name] for foot in feet] for name in feet[0]}
        else:
            report[term.key] = _named(mean(each), "mean")
    return report


def share(count: int, n: int) -> dict[str, float | None]:
    """Return a share of robots with Wilson's 95 % interval as plain data."""
    return _named(intervals.share_interval(count, n), "share")


def _named(interval: Interval, name: str) -> dict[str, float | None]:
    figure = plain(interval, "")
    return {name: figure["estimate"], "low": figure["low"], "high": figure["high"], "n": figure["n"]}


DRAW = "draw."  # first part of the name of a column with something that was drawn for the robot

ERRORS = (
    Column("error_xy", "m/s", "root mean square error of the horizontal velocity", better="lower"),
    Column("error_x", "m/s", "root mean square error of the forward velocity", better="lower"),
    Column("error_y", "m/s", "root mean square error of the lateral velocity", better="lower"),
    Column("error_yaw", "rad/s", "root mean square error of the yaw rate", better="lower"),
)

COLUMNS = (FELL, MOVING, *ERRORS)  # figures of a row beside its measures
SEPARATE = 3  # a draw of more numbers than these stands as their mean and their range


def coarse_note(step: float) -> str:
    """Return what a reader must know of an evaluation with a physics step of so many s; empty up to 2 ms."""
    return f"physics of {1e3 * step:g} ms softens impacts; physics_dt=0.002 is finer" if step > 0.0021 else ""


def rows_of(
    commands: NDArray[np.float64],
    episodes: int,
    errors: NDArray[np.float64],
    fell: NDArray[np.bool_],
    moving_s: NDArray[np.float64],
    draws: Mapping[str, NDArray[np.float64]],
    measures: Mapping[str, np.ndarray | None],
) -> list[Row]:
    """Return a row of plain data for each of N robots, of which ``episodes`` neighbours have one command.

    They are numbered as those of other commands are. ``errors`` are root mean squares, NaN where there is none;
    ``moving_s`` is the time until a fall, s; ``draws`` is what was drawn for the robots, (N,) each by name,
    ``measures`` are those of gait and contact, (N,) or (N, 4).
    """
    planar = np.hypot(errors[:, 0], errors[:, 1])
    figures = np.column_stack([planar, errors])
    rows: list[Row] = [
        {
            **dict(zip(AXES, map(float, commands[i]), strict=True)),
            ROBOT: i % episodes,
            FELL.name: bool(fell[i]),
            MOVING.name: round(float(moving_s[i]), 4),
            **{c.name: _number(v) for c, v in zip(ERRORS, figures[i], strict=True)},
            **{f"{DRAW}{name}": _number(values[i]) for name, values in draws.items()},
        }
        for i in range(len(fell))
    ]
    add_measures(rows, measures)
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


FILE = "eval.json"  # in a run folder; the rows are beside it


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


def finite(value: object) -> Any:
    """Return plain data for JSON: numbers that are not finite as None, NumPy's as Python's."""
    if isinstance(value, dict):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
