"""Dynamixel XL330 position servo turning a pendulum (``Rhoban/bam``, Apache 2.0)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from go1exp.config.schema.registry import explain, importer
from go1exp.logs.importers.source import LEVEL, files, rate, recording
from go1exp.logs.recording import Recording, RecordingError

MOST_LINES = 3
"""Most problems of a file that are reported: a missing key is missing in every row."""

JOINT = "pendulum"

NOTES = (
    "{mass:g} kg at {length:g} m on the horn of an {motor}; the mass of the arm itself is not given. "
    "Position gain {gain:g} in the firmware's own unit, not N m/rad. Supply {low:g} to {high:g} V ({vin:g} V nominal), "
    "case {cold:g} to {warm:g} C. Torque is not measured: the drive's raw word 'load' has no unit and is left out. "
    "The angle counts from hanging down."
)


class _Row(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    timestamp: float
    position: float
    speed: float
    goal_position: float
    torque_enable: bool
    input_volts: float
    temp: float


class _Log(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    mass: float
    length: float
    kp: float
    vin: float
    motor: str
    trajectory: str
    entries: list[_Row]


@importer("servo_pendulum_xl330")
def servo_pendulum_xl330(path: Path) -> list[Recording]:
    """Pendulum on an XL330 servo, from the JSON of one motion at one firmware gain.

    ``goal_position`` becomes ``q_target``; while ``torque_enable`` is false the mass falls freely and the target has
    no effect. The gain is given in ``notes`` only, as its unit is not that of the format.

    Args:
        path: a ``.json``, or a folder of them.

    Raises:
        RecordingError: if a file is not such a log, or lacks a key.
    """
    return [_one(file) for file in files(path, "*.json")]


def _one(path: Path) -> Recording:
    try:
        log = _Log.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        lines = explain(error, "", ()) if isinstance(error, ValidationError) else [str(error)]
        omitted = [f"and {len(lines) - MOST_LINES} more"] if len(lines) > MOST_LINES else []
        raise RecordingError("\n".join(f"{path}: {line}" for line in lines[:MOST_LINES] + omitted)) from error
    if not log.entries:
        raise RecordingError(f"{path}: entries: must not be empty")
    table = {key: np.array([getattr(row, key) for row in log.entries]) for key in _Row.model_fields}
    volts, case = table["input_volts"], table["temp"]
    channels = {
        "t": table["timestamp"],
        f"q_{JOINT}": table["position"],
        f"qd_{JOINT}": table["speed"],
        f"q_target_{JOINT}": table["goal_position"],
        "torque_enable": table["torque_enable"],
    }
    return recording(
        path,
        "servo_pendulum_xl330",
        channels,
        robot="servo_pendulum_xl330",
        joints=(JOINT,),
        rate_hz=rate(path, channels["t"]),
        base="fixed",
        base_quat=LEVEL,
        excitation=log.trajectory,
        episode=path.stem,
        notes=NOTES.format(
            mass=log.mass,
            length=log.length,
            motor=log.motor,
            gain=log.kp,
            vin=log.vin,
            low=volts.min(),
            high=volts.max(),
            cold=case.min(),
            warm=case.max(),
        ),
    )
