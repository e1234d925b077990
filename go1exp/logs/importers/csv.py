"""Any table, as CSV or Parquet: a mapping says which column is which channel, in which unit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from go1exp.base.wording import counted
from go1exp.config.schema.joint_values import JointValues, each_within, spread
from go1exp.config.schema.registry import STRICT, ConfigError, Positive, as_json, explain, importer, nearest
from go1exp.logs.importers.source import LEVEL, check_clock, episodes, files, overflow, recording, without_repeats
from go1exp.logs.importers.table import UTF8, Layout, Table, names, read
from go1exp.logs.recording import FLAG, FOOT_FORCE, JOINT_QUANTITIES, VECTORS, Quaternion, Recording, RecordingError

PATH = "importer.csv"  # where a complaint about an option begins

_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_ANGLE = {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180, "turn": 2 * np.pi}
_SPEED = {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": np.pi / 180, "turn/s": 2 * np.pi, "rpm": np.pi / 30}
_TORQUE = {"N m": 1.0, "mN m": 1e-3, "kgf cm": 9.80665e-2}
_ACCELERATION = {"m/s2": 1.0, "g": 9.80665}

UNITS: dict[str, dict[str, float]] = {
    "t": _TIME,
    "q": _ANGLE,
    "qd": _SPEED,
    "q_target": _ANGLE,
    "tau_est": _TORQUE,
    "tau_cmd": _TORQUE,
    "imu_gyro": _SPEED,
    "imu_acc": _ACCELERATION,
    "imu_quat": {"1": 1.0},
    "base_pos": {"m": 1.0, "mm": 1e-3},
    "base_quat": {"1": 1.0},
    "base_lin_vel": {"m/s": 1.0, "mm/s": 1e-3},
    "base_ang_vel": _SPEED,
    "foot_force": {"N": 1.0, "kgf": 9.80665},
    FLAG: {"1": 1.0},
}
"""Quantity -> unit -> how many of our unit it is; the first is ours (1 kgf = 9.80665 N, the standard gravity)."""

SPELLINGS = {"°": "deg", "°/s": "deg/s", "degrees": "deg", "Nm": "N m", "N.m": "N m", "N*m": "N m", "mNm": "mN m"}
SPELLINGS |= {"m/s^2": "m/s2", "m/s²": "m/s2", "sec": "s", "µs": "us", "μs": "us", "radians": "rad", "rev": "turn"}
"""Other spellings of units in a line of units."""


@dataclass(frozen=True, config=STRICT)
class Column:
    """Where a channel comes from: channel = scale (unit x value) + offset.

    Attributes:
        column: name of the column; its number from 1 in a file without names.
        unit: unit of the column; ours if null.
        scale: further factor; -1 if the source counts the other way round.
        offset: added at the end, in our unit.
    """

    column: str
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0


_COLUMN = TypeAdapter(Column)


def _is_number(column: object) -> bool:
    return isinstance(column, int) and not isinstance(column, bool)


def _columns(given: Mapping[str, object], joints: tuple[str, ...] | None) -> tuple[dict[str, Column], list[str]]:
    """Return channel -> column (a list in one column is all joints or axes), and what is wrong with them as written."""
    mapping, wrong = {}, []
    for name, value in given.items():
        if isinstance(value, str) or _is_number(value):
            mapping[name] = Column(str(value))
        elif not isinstance(value, Mapping):
            wrong.append(
                f"{PATH}.columns.{name} = {value!r}: must be a name, a number or {{column, unit, scale, offset}}"
            )
        else:
            try:
                by_number = {"column": str(value["column"])} if _is_number(value.get("column")) else {}
                mapping[name] = _COLUMN.validate_json(as_json({**value, **by_number}))
            except ValidationError as error:
                wrong += explain(error, f"{PATH}.columns.{name}", [f.name for f in fields(Column)])
    for name in [name for name in mapping if name in JOINT_QUANTITIES or name in VECTORS]:
        whole = mapping.pop(name)
        channels = VECTORS.get(name) or [f"{name}_{joint}" for joint in joints or ()]
        if not channels:
            wrong.append(f"{PATH}.columns.{name}: is a list of all joints; name them in its order by joints")
        mapping |= {channel: replace(whole, column=f"{whole.column}[{k}]") for k, channel in enumerate(channels)}
    return mapping, wrong


@importer("csv")
def csv(
    path: Path,
    *,
    robot: Annotated[str, Field(min_length=1)],
    columns: dict[str, Any] | None = None,
    joints: tuple[str, ...] | None = None,
    rate_hz: Positive | None = None,
    episode: str | None = None,
    drop_repeats: bool = False,
    base: Literal["fixed", "floating"] = "fixed",
    base_quat: Quaternion | None = None,
    kp: Annotated[JointValues, each_within(0.0)] | None = None,
    kd: Annotated[JointValues, each_within(0.0)] | None = None,
    tau_limit: Annotated[JointValues, each_within(1e-9)] | None = None,
    excitation: str | None = None,
    measured: bool = True,
    notes: str = "",
    header: bool = True,
    skip_lines: Annotated[int, Field(ge=0)] = 0,
    delimiter: Annotated[str, Field(min_length=1, max_length=1)] = ",",
    decimal: Literal[".", ","] = ".",
    encoding: str = UTF8,
) -> list[Recording]:
    """Any CSV or Parquet of any robot: ``columns`` says which column is which channel, with unit, sign and offset.

    Args:
        path: a ``.csv`` or ``.parquet``, or a folder of them. A file is one episode, unless its clock begins anew or
            ``episode`` is given.
        robot: name of the robot, as the model's ``robots`` has it.
        columns: channel -> name of its column, or ``{column, unit, scale, offset}``. Channels are those of a recording:
            ``t``, ``q_JOINT``, ``qd_JOINT``, ``q_target_JOINT``, ``tau_cmd_JOINT``, ``tau_est_JOINT`` and others.
            ``NAME[0]`` is the first element of a column of lists; ``q: NAME`` gives its elements to ``joints``.
        joints: names of the joints; by default those of the channels ``q_JOINT``, in their order.
        rate_hz: rows per second, Hz; needed where no column is the time, else taken from the time.
        episode: column whose values, numbers or words, are the episodes; each becomes a recording.
        drop_repeats: leave out rows with the time of the row before; the notes have their number.
        base: whether the base was ``fixed`` or ``floating``.
        base_quat: attitude of a fixed base, w-x-y-z; level if null.
        kp: position gains, N m/rad: a number, one for each joint, or a mapping.
        kd: velocity gains, N m s/rad.
        tau_limit: torque at which the controller clips, N m.
        excitation: name of the motion.
        measured: false for a table that a simulation wrote.
        notes: what a reader must know.
        header: whether the first line has the names of the columns; without, they are called 1, 2, 3.
        skip_lines: lines before that.
        delimiter: what stands between two columns.
        decimal: decimal point, or comma.
        encoding: how characters are written as bytes, such as latin-1 or utf-16.

    Raises:
        ConfigError: if a channel, joint or unit does not exist, or a gain is missing; with every such problem.
        RecordingError: if a file is no table, lacks a column, or holds what is no number.
    """
    mapping, wrong = _columns(columns or {}, joints)
    tables = files(path, "*.csv", "*.parquet")
    if not _is_encoding(encoding):
        wrong.append(f"{PATH}.encoding = {encoding!r}: unknown encoding; utf-8, latin-1 or utf-16 will do")
        raise ConfigError(wrong)
    called = joints or tuple(c.removeprefix("q_") for c in mapping if _quantity(c) == "q")
    given = {"kp": kp, "kd": kd, "tau_limit": tau_limit}
    layout = Layout(header, skip_lines, delimiter, decimal, encoding)
    wrong = wrong or (_problems(mapping, called, rate_hz) if mapping else [_without_columns(tables[0], layout)])
    per_joint, missing = _per_joint(given, called)
    if wrong or missing:
        raise ConfigError([*wrong, *missing])
    about = {"robot": robot, "joints": called, "base": base, "excitation": excitation} | per_joint
    about["base_quat"] = base_quat or (LEVEL if base == "fixed" else None)
    about["source"] = "measured" if measured else "simulated"
    return [
        one
        for file in tables
        for one in _recordings(file, mapping, episode, rate_hz, about, notes, drop_repeats, layout)
    ]


def _recordings(
    path: Path,
    mapping: Mapping[str, Column],
    episode: str | None,
    rate_hz: float | None,
    about: Mapping[str, Any],
    notes: str,
    drop_repeats: bool,
    layout: Layout,
) -> Iterator[Recording]:
    wanted: dict[str, str] = {}
    for name, source in mapping.items():
        wanted[source.column] = ", ".join(filter(None, (wanted.get(source.column), name)))
    labels = None if episode is None else {episode: "episode"} | wanted
    table = read(path, labels or wanted, layout, episode if episode not in wanted else None)
    mapping = _with_units(path, mapping, table.units)
    channels = {name: _channel(path, name, table.columns[c.column], c) for name, c in mapping.items()}
    general = _remarks(table, wanted, notes)
    clock, cells = mapping.get("t"), np.empty(0)
    if clock is not None:
        # Stamps may be seconds since 1970, of which float64 holds no more than parts of a microsecond.
        cells = table.columns[clock.column]
        channels["t"] = _channel(path, "t", cells - cells[0], clock) - clock.offset
    overflows = clock is not None and overflow(cells)
    times = channels["t"] if clock is not None and not overflows else None
    parts = episodes(None if episode is None else table.columns[episode], times, len(next(iter(channels.values()))))
    for name, rows in parts:
        remarks = list(general)
        where = f"{path}: episode {name}" if name else str(path)
        if clock is not None:
            if drop_repeats:
                kept = rows[without_repeats(channels["t"][rows])]
                if left := len(rows) - len(kept):
                    remarks.append(f"{counted(left, 'row')} with the time of the row before: left out.")
                rows = kept
            check_clock(where, channels["t"][rows], cells[rows], clock.column, table.place, rows)
            remarks.append(f"t = 0 is {cells[rows[0]]} in the column {clock.column!r}.")
            series = {key: values[rows] for key, values in channels.items()}
            series["t"] = series["t"] - series["t"][0]
        else:
            assert rate_hz is not None  # checked with the mapping
            series = {"t": np.arange(len(rows)) / rate_hz} | {key: values[rows] for key, values in channels.items()}
            remarks.append(f"No clock in the source: t = row / {rate_hz:g} Hz.")
        if len(parts) > 1 and episode is None:
            remarks.append(f"The clock begins anew {counted(len(parts) - 1, 'time')} in the file: one recording each.")
        called = {"episode": f"{path.stem}_{name}"} if name else {}
        rate = {} if rate_hz is None else {"rate_hz": rate_hz}
        yield recording(path, "csv", series, notes=" ".join(remarks), **rate, **called, **about)


def _remarks(table: Table, wanted: Mapping[str, str], notes: str) -> list[str]:
    """Return what the notes of every episode say of the table; ``wanted`` is column -> names of its channels."""
    remarks = [notes] if notes else []
    if table.unused:
        named = ", ".join(name or "one without a name" for name in table.unused)
        remarks.append(f"Columns of the source that are left out: {named}.")
    remarks += [f"Column {column!r} of the source is {names}." for column, names in wanted.items() if ", " in names]
    if table.units:
        remarks.append(f"Units of the line below the names: {', '.join(filter(None, table.units.values()))}.")
    return remarks


def _with_units(path: Path, mapping: Mapping[str, Column], units: Mapping[str, str]) -> dict[str, Column]:
    """Return columns, units of the line below the names where none is given; RecordingError if one is unknown."""
    result = dict(mapping)
    for name, column in mapping.items():
        quantity, text = _quantity(name), units.get(column.column, "").strip("[]() ")
        text = SPELLINGS.get(text, text)
        if column.unit is not None or text in ("", "-") or quantity is None:
            continue
        if text not in UNITS[quantity]:
            raise RecordingError(
                f"{path}: column {column.column!r} (for {name}): its unit is {text!r} in the line below the names; "
                f"give one in columns: {', '.join(UNITS[quantity])}, with a scale if need be"
            )
        result[name] = replace(column, unit=text)
    return result


# ---------------------------------------------------------------------- the mapping


def _quantity(channel: str) -> str | None:
    """Return the quantity of a channel's name; None if there is none of that name."""
    if channel in ("t", FLAG):
        return channel
    vector = next((name for name, members in VECTORS.items() if channel in members), None)
    if vector:
        return vector
    if channel.startswith(FOOT_FORCE) and channel != FOOT_FORCE:
        return "foot_force"
    # The longest first: q_target_hip is the target of hip.
    prefixes = sorted((f"{q}_" for q in JOINT_QUANTITIES), key=len, reverse=True)
    return next((p[:-1] for p in prefixes if channel.startswith(p) and channel != p), None)


def _problems(mapping: Mapping[str, Column], joints: tuple[str, ...], rate_hz: float | None) -> list[str]:
    """List what is wrong with the mapping, whatever the file holds."""
    wrong = []
    if not joints:
        wrong.append(f"{PATH}.columns: no angle of a joint; a channel q_JOINT is needed, such as q_knee: pos")
    if "t" not in mapping and rate_hz is None:
        wrong.append(f"{PATH}.columns: no t; name the column of the time (t: time) or give rate_hz")
    for name, column in mapping.items():
        at, quantity = f"{PATH}.columns.{name}", _quantity(name)
        joint = name.removeprefix(f"{quantity}_")
        if quantity is None or (quantity in JOINT_QUANTITIES and joints and joint not in joints):
            wrong.append(f"{at}: unknown channel; {_hint(name, quantity, joints)}")
        elif column.unit is not None and column.unit not in UNITS[quantity]:
            wrong.append(f"{at}.unit = {column.unit!r}: unknown unit; {', '.join(UNITS[quantity])} will do")
        elif column.scale == 0:
            wrong.append(f"{at}.scale = {column.scale}: must not be 0")
    for name in [f"q_{j}" for j in joints if f"q_{j}" in mapping]:
        # q_targt_knee beside q_knee
        tail = next((j for j in joints if name.endswith(f"_{j}") and name != f"q_{j}"), "")
        if tail and (close := nearest(name.removesuffix(f"_{tail}"), [q for q in JOINT_QUANTITIES if "_" in q], 1)):
            return [*wrong, f"{PATH}.columns.{name}: unknown channel; did you mean '{close[0]}_{tail}'?"]
    for quantity in JOINT_QUANTITIES:
        lacking = [f"{quantity}_{j}" for j in joints if f"{quantity}_{j}" not in mapping]
        if lacking and (quantity == "q" or len(lacking) < len(joints)):
            wrong.append(f"{PATH}.columns: no {', '.join(lacking)}; {quantity} is needed of all joints or of none")
    return wrong


def _hint(name: str, quantity: str | None, joints: tuple[str, ...]) -> str:
    if quantity in JOINT_QUANTITIES:
        return f"joints are {', '.join(joints)}"
    fixed = ["t", FLAG, *(c for v in VECTORS.values() for c in v)]
    close = nearest(name, [*fixed, *(f"{q}_{j}" for q in JOINT_QUANTITIES for j in joints)])
    if close:
        return f"did you mean {' or '.join(map(repr, close))}?"
    return f"channels are t, {', '.join(f'{q}_JOINT' for q in JOINT_QUANTITIES)}; joints {', '.join(joints) or 'none'}"


def _per_joint(given: Mapping[str, Any], joints: tuple[str, ...]) -> tuple[dict[str, Any], list[str]]:
    """Return gains and limits, (J,) each or None, and what is wrong with them."""
    values: dict[str, Any] = dict.fromkeys(given)
    wrong = []
    for name, value in given.items():
        if value is None or not joints:
            continue
        try:
            numbers = spread(value, joints)
        except ValueError as error:
            wrong.append(f"{PATH}.{name}: {error}")
            continue
        lacking = [j for j, number in zip(joints, numbers, strict=True) if np.isnan(number)]
        if lacking:
            wrong.append(f"{PATH}.{name}: gives {', '.join(lacking)} no value")
        values[name] = tuple(float(number) for number in numbers)
    return values, wrong


def _is_encoding(name: str) -> bool:
    try:
        b"abc".decode(name, "replace")  # of no bytes, Python does not look at the name
    except (LookupError, UnicodeError):  # idna takes no replacement
        return False
    return True


def _without_columns(path: Path, layout: Layout) -> str:
    return (
        f"{PATH}.columns: required, but not given; {path} has the columns {', '.join(names(path, layout))}; "
        "such as columns={t: time, q_knee: {column: pos, unit: deg}, q_target_knee: goal} or columns=FILE.yaml"
    )


# ---------------------------------------------------------------------- the numbers


def _channel(path: Path, name: str, values: np.ndarray, column: Column) -> np.ndarray:
    """Return a column (T,) in our unit; the flag as bool."""
    quantity = _quantity(name)
    assert quantity is not None
    factor = UNITS[quantity][column.unit] if column.unit else 1.0
    result: np.ndarray = column.scale * factor * values + column.offset
    if name != FLAG:
        return result
    if not np.isin(result, (0.0, 1.0)).all():
        raise RecordingError(f"{path}: column {column.column!r} (for {FLAG}): must be 0 or 1 in every row")
    return result.astype(bool)
