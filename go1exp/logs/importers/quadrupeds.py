"""Unitree quadrupeds: one second of a walking Go1, and a Go2 whose trunk is held."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from go1exp.config.schema.registry import Positive, importer
from go1exp.logs.importers.source import LEVEL, Arrays, columns, files, joint_columns, load_npz, recording, reorder
from go1exp.logs.recording import VECTORS, Quaternion, Recording, RecordingError
from go1exp.robot import JOINT_KINDS, JOINTS

THEIR_JOINTS = tuple(f"{leg}_{kind}" for leg in ("FL", "FR", "RL", "RR") for kind in JOINT_KINDS)
"""Order of the joints in both sources."""

# ---------------------------------------- mass2010chromium/walk-these-ways, MIT

KP = 20.0
"""Position gain the source states, N m/rad."""
KD = 0.5
"""Velocity gain the source states, N m s/rad."""
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
    order = reorder(THEIR_JOINTS, JOINTS)
    channels = {"t": t}
    for quantity, key in (("q", "q"), ("qd", "dq"), ("q_target", "q_target")):
        channels |= joint_columns(quantity, JOINTS, data.numbers(key, len(JOINTS))[:, order])
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
