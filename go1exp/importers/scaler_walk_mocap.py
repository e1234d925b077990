"""UCLA's quadruped SCALER walking under motion capture (``AlexS28/OptiState``, MIT)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from go1exp.importers.source import Arrays, columns, files, joint_columns, load_npz, rate, recording
from go1exp.recording import FOOT_FORCE, VECTORS, Recording, RecordingError
from go1exp.registry import Positive, importer

LEGS = ("FL", "FR", "RR", "RL")
"""The source's legs 1 to 4; its joints have numbers only."""
JOINTS = tuple(f"{leg}_{number}" for leg in LEGS for number in (1, 2, 3))

WILD_FORCE = 200.0
"""N; more than twice the robot's weight (8.8 kg) on one foot is a fault of the sensor (chosen)."""

NOTES = (
    "The source's joint velocity is 1.5 to 1.7 times the derivative of q and is left out: differentiate q. "
    "Encoders repeat their last value in many samples. imu_gyro and imu_acc have the source's signs turned so that "
    "their axes are the body's (acc +9.8 in z at rest). Gyro offset: about 0.005 rad/s in yaw; the robot stands still "
    "at the end. The source's contact flags are a fixed pattern in some runs and are left out."
)


@importer("scaler_walk_mocap")
def scaler_walk_mocap(path: Path, *, mocap_tolerance_s: Positive = 0.0065) -> list[Recording]:
    """Walk of the 8.8 kg quadruped SCALER with motion-capture truth, from .npz.

    Joints are ``FL_1`` ... ``RL_3`` in the source's order FL FR RR RL; ``foot_force_FL`` ... are magnitudes, as the
    sensor's axes are not the body's. A leg whose sensor gave nothing, or was broken all along, has no column.

    Motion capture ran on a clock of its own, which the source shifted onto the robot's. Each row takes the nearest
    valid sample, never one worked out between two; ``base_pos`` is the marker body's origin and ``base_quat`` the
    body's attitude through the source's fixed rotation, good to a few degrees. If any row has no valid sample within
    the tolerance, the recording has neither.

    Args:
        path: a ``.npz``, or a folder of them.
        mocap_tolerance_s: largest time between a row and its motion-capture sample, s (default: half of the
            capture's longest period).

    Raises:
        RecordingError: if an array is missing or of another shape.
    """
    return [_one(file, mocap_tolerance_s) for file in files(path, "*.npz")]


def _one(path: Path, tolerance: float) -> Recording:
    data = load_npz(path)
    t = data.numbers("t")
    q = data.numbers("joint_pos", 4, 3)
    channels = {"t": t, **joint_columns("q", JOINTS, q.reshape(len(q), -1))}
    channels |= columns(VECTORS["imu_gyro"], data.numbers("gyro_body", 3))
    channels |= columns(VECTORS["imu_acc"], data.numbers("accel_body", 3))
    forces, force_notes = _foot_forces(data)
    truth, truth_notes = _truth(data, t, tolerance)
    return recording(
        path,
        "scaler_walk_mocap",
        channels | forces | truth,
        robot="scaler",
        joints=JOINTS,
        rate_hz=rate(path, t),
        base="floating",
        excitation="walk",
        episode=f"scaler_{path.stem}",
        notes=" ".join([NOTES, *force_notes, truth_notes]),
    )


def _foot_forces(data: Arrays) -> tuple[dict[str, np.ndarray], list[str]]:
    """Magnitude of each foot's force, and what is wrong with it."""
    force = np.linalg.norm(data.numbers("foot_wrench_raw", 4, 6)[:, :, :3], axis=2)
    found, notes = {}, []
    for leg, values in zip(LEGS, force.T, strict=True):
        wild = int((values > WILD_FORCE).sum())
        if not values.any():
            notes.append(f"The force sensor of {leg} gave nothing.")
        elif wild > len(values) / 2:
            notes.append(f"The force sensor of {leg} was broken: {wild} of {len(values)} values exceed 200 N.")
        else:
            found[FOOT_FORCE + leg] = np.ascontiguousarray(values)
            if wild:
                notes.append(f"foot_force_{leg} has {wild} wild values above 200 N.")
    if found:
        notes.append("Foot forces drift; they are magnitudes in the sensor's frame.")
    return found, notes


def _truth(data: Arrays, t: np.ndarray, tolerance: float) -> tuple[dict[str, np.ndarray], str]:
    """Position and attitude of the base by the nearest motion-capture sample, if every row has one."""
    from scipy.spatial.transform import Rotation  # slow to import, and settings are checked first

    clock, valid = data.numbers("mocap_t"), data.numbers("mocap_valid") > 0
    position, xyzw = data.numbers("mocap_pos", 3), data.numbers("mocap_quat_xyzw", 4)
    to_body = data.numbers("mocap_to_body_rot", 3)
    if not len(clock) == len(valid) == len(position) == len(xyzw) or len(to_body) != 3 or len(clock) < 2:
        raise RecordingError(f"{data.path}: mocap_t, mocap_valid, mocap_pos and mocap_quat_xyzw must be of one length")
    if (np.diff(clock) <= 0).any():
        raise RecordingError(f"{data.path}: mocap_t: must increase strictly")
    right = np.clip(np.searchsorted(clock, t), 1, len(clock) - 1)
    near = np.where(t - clock[right - 1] < clock[right] - t, right - 1, right)
    lost = int((~valid[near] | (np.abs(clock[near] - t) > tolerance)).sum())
    if lost:
        return {}, f"No ground truth: {lost} rows have no valid motion capture within {tolerance:g} s."
    attitude = Rotation.from_quat(xyzw[near]) * Rotation.from_matrix(to_body).inv()
    truth = columns(VECTORS["base_pos"], position[near])
    truth |= columns(VECTORS["base_quat"], attitude.as_quat()[:, [3, 0, 1, 2]])
    return truth, (
        f"Ground truth is the nearest motion-capture sample, up to {np.abs(clock[near] - t).max() * 1000:.1f} ms away, "
        "on a clock that was shifted onto the robot's; its position is the marker body's, its attitude good to a few "
        "degrees; take the start heading as unknown."
    )
