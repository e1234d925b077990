"""The filter run over a recording: the estimate at each sample, from the log alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from go1exp.deploy.estimation import FilterConfig, make_filter
from go1exp.deploy.estimation import readings as column
from go1exp.logs.recording import FOOT_FORCE, VECTORS, Recording, RecordingError
from go1exp.robot.attitude import levelled

JOINTS = 12


@dataclass(frozen=True)
class Log:
    """Properties of a robot's log that are not among the filter's settings.

    Attributes:
        leg_delay_s: legs and soles are soft: the trunk follows the motion of the joints later by this, s. It is not a
            difference between clocks.
        levelling_s: time constant for ``attitude.levelled``, used if the log has no ``imu_quat``, s.
    """

    leg_delay_s: float = 0.0
    levelling_s: float = 10.0


SCALER_LOG = Log(leg_delay_s=0.085, levelling_s=2.0)
"""The forward speed of SCALER oscillates at 4 Hz, 94 to 106 ms (eight runs) after that computed from its standing legs.
Vertically there is no delay, but 3.3 times the motion: the delay is right for forward velocity only."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """The filter's output for a log; rows as in the recording.

    Attributes:
        t: s (T,).
        position_w: position of the trunk's origin, m (T, 3). The origin of the world is below the first sample; heading
            is that of the IMU.
        velocity_b: velocity of the trunk's origin in the trunk frame, m/s (T, 3).
        quat: attitude that was used, w-x-y-z (T, 4).
        contact: contact of each foot, 0 to 1 (T, 4).
        status: ``Status`` of each sample (T,).
    """

    t: np.ndarray
    position_w: np.ndarray
    velocity_b: np.ndarray
    quat: np.ndarray
    contact: np.ndarray
    status: np.ndarray


def samples(recording: Recording, log: Log | None = None) -> np.ndarray:
    """Return the log as input of the filter, ``(T, 51)``; missing quantities are NaN.

    Raises:
        RecordingError: if the robot does not have twelve joints, or the IMU or the joint angles are missing.
    """
    log = log or Log()
    joints = recording.meta.joints
    if len(joints) != JOINTS:
        raise RecordingError(f"{recording.meta.episode}: has {len(joints)} joints; the filter is for legs of 4 x 3")
    t = recording.t
    rows = np.full((len(t), column.WIDTH), np.nan)
    rows[:, column.T] = t
    gyro, acc = (recording.block(*VECTORS[f"imu_{name}"]) for name in ("gyro", "acc"))
    if VECTORS["imu_quat"][0] in recording.channels:
        quat = recording.block(*VECTORS["imu_quat"])
    else:
        quat = levelled(t, gyro, acc, seconds=log.levelling_s)
    rows[:, column.GYRO], rows[:, column.ACC], rows[:, column.QUAT] = gyro, acc, quat
    for place, name in ((column.Q, "q"), (column.QD, "qd"), (column.TAU, "tau_est")):
        if name == "q" or recording.has(name):
            values = recording.joint(name)
            if log.leg_delay_s:
                values = np.stack([np.interp(t - log.leg_delay_s, t, one) for one in values.T], axis=1)
            rows[:, place] = values
    # Three joints per leg, leg by leg: the first joint of each names the leg.
    feet = [FOOT_FORCE + joint.split("_")[0] for joint in joints[::3]]
    if all(foot in recording.channels for foot in feet):
        rows[:, column.FOOT_FORCE] = recording.block(*feet)
    return rows


def estimate(recording: Recording, config: FilterConfig, log: Log | None = None) -> Estimate:
    """Run the compiled filter over a recording.

    Raises:
        RecordingError: if something is missing (see ``samples``).
        EstimatorError: if the filter is not built.
    """
    rows = samples(recording, log)
    states = make_filter(config).run(rows)
    return Estimate(
        rows[:, column.T], states[:, :3], states[:, 3:6], rows[:, column.QUAT], states[:, 6:10], states[:, 10]
    )
