"""Where the trunk of a robot on its feet is and how it moves, from IMU, encoders and commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from go1exp import robot
from go1exp.gap.data.cutting import FIT_S, even_clock
from go1exp.logs.recording import VECTORS, Recording
from go1exp.sim.physics.dynamics import Legs

LOADED = 10.0
"""Force from which a foot carries weight, N: a third of what each bears at rest, twice what is
estimated for a foot in the air."""

AGREE = 0.004
"""Feet that carry weight and disagree by more about the height of the base, m, are not all on the ground."""

TORN = 0.3
"""Disagreement about its velocity beyond which nothing is known of it, m/s: a foot is just touching down or leaving."""

SLIDE = 0.05
"""Feet that carry weight and disagree by this about the velocity of the base, m/s, put an estimate in doubt as a misfit
of one standard deviation does: one of them slides, or has just touched down."""

SINK = 3.0e-5
"""How far a foot sinks into the ground, m/N (measured in the model at rest)."""


@dataclass(frozen=True)
class Log:
    """What an estimate of the base needs of a recording, its rows on an even clock."""

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    torque: np.ndarray
    imu: np.ndarray
    attitude: Rotation

    @staticmethod
    def from_recording(recording: Recording) -> Log:
        """Read it; the torque is what the drives should make of target, angle and speed."""
        q, qd = recording.joint("q"), recording.joint("qd")
        kp, kd = np.asarray(recording.meta.kp, dtype=float), np.asarray(recording.meta.kd, dtype=float)
        torque = kp * (recording.joint("q_target") - q) - kd * qd
        on = recording.channels.get("torque_enable", np.ones(len(q), dtype=bool)).astype(bool)
        imu = recording.block(*VECTORS["imu_gyro"], *VECTORS["imu_acc"])
        attitude = Rotation.from_quat(recording.block(*VECTORS["imu_quat"]), scalar_first=True)
        return Log(even_clock(recording), q, qd, torque * on[:, None], imu, attitude)


@dataclass(frozen=True)
class Base:
    """An estimate of the base.

    Attributes:
        state: (13,) as in ``StandingWindows``.
        loaded: (4,) which feet carry weight.
        spread: how far those disagree about the base's height, m; infinite with fewer than two.
        slide: how far they disagree about its velocity, m/s.
    """

    state: np.ndarray
    loaded: np.ndarray
    spread: float
    slide: float


def loaded(legs: Legs, log: Log) -> np.ndarray:
    """Return which feet carry weight (T, 4) bool, at every row of a recording."""
    bearing = np.empty((len(log.t), robot.NUM_LEGS), dtype=bool)
    up = log.attitude.as_matrix()[:, 2]
    for k in range(len(log.t)):
        _, moves = legs.feet(log.q[k], up[k])
        bearing[k] = legs.forces(moves, log.torque[k]) @ up[k] > LOADED
    return bearing


def base_state(legs: Legs, log: Log, at: float) -> Base:
    """Estimate the base at a time of a recording, s.

    Attitude and rate are the IMU's, smoothed over 14 ms to each side. The force on a foot is what balances the torque
    of its leg. Feet that carry weight are on the ground, and stay where they touch it.
    """
    near = np.flatnonzero(np.abs(log.t - at) <= FIT_S)
    x = log.t[near] - at
    design = np.stack([np.ones_like(x), x], axis=1)

    def now(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.lstsq(design, values[near], rcond=None)[0][0])

    middle = log.attitude[int(near[len(near) // 2])]
    turns = (middle.inv() * log.attitude[near]).as_rotvec()
    attitude = middle * Rotation.from_rotvec(np.linalg.lstsq(design, turns, rcond=None)[0][0])
    rotation, rate = attitude.as_matrix(), now(log.imu[:, :3])
    q, qd, torque = now(log.q), now(log.qd), now(log.torque)
    points, moves = legs.feet(q, rotation[2])
    forces = legs.forces(moves, torque) @ rotation.T
    bearing = forces[:, 2] > LOADED
    heights = -(points @ rotation.T)[:, 2] - SINK * forces[:, 2]
    speeds = -(np.stack([moves[k] @ qd for k in range(4)]) + np.cross(rate, points)) @ rotation.T
    spread = float(np.ptp(heights[bearing])) if bearing.sum() > 1 else np.inf
    slide = float(np.ptp(speeds[bearing], axis=0).max()) if bearing.sum() > 1 else np.inf
    weight = np.maximum(forces[:, 2], 0.0) * bearing + 1e-9
    height, speed = np.average(heights, weights=weight), np.average(speeds, axis=0, weights=weight)
    state = np.concatenate([[0.0, 0.0, height], attitude.as_quat(scalar_first=True), speed, rate])
    return Base(state, bearing, spread, slide)
