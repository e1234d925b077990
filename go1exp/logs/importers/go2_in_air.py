"""Unitree Go2 with its trunk held and its feet in the air (``lupinjia/genesis_lr``, BSD 3-Clause)."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from go1exp.config.schema.registry import Positive, importer
from go1exp.logs.importers.source import LEVEL, columns, files, joint_columns, recording, reorder
from go1exp.logs.recording import Quaternion, Recording, RecordingError
from go1exp.robot import JOINT_KINDS, JOINTS

THEIR_JOINTS = tuple(f"{leg}_{kind}" for leg in ("FL", "FR", "RL", "RR") for kind in JOINT_KINDS)

NOTES = (
    "No clock in the source: t = row / {rate:g} Hz, the rate of the source's file name. "
    "The sum of qd over time is 1.11 to 1.17 times the change of q, so trust q first. "
    "Targets change every fourth row. No measured torque. "
    "The trunk was held; its attitude was not recorded and is taken from the option base_quat."
)


@importer("go2_in_air")
def go2_in_air(path: Path, *, rate_hz: Positive = 200.0, base_quat: Quaternion = LEVEL) -> list[Recording]:
    """Legs of a Unitree Go2 that a walking policy moves in the air, from CSV without a clock.

    The Go2 has the same joints as the Go1; they get our names and order. ``robot`` is ``go2``.

    Args:
        path: a ``.csv``, or a folder of them.
        rate_hz: rows per second, Hz.
        base_quat: attitude in which the trunk was held, w-x-y-z.

    Raises:
        RecordingError: if a column is missing, a value is not a number, or the gains change.
    """
    return [_one(file, rate_hz, base_quat) for file in files(path, "*.csv")]


def _one(path: Path, rate_hz: float, base_quat: Quaternion) -> Recording:
    table = _read(path)
    numbers = range(len(JOINTS))
    order = reorder(THEIR_JOINTS, JOINTS)
    channels = {"t": np.arange(len(next(iter(table.values())))) / rate_hz}
    for quantity, name in (("q", "jpos{}"), ("qd", "jvel{}"), ("q_target", "jpos{}_des")):
        block = np.stack([_column(path, table, name.format(i)) for i in numbers], axis=1)
        channels |= joint_columns(quantity, JOINTS, block[:, order])
    return recording(
        path,
        "go2_in_air",
        channels,
        robot="go2",
        joints=JOINTS,
        rate_hz=rate_hz,
        base="fixed",
        base_quat=base_quat,
        kp=(_constant(path, table, "kp"),) * len(JOINTS),
        kd=(_constant(path, table, "kd"),) * len(JOINTS),
        excitation="walking_policy_in_air",
        episode=path.stem,
        notes=NOTES.format(rate=rate_hz),
    )


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header = next(csv.reader(file), [])
            body = file.read()
        if not body.strip():
            raise RecordingError(f"{path}: has no rows of numbers")
        values = np.loadtxt(body.splitlines(), delimiter=",", ndmin=2)
    except (OSError, ValueError, csv.Error) as error:
        raise RecordingError(f"{path}: not a table of numbers ({error})") from error
    if values.shape[1] != len(header) or len(set(header)) != len(header):
        raise RecordingError(f"{path}: must have one name for each of its {values.shape[1]} columns, not {header}")
    return columns(header, values)


def _column(path: Path, table: dict[str, np.ndarray], name: str) -> np.ndarray:
    if name not in table:
        raise RecordingError(f"{path}: no column {name!r}; it has {', '.join(table)}")
    return table[name]


def _constant(path: Path, table: dict[str, np.ndarray], name: str) -> float:
    values = _column(path, table, name)
    if np.ptp(values) != 0:
        raise RecordingError(f"{path}: {name}: must be one value, but goes from {values.min()} to {values.max()}")
    return float(values[0])
