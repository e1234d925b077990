"""One second of a walking Unitree Go1 (``mass2010chromium/walk-these-ways``, MIT)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from go1exp.config.schema.registry import importer
from go1exp.logs.importers.source import Arrays, columns, files, joint_columns, load_npz, rate, recording, reorder
from go1exp.logs.recording import VECTORS, Recording, RecordingError
from go1exp.robot import JOINT_KINDS, JOINTS

THEIR_JOINTS = tuple(f"{leg}_{kind}" for leg in ("FL", "FR", "RL", "RR") for kind in JOINT_KINDS)

KP = 20.0
"""Position gain the source states, N m/rad."""
KD = 0.5
"""Velocity gain the source states, N m s/rad."""
TORQUE_TOLERANCE = 1e-3
"""Largest difference between the source's PD torque and that of these gains, N m (float32 rounding)."""

NOTES = (
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
    return [_one(file) for file in files(path, "*.npz")]


def _one(path: Path) -> Recording:
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
        rate_hz=rate(path, t),
        base="floating",
        kp=(KP,) * len(JOINTS),
        kd=(KD,) * len(JOINTS),
        excitation="walking_policy",
        episode=path.stem,
        notes=NOTES,
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
