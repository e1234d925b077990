"""One episode of a robot, or of its simulation, in one Parquet file. Only this module reads, writes and checks them.

A column is one channel. A channel that was not recorded has no column; it is never filled with zeros. The schema
metadata key ``go1exp`` holds one JSON object, :class:`Meta`. SI units, quaternions w-x-y-z:

=====================================================  =================================================================
column                                                 meaning
=====================================================  =================================================================
``t``                                                  s, the logger's clock, strictly increasing; required
``q_J``, ``qd_J``, ``q_target_J``                      rad, rad/s, rad; J is a joint, the target the one in force at t
``tau_est_J``, ``tau_cmd_J``                           N m, reported by the actuator; commanded
``imu_gyro_x/y/z``, ``imu_acc_x/y/z``                  rad/s, m/s2, in the IMU's frame
``imu_quat_w/x/y/z``                                   attitude that the IMU reports
``foot_force_L``                                       N; L is a leg
``base_pos_x/y/z_w``, ``base_lin_vel_x/y/z_w``         m, m/s, ground truth in the world frame
``base_quat_w/x/y/z``, ``base_ang_vel_x/y/z_b``        -, rad/s, ground truth; angular velocity in the trunk's frame
``torque_enable``                                      bool, false while the actuators are off
=====================================================  =================================================================

A recording has a quantity for all its joints (or axes) or for none. Columns hold numbers only; nothing is unpickled.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass as checked_dataclass

from go1exp.base.errors import Unusable
from go1exp.base.files import opened
from go1exp.base.wording import counted
from go1exp.config.schema.physics import ContactConfig
from go1exp.config.schema.registry import STRICT, NonNegative, Positive, explain, nearest
from go1exp.robot import JOINTS, LEGS

if TYPE_CHECKING:
    import pyarrow.parquet as pq

KEY = b"go1exp"  # key of the schema metadata that holds the JSON object

JOINT_QUANTITIES = ("q", "qd", "q_target", "tau_est", "tau_cmd")
VECTORS = {
    "imu_gyro": ("imu_gyro_x", "imu_gyro_y", "imu_gyro_z"),
    "imu_acc": ("imu_acc_x", "imu_acc_y", "imu_acc_z"),
    "imu_quat": ("imu_quat_w", "imu_quat_x", "imu_quat_y", "imu_quat_z"),
    "base_pos": ("base_pos_x_w", "base_pos_y_w", "base_pos_z_w"),
    "base_quat": ("base_quat_w", "base_quat_x", "base_quat_y", "base_quat_z"),
    "base_lin_vel": ("base_lin_vel_x_w", "base_lin_vel_y_w", "base_lin_vel_z_w"),
    "base_ang_vel": ("base_ang_vel_x_b", "base_ang_vel_y_b", "base_ang_vel_z_b"),
}
"""Quantity -> its columns, all or none of which a recording has."""

FOOT_FORCE = "foot_force_"
FLAG = "torque_enable"

UNIT_TOLERANCE = 1e-3
"""The length of a quaternion may differ from 1 by this (chosen: accepts values rounded to three decimals)."""

RATE_FACTOR = 2.0
"""The median step of ``t`` may differ from 1 / ``rate_hz`` by this factor (chosen: ms in place of s is refused)."""

Joint = Annotated[str, Field(min_length=1)]
Quaternion = tuple[float, float, float, float]


class RecordingError(Unusable):
    """A recording that breaks the format. The message starts with the file (or episode) and names the channel."""


def joint_channel(quantity: str, joint: str) -> str:
    """Name the column of one joint: ``q``, ``FR_hip`` -> ``q_FR_hip``."""
    return f"{quantity}_{joint}"


def joint_channels(quantity: str, joints: Iterable[str]) -> list[str]:
    """Name the columns of several joints, in their order."""
    return [joint_channel(quantity, joint) for joint in joints]


def columns(names: Iterable[str], values: np.ndarray) -> dict[str, np.ndarray]:
    """Split ``(T, K)`` into K named columns."""
    return {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(names)}


def joint_columns(quantity: str, joints: Iterable[str], values: np.ndarray) -> dict[str, np.ndarray]:
    """Split ``(T, J)`` into the columns of one quantity."""
    return columns(joint_channels(quantity, joints), values)


@checked_dataclass(frozen=True, config=STRICT)
class Meta:
    """Metadata of a recording. Wrong types, values or lengths raise pydantic's ``ValidationError``.

    Attributes:
        robot: ``go1``, or another robot's name.
        joints: the robot's joint names; the order of ``kp``, ``kd``, ``tau_limit`` and of ``Recording.joint``.
        rate_hz: nominal sampling rate, Hz; the median step of ``t`` lies within a factor of two of it.
        base: ``fixed`` to the world, or ``floating``.
        base_quat: attitude of a fixed base, w-x-y-z, base to world; None for a floating one.
        kp: position gain of the joint controller, N m/rad, or None where unknown.
        kd: velocity gain, N m s/rad, or None where unknown.
        tau_limit: torque at which the controller clips, N m, or None where unknown.
        excitation: name of the commanded motion, or None.
        episode: name of the recording; unique among those it is used with.
        repeat_of: episode that this one repeats under the same commands, or None.
        source: ``measured`` on hardware or ``simulated``.
        tool: program that wrote the file.
        versions: package -> version, of the tool and of the packages it used.
        notes: known flaws and anything else that a reader must know.
        format: version of the format.
        contact: of the feet in the robot's model of training (time constant in s), or None where unknown. It says
            nothing of the floor that the robot was on. Files leave it out where it is None.
    """

    robot: Annotated[str, Field(min_length=1)]
    joints: Annotated[tuple[Joint, ...], Field(min_length=1)]
    rate_hz: Positive
    base: Literal["fixed", "floating"]
    base_quat: Quaternion | None
    kp: tuple[NonNegative, ...] | None
    kd: tuple[NonNegative, ...] | None
    tau_limit: tuple[Positive, ...] | None
    excitation: str | None
    episode: Annotated[str, Field(min_length=1)]
    repeat_of: str | None
    source: Literal["measured", "simulated"]
    tool: str
    versions: dict[str, str]
    notes: str
    format: Literal[1] = 1
    contact: ContactConfig | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Meta:
        wrong = []
        columns = Counter(c for quantity in JOINT_QUANTITIES for c in joint_channels(quantity, self.joints))
        twice = [name for name, n in columns.items() if n > 1]
        if twice:
            wrong.append(f"joints: must be different, and give different columns; {', '.join(twice)} occurs twice")
        for key in ("kp", "kd", "tau_limit"):
            values = getattr(self, key)
            if values is not None and len(values) != len(self.joints):
                wrong.append(f"{key}: has {len(values)} values for {len(self.joints)} joints")
        if (self.base == "fixed") != (self.base_quat is not None):
            wrong.append("base_quat: must be given for a fixed base, and null for a floating one")
        elif self.base_quat is not None and abs(math.hypot(*self.base_quat) - 1) > UNIT_TOLERANCE:
            wrong.append(f"base_quat: must have length 1, not {math.hypot(*self.base_quat):.6g}")
        if wrong:
            raise ValueError("\n".join(wrong))
        return self


_META = TypeAdapter(Meta)


def as_json(meta: Meta) -> bytes:
    """Return metadata as JSON. That without a contact is to the byte what it was before there was such a field."""
    return _META.dump_json(meta, exclude={"contact"} if meta.contact is None else None)


@dataclass(frozen=True, eq=False)
class Recording:
    """One episode.

    Attributes:
        meta: its metadata.
        channels: column -> ``(T,)`` float64 (``torque_enable``: bool); ``t`` is required.
        origin: file that it was imported from, or None.
    """

    meta: Meta
    channels: dict[str, np.ndarray]
    origin: Path | None = None

    @property
    def t(self) -> np.ndarray:
        """Time stamps ``(T,)``, s."""
        return self._column("t")

    def has(self, quantity: str) -> bool:
        """Whether every joint has a column of ``quantity``: ``q``, ``qd``, ``q_target``, ``tau_est`` or ``tau_cmd``."""
        return all(column in self.channels for column in joint_channels(quantity, self.meta.joints))

    def joint(self, quantity: str) -> np.ndarray:
        """Return a quantity ``(T, J)`` in the order of ``meta.joints``; RecordingError if one has no such column."""
        return self.block(*joint_channels(quantity, self.meta.joints))

    def block(self, *names: str) -> np.ndarray:
        """Return the named columns side by side, ``(T, len(names))``; RecordingError if one is missing."""
        return np.stack([self._column(name) for name in names], axis=1)

    def _column(self, name: str) -> np.ndarray:
        if name not in self.channels:
            raise RecordingError(f"{self.meta.episode}: no channel {name!r}; it has {', '.join(self.channels)}")
        return self.channels[name]


# ---------------------------------------------------------------------- the format


def problems(recording: Recording) -> list[str]:
    """List the problems of the format; each line names the channel and says what would be right."""
    meta, channels = recording.meta, recording.channels
    lines = _name_problems(meta, channels)
    if "t" not in channels:
        return [*lines, "t: required, but not given"]
    shape = np.shape(channels["t"])
    if len(shape) != 1 or shape[0] == 0:
        return [*lines, f"t: must be one column of at least one row, not of shape {shape}"]
    sound = []
    for name, values in channels.items():
        complaint = _value_problem(name, values, shape[0])
        if complaint:
            lines.append(complaint)
        else:
            sound.append(name)
    if "t" in sound:
        lines += _clock_problems(channels["t"], meta.rate_hz)
    for quantity in ("imu_quat", "base_quat"):
        if set(VECTORS[quantity]) <= set(sound):
            length = np.linalg.norm(recording.block(*VECTORS[quantity]), axis=1)
            worst = int(np.argmax(np.abs(length - 1)))
            if abs(length[worst] - 1) > UNIT_TOLERANCE:
                lines.append(f"{quantity}: must have length 1, but row {worst} has {length[worst]:.6g}")
    return lines


def _name_problems(meta: Meta, channels: Iterable[str]) -> list[str]:
    """List unknown columns, and quantities of which a part is missing."""
    present = set(channels)
    wholes = {q: joint_channels(q, meta.joints) for q in JOINT_QUANTITIES} | {k: list(v) for k, v in VECTORS.items()}
    go1_like = set(meta.joints) == set(JOINTS)
    if go1_like:
        wholes["foot_force"] = [FOOT_FORCE + leg for leg in LEGS]
    known = {"t", FLAG}.union(*wholes.values())
    lines = []
    for name in sorted(present - known):
        if not go1_like and name.startswith(FOOT_FORCE) and name != FOOT_FORCE:
            continue  # legs of other robots may have any name
        close = nearest(name, known)
        hint = f"did you mean {' or '.join(map(repr, close))}?" if close else f"joints are {', '.join(meta.joints)}"
        lines.append(f"{name}: unknown column; {hint}")
    for quantity, whole in wholes.items():
        missing = [name for name in whole if name not in present]
        if 0 < len(missing) < len(whole):
            lines.append(f"{quantity}: no column {', '.join(missing)}; a recording has all of a quantity or none")
    return lines


def _value_problem(name: str, values: np.ndarray, rows: int) -> str | None:
    right = np.dtype(bool if name == FLAG else np.float64)
    if not isinstance(values, np.ndarray) or values.dtype != right:
        return f"{name}: must be an array of {right}, not {getattr(values, 'dtype', type(values).__name__)}"
    if values.shape != (rows,):
        return f"{name}: must have shape ({rows},) like t, not {values.shape}"
    strange = np.flatnonzero(~np.isfinite(values))
    if strange.size:
        first = int(strange[0])
        return f"{name}: must be finite, but {strange.size} values are not, the first {values[first]} in row {first}"
    return None


def _clock_problems(t: np.ndarray, rate: float) -> list[str]:
    steps = np.diff(t)
    back = np.flatnonzero(steps <= 0)
    if back.size:
        row = int(back[0]) + 1
        rows = counted(back.size, "such row")
        return [f"t: must increase strictly, but row {row} has {t[row]} s after {t[row - 1]} s ({rows})"]
    if steps.size and not 1 / RATE_FACTOR <= np.median(steps) * rate <= RATE_FACTOR:
        return [f"t: steps by {np.median(steps):.6g} s (median), but rate_hz = {rate:g} says {1 / rate:.6g} s"]
    return []


def stop(where: Path | str, complaints: Iterable[str]) -> None:
    """Raise RecordingError with all ``complaints`` about ``where``, a line each, if there are any."""
    lines = [f"{where}: {line}" for line in complaints]
    if lines:
        raise RecordingError("\n".join(lines))


# ---------------------------------------------------------------------- files


IMPORT = "; a log of another format becomes a recording by go1exp record import"


def read(path: Path) -> Recording:
    """Read and check one recording, correct nothing; RecordingError if it is missing, damaged or breaks the format."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = Path(path)
    if not path.is_file():
        raise RecordingError(f"{path}: no such file")
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            text = (file.metadata.metadata or {}).get(KEY)
            if text is None:
                raise RecordingError(
                    f"{path}: no schema metadata {KEY.decode()!r}; not a recording of this format{IMPORT}"
                )
            stop(path, _schema_problems(file))
            table = file.read()
    except (pa.ArrowException, OSError) as error:
        why = f"not a whole Parquet file ({str(error).splitlines()[0]})"
        with path.open("rb") as opened_again:
            parquet = opened_again.read(4) == b"PAR1"  # as every Parquet file begins
        raise RecordingError(f"{path}: {why}{'' if parquet else IMPORT}") from error
    try:
        meta = _META.validate_json(text)
    except ValidationError as error:
        stop(path, explain(error, "metadata", Meta.__dataclass_fields__))
        raise  # not reached: an error has lines
    stop(path, [f"{n}: has empty values" for n in table.column_names if table.column(n).null_count])
    recording = Recording(meta, {name: np.array(table.column(name).to_numpy()) for name in table.column_names})
    stop(path, problems(recording))
    return recording


def _schema_problems(file: pq.ParquetFile) -> list[str]:
    """List columns of a wrong type. Parquet's own schema is checked first: only plain numbers become arrays."""
    lines = []
    columns = [file.schema.column(i) for i in range(len(file.schema))]
    for column in columns:
        physical = "BOOLEAN" if column.path == FLAG else "DOUBLE"
        if column.physical_type != physical or column.max_repetition_level or column.logical_type.type != "NONE":
            kind = column.logical_type.type if column.logical_type.type != "NONE" else column.physical_type
            lines.append(f"{column.path}: is stored as {kind.lower()}, but must be {physical.lower()}")
    lines += [f"{name}: {n} columns of this name" for name, n in Counter(c.path for c in columns).items() if n > 1]
    if not lines:  # Arrow stores its own types in addition to Parquet's
        for field in file.schema_arrow:
            right = "bool" if field.name == FLAG else "double"
            if str(field.type) != right or b"ARROW:extension:name" in (field.metadata or {}):
                lines.append(f"{field.name}: is of an extension type ({field.type}), but must be plain {right}")
    return lines


def write(path: Path, recording: Recording) -> None:
    """Check a recording and write it. ``path`` is replaced in one step, so that no partial file is ever left.

    Values are stored bit for bit; folders are made as needed. RecordingError if the recording breaks the format;
    nothing is written then.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = Path(path)
    stop(path, problems(recording))
    table = pa.table({name: pa.array(values) for name, values in recording.channels.items()})
    table = table.replace_schema_metadata({KEY: as_json(recording.meta)})
    path.parent.mkdir(parents=True, exist_ok=True)
    with opened(path) as file:
        pq.write_table(table, file, compression="zstd", use_dictionary=False, write_page_checksum=True)


def read_folder(path: Path) -> list[Recording]:
    """Read all ``*.parquet`` of a folder by the order of names; RecordingError if there is none or one is damaged."""
    path = Path(path)
    files = sorted(path.glob("*.parquet"))
    if not files:
        raise RecordingError(f"{path}: no *.parquet in it" if path.is_dir() else f"{path}: no such folder")
    return [read(file) for file in files]
