"""Learning curves: metrics of runs over environment steps and over time, up to the end of the shortest run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from go1exp.evaluate.report.study import Group
from go1exp.evaluate.statistics.runs import iqm_band

Floats = NDArray[np.float64]
RATE = "time/steps_per_s"
STEPS, HOURS = "steps", "hours"
AXES = {STEPS: "million environment steps", HOURS: "hours of training"}  # column of the x axis -> its label


@dataclass(frozen=True)
class Curve:
    """One metric of one group over one axis."""

    group: str
    metric: str  # column of metrics.csv
    axis: str  # steps or hours
    x: Floats  # (T,), million steps or hours
    middle: Floats  # interquartile mean over runs (T,)
    low: Floats  # lower bound of its 95 % interval (T,), NaN of one run
    high: Floats  # upper bound (T,)
    runs: int
    last: Floats  # the last value of each run (runs,)


@dataclass(frozen=True)
class Metrics:
    """Logged metrics of a run."""

    columns: dict[str, Floats]  # (rows,) of each requested column; ``hours`` is training time
    available: tuple[str, ...] = ()  # names of all columns


def read(run: Path, wanted: Sequence[str]) -> tuple[Metrics, str]:
    """Return a run's metrics, without incomplete rows and repeated iterations, and a remark, or an empty one."""
    metrics, remark = _table(run / "metrics.csv", ("iteration", "steps", *wanted))
    columns, timing = metrics.columns, _table(run / "timing.csv", ("iteration", "steps", RATE))[0].columns
    if len(columns.get("steps", ())) and len(timing.get(RATE, ())):
        passed = np.diff(timing["steps"], prepend=0.0) / np.maximum(timing[RATE], 1e-9) / 3600.0
        columns[HOURS] = np.interp(columns["steps"], timing["steps"], np.cumsum(passed))
    return metrics, remark


def _table(file: Path, wanted: Sequence[str]) -> tuple[Metrics, str]:
    """Return columns of a CSV file: its complete rows, ascending in the iteration; and a remark."""
    import pyarrow as pa
    from pyarrow import csv

    try:
        data = file.read_bytes()
    except OSError:
        return Metrics({}), f"{file}: cannot be read"
    whole, _, rest = data.rpartition(b"\n")
    names = whole.split(b"\n", 1)[0].decode(errors="replace").strip().split(",")
    spoilt = [bool(rest.strip())]

    def skip(row: object) -> str:
        spoilt.append(True)
        return "skip"

    present = [name for name in dict.fromkeys(wanted) if name in names]
    if not whole or "iteration" not in names or len(whole.split(b"\n", 2)) < 2:
        return Metrics({}), f"{file}: holds no complete row"
    try:
        table = csv.read_csv(
            pa.BufferReader(whole + b"\n"),
            parse_options=csv.ParseOptions(invalid_row_handler=skip),
            convert_options=csv.ConvertOptions(
                include_columns=present,
                column_types=dict.fromkeys(present, pa.float64()),
                null_values=["", "nan", "NaN", "None"],
                strings_can_be_null=True,
            ),
        )
    except pa.ArrowInvalid as error:
        return Metrics({}), f"{file}: is damaged ({str(error).splitlines()[0][:120]})"
    columns = {name: table[name].to_numpy(zero_copy_only=False).astype(np.float64) for name in present}
    rising = np.isfinite(columns["iteration"])
    rising &= np.diff(np.maximum.accumulate(np.nan_to_num(columns["iteration"])), prepend=0.0) > 0.0
    kept = {name: values[rising] for name, values in columns.items()}
    if not rising.all():
        spoilt.append(True)
    remark = f"{file}: has incomplete rows; they are excluded" if any(spoilt) else ""
    return Metrics(kept, tuple(names)), remark


def curves(
    made: Sequence[Group], metrics: dict[Path, Metrics], wanted: Sequence[str], points: int
) -> tuple[list[Curve], list[str]]:
    """Return the curves of all groups, and remarks on curves that could not be drawn."""
    drawn: list[Curve | None] = []
    notes = []
    for name in wanted:
        missing = [run for group in made for run in group.runs if name not in metrics[run.folder].columns]
        if missing:
            known = metrics[missing[0].folder].available
            close = f"; it has {', '.join(known[:6])}, ..." if known else ""
            others = f" and {len(missing) - 1} more runs" if len(missing) > 1 else ""
            notes.append(f"{name}: is not in the metrics of {missing[0].label}{others}{close}")
        drawn += [_curve(group, metrics, name, axis, points) for axis in AXES for group in made]
    return [curve for curve in drawn if curve is not None], notes


def _curve(group: Group, metrics: dict[Path, Metrics], name: str, axis: str, points: int) -> Curve | None:
    """Return one curve, from where all runs have a value to the end of the shortest run; None without one."""
    lines = []
    for run in group.runs:
        columns = metrics[run.folder].columns
        if name in columns and axis in columns:
            known = np.isfinite(columns[name]) & np.isfinite(columns[axis])
            if known.sum() >= 2:
                lines.append((columns[axis][known], columns[name][known]))
    if not lines:
        return None
    start, end = max(x[0] for x, _ in lines), min(x[-1] for x, _ in lines)
    if end <= start:
        return None
    x = np.linspace(start, end, points)
    values = np.array([np.interp(x, at, value) for at, value in lines])
    middle, low, high = iqm_band(values)
    unit = 1e-6 if axis == STEPS else 1.0
    return Curve(group.name, name, axis, x * unit, middle, low, high, len(lines), values[:, -1])
