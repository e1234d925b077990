"""UCLA's quadruped SCALER walking under motion capture (``AlexS28/OptiState``, MIT)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from go1exp.config.schema.registry import Positive, importer
from go1exp.logs.importers.source import Arrays, files, load_npz, recording
from go1exp.logs.recording import FOOT_FORCE, VECTORS, Recording, RecordingError, columns, joint_columns
from go1exp.robot import GRAVITY

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

LEGS = ("FL", "FR", "RR", "RL")  # legs 1 to 4 of the source; its joints have numbers and no names
JOINTS = tuple(f"{leg}_{number}" for leg in LEGS for number in (1, 2, 3))

WILD_FORCE = 200.0  # N; more than twice the weight of the robot (8.8 kg) on one foot is an error of the sensor (chosen)

NOTES = (
    "The source's joint velocity is 1.5 to 1.7 times the derivative of q and is left out: differentiate q. "
    "Encoders repeat their last value in many samples. imu_gyro has the source's signs turned so that its axes are the "
    "body's. Gyro offset: about 0.005 rad/s in yaw; the robot stands still at the end. The source's contact flags are "
    "a fixed pattern in some runs and are left out. Joints, IMU and forces share a clock (forces set in within 20 ms "
    "of a front foot's touch-down, their sum follows imu_acc within 20 ms), but legs and soles are soft: the body "
    "heaves 3.3 times as much as the joints say, and its forward speed swings some 85 to 105 ms after that of the legs."
)

TURNED = (
    "imu_acc is worked out: the source reports gravity right and every other acceleration with its sign turned, so "
    "imu_acc = 2 x 9.81 z - accel_body, z the world's vertical by gyro and accelerometer; while walking that is off by "
    "a degree or two, imu_acc by twice as much of g. Evidence, eight runs: motion capture's acceleration enters "
    "accel_body by -0.9 to -1.4 on every axis (R2 0.64 to 0.95), and the sum of the foot forces follows the vertical "
    "part once turned back (five runs, correlation 0.86 to 0.95)."
)
AS_LOGGED = "imu_acc is no specific force: all of it but gravity has its sign turned (reversed_acceleration: false)."

MOVING_GYRO, MOVING_BODY = 0.3, 0.1
"""rad/s and m/s above which the robot moves, by gyro and by motion capture; at rest they read 0.005 and 0.02."""

STOPS_LATER = 0.05
"""s between the last motion by ``MOVING_GYRO`` and the last by ``MOVING_BODY``, which is later (seven runs: 0.04 to
0.06)."""

CLOCK_SURE = 0.2
"""s; smaller differences of the clocks are not corrected: the source's match of rotation rates is better than that if
it has the right stride (chosen; a stride lasts 0.51 s)."""


@importer("scaler_walk_mocap")
def scaler_walk_mocap(
    path: Path,
    *,
    mocap_tolerance_s: Positive = 0.0065,
    resync: bool = True,
    reversed_acceleration: bool = True,
    levelling_s: Positive = 2.0,
) -> list[Recording]:
    """Walk of the 8.8 kg quadruped SCALER with motion-capture truth, from .npz.

    Joints are ``FL_1`` ... ``RL_3`` in the source's order FL FR RR RL. ``foot_force_FL`` ... are magnitudes: the
    axes of the sensor are not those of the body. A leg whose sensor gave nothing, or was broken throughout, has no
    column. Rows whose joints or IMU are not finite, or whose time does not advance, are left out.

    Motion capture had its own clock, which the source shifted onto that of the robot by matching rotation rates; in
    run 14 it chose the wrong stride. Each row takes the nearest valid sample; samples are not interpolated.
    ``base_pos`` is the origin of the marker body, and ``base_quat`` the attitude of the body by the source's fixed
    rotation, accurate to a few degrees. If any row has no valid sample within the tolerance, both are left out.

    Args:
        path: a ``.npz``, or a folder of them.
        mocap_tolerance_s: largest time between a row and its motion-capture sample, s (default: half of the
            capture's longest period).
        resync: whether motion capture is shifted by whole strides if the robot stops at different times by motion
            capture and by the gyro.
        reversed_acceleration: whether the source's accelerometer has the wrong sign on everything except gravity, as in
            all eight runs; the sign is then corrected.
        levelling_s: time constant with which the vertical used for that follows the accelerometer, s (default: four
            strides; of 1 to 10 s it agreed best with motion capture: 1 to 2 degrees while walking, 0.5 at rest).

    Raises:
        RecordingError: if an array is missing or of another shape.
    """
    return [
        _one(file, mocap_tolerance_s, resync, levelling_s if reversed_acceleration else None)
        for file in files(path, "*.npz")
    ]


def _one(path: Path, tolerance: float, resync: bool, levelling: float | None) -> Recording:
    from go1exp.robot.attitude import levelled, vertical  # slow to import, and settings are checked first

    data, rows, row_notes = open_run(path)
    t, q, gyro = (data.numbers("t")[rows], data.numbers("joint_pos", 4, 3)[rows], data.numbers("gyro_body", 3)[rows])
    acc = data.numbers("accel_body", 3)[rows]
    channels = {"t": t, **joint_columns("q", JOINTS, q.reshape(len(q), -1))}
    channels |= columns(VECTORS["imu_gyro"], gyro)
    if levelling is not None:  # the sign of everything except gravity is wrong (see ``TURNED``)
        acc = 2 * GRAVITY * vertical(levelled(t, gyro, acc, seconds=levelling)) - acc
    channels |= columns(VECTORS["imu_acc"], acc)
    forces, force_notes = _foot_forces(data, rows)
    truth, truth_notes = _truth(data, t, gyro, tolerance, resync)
    return recording(
        path,
        "scaler_walk_mocap",
        channels | forces | truth,
        robot="scaler",
        joints=JOINTS,
        base="floating",
        excitation="walk",
        episode=f"scaler_{path.stem}",
        notes=" ".join([NOTES, AS_LOGGED if levelling is None else TURNED, *row_notes, *force_notes, truth_notes]),
    )


def open_run(path: Path) -> tuple[Arrays, np.ndarray, list[str]]:
    """Open a run; return its arrays, the valid rows of the robot's log, and a note if others were left out.

    Raises:
        RecordingError: if an array of the robot's log is missing, or fewer than two rows are valid.
    """
    data = load_npz(path)
    t = data.numbers("t")
    parts = [data.numbers("joint_pos", 4, 3), data.numbers("gyro_body", 3), data.numbers("accel_body", 3)]
    if any(len(part) != len(t) for part in parts):
        raise RecordingError(f"{path}: t, joint_pos, gyro_body and accel_body must be of one length")
    sound = np.isfinite(t)
    for part in parts:
        sound &= np.isfinite(part.reshape(len(t), -1)).all(axis=1)
    # A row counts only if its time is later than that of every valid row before it.
    ahead = np.maximum.accumulate(np.where(sound, t, -np.inf))
    sound[1:] &= t[1:] > ahead[:-1]
    if sound.sum() < 2:
        raise RecordingError(f"{path}: fewer than two rows have finite joints and IMU and a time that advances")
    lost = int((~sound).sum())
    return data, np.flatnonzero(sound), [f"{lost} rows were not finite or not newer and are left out."] if lost else []


def _foot_forces(data: Arrays, rows: np.ndarray) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the magnitude of the force on each foot, and notes on flaws of the sensors."""
    if "foot_wrench_raw" not in data:
        return {}, ["There are no foot forces."]
    wrench = data.numbers("foot_wrench_raw", 4, 6)
    if len(wrench) <= rows[-1]:
        raise RecordingError(f"{data.path}: foot_wrench_raw: must have as many rows as t")
    force = np.linalg.norm(wrench[rows, :, :3], axis=2)
    forces, notes = {}, []
    for leg, values in zip(LEGS, force.T, strict=True):
        wild = int((values > WILD_FORCE).sum())
        if not np.isfinite(values).all():
            notes.append(f"The force sensor of {leg} was not finite throughout.")
        elif not values.any():
            notes.append(f"The force sensor of {leg} gave nothing.")
        elif wild > len(values) / 2:
            notes.append(f"The force sensor of {leg} was broken: {wild} of {len(values)} values exceed 200 N.")
        else:
            forces[FOOT_FORCE + leg] = np.ascontiguousarray(values)
            if wild:
                notes.append(f"foot_force_{leg} has {wild} wild values above 200 N.")
    if forces:
        notes.append("Foot forces drift; they are magnitudes in the sensor's frame.")
    return forces, notes


@dataclass(frozen=True, eq=False)
class Mocap:
    """Motion capture of a run, on the robot's clock: valid samples only."""

    t: np.ndarray  # s (M,)
    position: np.ndarray  # of the marker body, world, m (M, 3)
    attitude: Rotation  # of the robot's body (M,)
    shift: float  # by which the source's clock was corrected, s; 0 if it was not


def motion_capture(data: Arrays, t: np.ndarray, gyro: np.ndarray, resync: bool = True) -> Mocap:
    """Return a run's motion capture.

    Args:
        data: the run.
        t: robot's clock (T,), s.
        gyro: rad/s (T, 3), body.
        resync: see ``scaler_walk_mocap``.

    Raises:
        RecordingError: if an array is missing, of another shape, or nothing in it is valid.
    """
    from scipy.spatial.transform import Rotation  # slow to import, and settings are checked first

    clock, position, xyzw = (data.numbers("mocap_t"), data.numbers("mocap_pos", 3), data.numbers("mocap_quat_xyzw", 4))
    valid = data.numbers("mocap_valid") > 0 if "mocap_valid" in data else np.ones(len(clock), dtype=bool)
    to_body = data.numbers("mocap_to_body_rot", 3)
    if not len(clock) == len(valid) == len(position) == len(xyzw) or len(to_body) != 3:
        raise RecordingError(f"{data.path}: mocap_t, mocap_valid, mocap_pos and mocap_quat_xyzw must be of one length")
    valid = valid & np.isfinite(np.column_stack([clock, position, xyzw])).all(axis=1) & (np.abs(xyzw).max(axis=1) > 0)
    clock, position, xyzw = clock[valid], position[valid], xyzw[valid]
    if len(clock) < 2:
        raise RecordingError(f"{data.path}: mocap_valid: fewer than two samples of motion capture are valid")
    if (np.diff(clock) <= 0).any():
        raise RecordingError(f"{data.path}: mocap_t: must increase strictly")
    attitude = _unflipped(Rotation.from_quat(xyzw) * Rotation.from_matrix(to_body).inv())
    shift = _clock_error(t, gyro, clock, position, attitude) if resync else 0.0
    return Mocap(clock + shift, position, attitude, shift)


def _unflipped(attitude: Rotation) -> Rotation:
    """Correct samples in which motion capture has the body back to front: half a turn about its z axis.

    Such an error begins and ends between two samples. The longest stretch without a jump is taken to be right. (Run 14
    has a short wrong one at its start, 179.5 degrees off.)
    """
    from scipy.spatial.transform import Rotation

    turned = np.flatnonzero((attitude[:-1].inv() * attitude[1:]).magnitude() > np.pi / 2) + 1
    if not len(turned):
        return attitude
    stretches = np.split(np.arange(len(attitude)), turned)
    longest = int(np.argmax([len(s) for s in stretches]))
    back = np.concatenate([s for k, s in enumerate(stretches) if (k - longest) % 2] or [np.zeros(0, dtype=int)])
    half = np.zeros((len(attitude), 3))
    half[back, 2] = np.pi
    return attitude * Rotation.from_rotvec(half)


def _clock_error(t: np.ndarray, gyro: np.ndarray, clock: np.ndarray, position: np.ndarray, attitude: Rotation) -> float:
    """Return by how much motion capture is early, s: from the time of the stop, then from rotation rates around it.

    Steady walking repeats every stride, so rotation rates match almost as well when shifted by one stride (0.82 and
    0.83 in run 14); the stop happens only once. 0 if the robot does not come to rest in both, or if the two agree.
    """
    grid = np.arange(clock[0], clock[-1], 0.01)
    if len(grid) < 100:
        return 0.0
    # Speed of the body over 0.1 s, from positions on an even grid.
    place = np.stack([np.interp(grid, clock, one) for one in position.T], axis=1)
    # The robot stands at the end of each run: the reading there is the offset of the gyro.
    still = np.median(gyro[t > t[-1] - 2.0], axis=0)
    turning = t[np.linalg.norm(gyro - still, axis=1) > MOVING_GYRO]
    moving = grid[5:-5][np.linalg.norm(place[10:] - place[:-10], axis=1) / 0.1 > MOVING_BODY]
    if not len(turning) or not len(moving) or turning[-1] > t[-1] - 1.0 or moving[-1] > grid[-1] - 1.0:
        return 0.0
    rough = turning[-1] + STOPS_LATER - moving[-1]
    if abs(rough) < CLOCK_SURE:
        return 0.0
    # Angular velocity in body axes over four samples, which averages the noise of attitudes.
    rate = (attitude[:-4].inv() * attitude[4:]).as_rotvec() / (clock[4:] - clock[:-4])[:, None]

    def match(shift: float) -> float:
        mocap_rate = np.stack([np.interp(t, clock[2:-2] + shift, one) for one in np.clip(rate, -3.0, 3.0).T], axis=1)
        return float((mocap_rate * (gyro - still)).sum() / np.sqrt((mocap_rate**2).sum() + 1e-12))

    # The stop is known to within 0.15 s, less than half a stride, so the right maximum is chosen.
    return float(max(rough + np.arange(-0.15, 0.151, 0.01), key=match))


def _truth(
    data: Arrays, t: np.ndarray, gyro: np.ndarray, tolerance: float, resync: bool
) -> tuple[dict[str, np.ndarray], str]:
    """Return position and attitude of the base from the nearest motion-capture sample, if every row has one."""
    if "mocap_t" not in data:
        return {}, "No ground truth: there is no motion capture."
    capture = motion_capture(data, t, gyro, resync)
    clock = capture.t
    right = np.clip(np.searchsorted(clock, t), 1, len(clock) - 1)
    near = np.where(t - clock[right - 1] < clock[right] - t, right - 1, right)
    away = np.abs(clock[near] - t)
    lost = int((away > tolerance).sum())
    if lost:
        return {}, f"No ground truth: {lost} rows have no valid motion capture within {tolerance:g} s."
    truth = columns(VECTORS["base_pos"], capture.position[near])
    truth |= columns(VECTORS["base_quat"], capture.attitude[near].as_quat()[:, [3, 0, 1, 2]])
    moved = (
        f" Its clock was moved by {capture.shift:+.2f} s beside the source's: gyro and motion capture saw the robot "
        "stop at times that far apart."
    )
    return truth, (
        f"Ground truth is the nearest motion-capture sample, up to {away.max() * 1000:.1f} ms away, "
        "on a clock that was shifted onto the robot's; its position is the marker body's, its attitude good to a few "
        f"degrees; take the start heading as unknown.{moved if capture.shift else ''}"
    )
