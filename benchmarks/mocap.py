"""Compares the filter and plain leg odometry with motion capture, on walks of SCALER (``scaler_walk_mocap``)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import interp1d
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from benchmarks.replay import SCALER_LOG, Log, estimate, samples
from go1exp.deploy.estimation import FilterConfig
from go1exp.deploy.estimation import readings as column
from go1exp.deploy.estimation.feet import kinematics
from go1exp.logs.importers import import_recordings
from go1exp.logs.importers.scaler_walk_mocap import Mocap, motion_capture
from go1exp.logs.importers.source import load_npz
from go1exp.logs.recording import VECTORS, RecordingError

GRID = 0.01
"""Step at which motion capture is differentiated and compared, s."""

WINDOW = 15
"""Samples over which a cubic is fitted to the positions (Savitzky-Golay): 0.15 s, a third of a stride."""


@dataclass(frozen=True)
class Evaluation:
    """Errors of filter and odometry on one run.

    Attributes:
        run: name of the run.
        truth_distance: distance between start and end by motion capture, m.
        filter_rmse: RMSE of the forward velocity over the whole run, m/s.
        filter_distance: (distance by the filter) / truth - 1.
        odometry_rmse: as ``filter_rmse``, of leg odometry.
        odometry_distance: as ``filter_distance``, of leg odometry.
        clock_shift: correction of motion capture's clock in addition to the source's own, s (see the importer).
    """

    run: str
    truth_distance: float
    filter_rmse: float
    filter_distance: float
    odometry_rmse: float
    odometry_distance: float
    clock_shift: float


def truth(capture: Mocap) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (T,), s, positions (T, 3), m, and forward speed (T,), m/s, by motion capture.

    Forward is the horizontal direction of the trunk's x axis. Lost samples are interpolated linearly.
    """
    heading = np.unwrap(_heading(capture.attitude.as_matrix()))
    grid = np.arange(capture.t[0], capture.t[-1], GRID)
    if len(grid) <= WINDOW:
        raise RecordingError(f"motion capture lasts {len(grid) * GRID:.2f} s, too short to differentiate")
    place = interp1d(capture.t, capture.position, axis=0)(grid)
    velocity = savgol_filter(place, WINDOW, 3, deriv=1, delta=GRID, axis=0)
    return grid, place, _forward(velocity, np.interp(grid, capture.t, heading))


def _heading(rotation: np.ndarray) -> np.ndarray:
    return np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])


def _forward(velocity_w: np.ndarray, heading: np.ndarray) -> np.ndarray:
    return np.cos(heading) * velocity_w[:, 0] + np.sin(heading) * velocity_w[:, 1]


def odometry(rows: np.ndarray, config: FilterConfig) -> np.ndarray:
    """Return the trunk's velocity (T, 3) in the world by legs alone: the mean over the two lowest feet.

    Args:
        rows: samples (T, 51).
        config: gives the legs.
    """
    t, q = rows[:, column.T], rows[:, column.Q].reshape(-1, 4, 3)
    legs = kinematics(config)
    feet = np.array([[leg(angles)[0] for leg, angles in zip(legs, row, strict=True)] for row in q])
    # of each foot relative to the trunk's origin, in the trunk's axes (T, 4, 3); a standing foot moves with -v
    speed = np.gradient(feet, t, axis=0) + np.cross(rows[:, None, column.GYRO], feet)
    # Feet on the ground are taken to be the two lowest: three runs have no force sensors. (T, 2)
    low = np.argsort(feet[:, :, 2], axis=1)[:, :2]
    mean = -np.take_along_axis(speed, low[:, :, None], axis=1).mean(axis=1)
    return Rotation.from_quat(rows[:, column.QUAT], scalar_first=True).apply(mean)


def evaluate(path: Path, config: FilterConfig, log: Log = SCALER_LOG) -> Evaluation:
    """Compare filter and odometry with motion capture, from 0.05 s after a run's start to its end.

    Odometry gets the same joint angles at the same times as the filter.

    Raises:
        RecordingError: if the run has no joints, IMU or motion capture.
        EstimatorError: if the filter is not built.
    """
    (recording,) = import_recordings("scaler_walk_mocap", path, {})
    capture = motion_capture(load_npz(path), recording.t, recording.block(*VECTORS["imu_gyro"]))
    result, rows = estimate(recording, config, log), samples(recording, log)
    rotation = Rotation.from_quat(result.quat, scalar_first=True)
    heading = _heading(rotation.as_matrix())
    leg_velocity = odometry(rows, config)
    leg_place = np.cumsum(leg_velocity * np.gradient(result.t)[:, None], axis=0)
    grid, place, speed = truth(capture)
    # The start is left out: the filter begins with speed zero, although the robot walks already.
    within = (grid >= result.t[0] + 0.05) & (grid <= result.t[-1])
    if within.sum() < WINDOW:
        raise RecordingError(f"{path}: motion capture and the robot's log have less than {WINDOW * GRID:g} s in common")
    grid, place, speed = grid[within], place[within], speed[within]
    distance = _distance(place)

    def errors(velocity_w: np.ndarray, position_w: np.ndarray) -> tuple[float, float]:
        error = np.interp(grid, result.t, _forward(velocity_w, heading)) - speed
        return float(np.sqrt(np.mean(error**2))), _distance(interp1d(result.t, position_w, axis=0)(grid)) / distance - 1

    filtered = errors(rotation.apply(result.velocity_b), result.position_w)
    return Evaluation(path.stem, distance, *filtered, *errors(leg_velocity, leg_place), capture.shift)


def _distance(place: np.ndarray) -> float:
    """Return the horizontal distance between first and last position, m."""
    return float(np.linalg.norm(place[-1, :2] - place[0, :2]))
