"""Published recordings: arms and pendulums on a fixed base, a walking Go1, and a Go2 whose trunk is held."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from go1exp.config.schema.registry import Positive, explain, importer
from go1exp.logs.importers.source import LEVEL, Arrays, files, load_npz, recording
from go1exp.logs.recording import VECTORS, Quaternion, Recording, RecordingError, columns, joint_columns
from go1exp.robot import JOINT_KINDS, JOINTS

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
        channels |= {f"{quantity}_{joint}": data.numbers(f"{name}{k}") for k, joint in enumerate(SHOULDER_ELBOW, 1)}
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


def _design(path: Path) -> str:
    for design in ("A", "C"):
        if path.resolve().parent.name.startswith(f"design_{design}"):
            return design
    raise RecordingError(
        f"{path}: set design=A or design=C; the name of its folder is neither design_A... nor design_C..."
    )


# ---------------------------------------- Rhoban/bam, Apache 2.0

MOST_LINES = 3  # most problems of a file that are reported: a missing key is missing in every row

PENDULUM = "pendulum"

SERVO_NOTES = (
    "{log.mass:g} kg at {log.length:g} m on the horn of an {log.motor}; the mass of the arm itself is not given. "
    "Position gain {log.kp:g} in the firmware's own unit, not N m/rad. "
    "Supply {volts[0]:g} to {volts[1]:g} V ({log.vin:g} V nominal), case {case[0]:g} to {case[1]:g} C. "
    "Torque is not measured: the actuator's raw word 'load' has no unit and is left out. "
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
    volts, case = ((table[name].min(), table[name].max()) for name in ("input_volts", "temp"))
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
        notes=SERVO_NOTES.format(log=log, volts=volts, case=case),
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


THEIR_JOINTS = tuple(f"{leg}_{kind}" for leg in ("FL", "FR", "RL", "RR") for kind in JOINT_KINDS)
"""Order of the joints in both sources of quadrupeds."""

ORDER = [THEIR_JOINTS.index(name) for name in JOINTS]
"""The index that puts their joints into our order."""

# ---------------------------------------- mass2010chromium/walk-these-ways, MIT

KP = 20.0  # position gain the source states, N m/rad
KD = 0.5  # velocity gain the source states, N m s/rad
TORQUE_TOLERANCE = 1e-3
"""Largest difference between the source's PD torque and that of these gains, N m (float32 rounding)."""

WALK_NOTES = (
    "t is the step count times 0.02 s, not a clock. imu_quat is the IMU's roll, pitch and yaw written as a quaternion. "
    "No measured torque: the source's tau_pd_computed is kp (q_target - q) - kd qd, worked out with the q and qd of "
    "the row before, so a row's target was sent one step before its state was read. Contact was recorded as 0 or 1 "
    "from thresholds, not as a force."
)


@importer("go1_walk_snippet")
def go1_walk_snippet(path: Path) -> list[Recording]:
    """Real Go1 walking under a learned policy at 50 Hz, from .npz.

    ``tau_pd_computed`` is not measured: it is used only to check the gains. Joints are put into our order.

    Args:
        path: a ``.npz``, or a folder of them.

    Raises:
        RecordingError: if an array is missing or of another shape, or the torques belong to other gains.
    """
    return [_walk(file) for file in files(path, "*.npz")]


def _walk(path: Path) -> Recording:
    from scipy.spatial.transform import Rotation  # slow to import, and settings are checked first

    data = load_npz(path)
    _check_gains(data)
    t = data.numbers("t")
    channels = {"t": t}
    for quantity, key in (("q", "q"), ("qd", "dq"), ("q_target", "q_target")):
        channels |= joint_columns(quantity, JOINTS, data.numbers(key, len(JOINTS))[:, ORDER])
    channels |= columns(VECTORS["imu_gyro"], data.numbers("gyro", 3))
    channels |= columns(VECTORS["imu_acc"], data.numbers("accel", 3))
    xyzw = Rotation.from_euler("xyz", data.numbers("rpy", 3)).as_quat()
    channels |= columns(VECTORS["imu_quat"], xyzw[:, [3, 0, 1, 2]])
    return recording(
        path,
        "go1_walk_snippet",
        channels,
        robot="go1",
        joints=JOINTS,
        base="floating",
        kp=(KP,) * len(JOINTS),
        kd=(KD,) * len(JOINTS),
        excitation="walking_policy",
        notes=WALK_NOTES,
    )


def _check_gains(data: Arrays) -> None:
    """Check the assumed gains: the file does not have them, but has torques that its logger computed with them."""
    q, qd, target, target_qd, torque = (
        data.numbers(key, len(JOINTS)) for key in ("q", "dq", "q_target", "dq_target", "tau_pd_computed")
    )
    if len({len(values) for values in (q, qd, target, target_qd, torque)}) > 1:
        raise RecordingError(f"{data.path}: q, dq, q_target, dq_target and tau_pd_computed must be of one length")
    # The logger computed a row's torque from the state of the row before.
    again = KP * (target[1:] - q[:-1]) + KD * (target_qd[1:] - qd[:-1])
    if not np.allclose(again, torque[1:], rtol=0, atol=TORQUE_TOLERANCE):
        raise RecordingError(f"{data.path}: tau_pd_computed: does not belong to kp = {KP:g}, kd = {KD:g}")


# ---------------------------------------- lupinjia/genesis_lr, BSD 3-Clause

AIR_NOTES = (
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
    return [_in_air(file, rate_hz, base_quat) for file in files(path, "*.csv")]


def _in_air(path: Path, rate_hz: float, base_quat: Quaternion) -> Recording:
    table = _read(path)
    numbers = range(len(JOINTS))
    channels = {"t": np.arange(len(next(iter(table.values())))) / rate_hz}
    for quantity, name in (("q", "jpos{}"), ("qd", "jvel{}"), ("q_target", "jpos{}_des")):
        block = np.stack([_column(path, table, name.format(i)) for i in numbers], axis=1)
        channels |= joint_columns(quantity, JOINTS, block[:, ORDER])
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
        notes=AIR_NOTES.format(rate=rate_hz),
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
