"""Arms and pendulums on a fixed base: two T-Motor AK80-6, a Dynamixel XL330, a LeRobot SO-101."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from go1exp.config.schema.registry import explain, importer
from go1exp.logs.importers.source import LEVEL, Arrays, files, joint_columns, load_npz, recording
from go1exp.logs.recording import Quaternion, Recording, RecordingError

# ---------------------------------------- dfki-ric-underactuated-lab/double_pendulum, BSD 3-Clause

SHOULDER_ELBOW = ("shoulder", "elbow")

PENDULUM_NOTES = (
    "Design {design}. The shoulder's angle counts from hanging down, the elbow's from the first link. "
    "tau_est comes from the motor current, not from a torque sensor. The clock jitters by milliseconds. "
    "Joint gains are unknown: the actuators were given torques. "
)
OPEN_LOOP = "The torques were played open loop; there is no target."
FOLLOWED = (
    "A controller on the computer followed q_target, with torques up to 8 N m of which the actuators report "
    "a part only. Its target velocities have no column."
)


@importer("ak80_double_pendulum")
def ak80_double_pendulum(path: Path, *, design: Literal["A", "C"] | None = None) -> list[Recording]:
    """Shoulder and elbow turned by two AK80-6 quasi-direct drives, from the .npz of one run.

    ``tau_con`` becomes ``tau_cmd``, ``tau_meas`` ``tau_est``, and ``pos_des`` ``q_target`` where the source has one.
    The source's filtered positions and velocities equal the measured ones and are left out.

    Args:
        path: a ``.npz``, or a folder with ``design_A*/*.npz`` and ``design_C*/*.npz`` in it.
        design: links of 0.3 and 0.2 m (A) or 0.2 and 0.3 m (C); by default taken from the name of the file's folder.

    Raises:
        RecordingError: if an array is missing, the design is unknown or time does not increase strictly.
    """
    return [_double_pendulum(file, design) for file in files(path, "*.npz")]


def _double_pendulum(path: Path, design: str | None) -> Recording:
    design = design or _design(path)
    data = load_npz(path)
    t = data.numbers("time")
    followed = "pos_des1" in data or "pos_des2" in data
    channels = {"t": t}
    names = {"q": "pos_meas", "qd": "vel_meas", "tau_est": "tau_meas", "tau_cmd": "tau_con"}
    if followed:
        names["q_target"] = "pos_des"
    for quantity, name in names.items():
        channels |= joint_columns(quantity, SHOULDER_ELBOW, _pair(data, name))
    return recording(
        path,
        "ak80_double_pendulum",
        channels,
        robot=f"ak80_double_pendulum_{design.lower()}",
        joints=SHOULDER_ELBOW,
        base="fixed",
        base_quat=LEVEL,
        excitation="tracking" if followed else "open_loop_torque",
        episode=f"ak80_{design.lower()}_{path.stem}",
        notes=PENDULUM_NOTES.format(design=design) + (FOLLOWED if followed else OPEN_LOOP),
    )


def _pair(data: Arrays, name: str) -> np.ndarray:
    first, second = data.numbers(f"{name}1"), data.numbers(f"{name}2")
    if len(first) != len(second):
        raise RecordingError(f"{data.path}: {name}1 has {len(first)} values, {name}2 has {len(second)}")
    return np.stack([first, second], axis=1)


def _design(path: Path) -> str:
    for design in ("A", "C"):
        if path.resolve().parent.name.startswith(f"design_{design}"):
            return design
    raise RecordingError(
        f"{path}: set design=A or design=C; the name of its folder is neither design_A... nor design_C..."
    )


# ---------------------------------------- Rhoban/bam, Apache 2.0

MOST_LINES = 3
"""Most problems of a file that are reported: a missing key is missing in every row."""

PENDULUM = "pendulum"

SERVO_NOTES = (
    "{mass:g} kg at {length:g} m on the horn of an {motor}; the mass of the arm itself is not given. "
    "Position gain {gain:g} in the firmware's own unit, not N m/rad. Supply {low:g} to {high:g} V ({vin:g} V nominal), "
    "case {cold:g} to {warm:g} C. Torque is not measured: the actuator's raw word 'load' has no unit and is left out. "
    "The angle counts from hanging down."
)


class _ServoRow(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    timestamp: float
    position: float
    speed: float
    goal_position: float
    torque_enable: bool
    input_volts: float
    temp: float


class _ServoLog(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    mass: float
    length: float
    kp: float
    vin: float
    motor: str
    trajectory: str
    entries: list[_ServoRow]


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
    return [_servo_pendulum(file) for file in files(path, "*.json")]


def _servo_pendulum(path: Path) -> Recording:
    try:
        log = _ServoLog.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        lines = explain(error, "", ()) if isinstance(error, ValidationError) else [str(error)]
        omitted = [f"and {len(lines) - MOST_LINES} more"] if len(lines) > MOST_LINES else []
        raise RecordingError("\n".join(f"{path}: {line}" for line in lines[:MOST_LINES] + omitted)) from error
    if not log.entries:
        raise RecordingError(f"{path}: entries: must not be empty")
    table = {key: np.array([getattr(row, key) for row in log.entries]) for key in _ServoRow.model_fields}
    volts, case = table["input_volts"], table["temp"]
    channels = {
        "t": table["timestamp"],
        f"q_{PENDULUM}": table["position"],
        f"qd_{PENDULUM}": table["speed"],
        f"q_target_{PENDULUM}": table["goal_position"],
        "torque_enable": table["torque_enable"],
    }
    return recording(
        path,
        "servo_pendulum_xl330",
        channels,
        robot="servo_pendulum_xl330",
        joints=(PENDULUM,),
        base="fixed",
        base_quat=LEVEL,
        excitation=log.trajectory,
        notes=SERVO_NOTES.format(
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


# ---------------------------------------- isaac-sim2real/sage, Apache 2.0

JAW = "Jaw"

ARM_NOTES = (
    "Command and state were read one after the other over one bus, so a delay of a few tens of milliseconds "
    "includes the bus. The jaw's position is a fraction from 0 to 1, not an angle, and is left out. "
    "Torque is not measured: the source's torque_abs, a scaled current without a sign, is left out. "
    "The servos' gains are unknown. The home pose must be taken from the arm's public description; "
    "the attitude of its base is that of the option base_quat."
)


@importer("so101_arm")
def so101_arm(path: Path, *, base_quat: Quaternion = LEVEL) -> list[Recording]:
    """One motion of a real SO-101 arm, five joints without the jaw, from .npz.

    Args:
        path: a ``.npz``, or a folder of them.
        base_quat: attitude of the arm's base, w-x-y-z.

    Raises:
        RecordingError: if an array is missing or of another shape.
    """
    return [_arm(file, base_quat) for file in files(path, "*.npz")]


def _arm(path: Path, base_quat: Quaternion) -> Recording:
    data = load_npz(path)
    names = data.names("joint_names")
    if JAW not in names:
        raise RecordingError(f"{path}: joint_names: must have {JAW!r} among them, but are {', '.join(names)}")
    joints = tuple(name for name in names if name != JAW)
    kept = np.flatnonzero([name != JAW for name in names])
    channels = {"t": data.numbers("t")}
    for quantity, key in (("q", "pos"), ("qd", "vel"), ("q_target", "cmd_pos")):
        channels |= joint_columns(quantity, joints, data.numbers(key, len(names))[:, kept])
    return recording(
        path,
        "so101_arm",
        channels,
        robot="so101",
        joints=joints,
        base="fixed",
        base_quat=base_quat,
        excitation=path.stem,
        episode=f"so101_{path.stem}",
        notes=ARM_NOTES,
    )
