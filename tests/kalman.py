"""Kalman filter and leg kinematics in NumPy: the reference of the C++ ones. docs/estimation.md has the equations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from go1exp.deploy.estimation import readings as column
from go1exp.deploy.estimation.config import ChainLeg, FilterConfig, PolynomialLeg
from go1exp.deploy.estimation.readings import Status
from go1exp.robot import GRAVITY

WEIGHT = np.array([0.0, 0.0, GRAVITY])
"""Specific force, m/s2, of what stands still, in the world."""
MOST_LATE = 10
"""Samples in a row that are not newer; the last of them restarts the filter, since the clock has jumped."""
PERIOD = 0.002
"""s; see ``cpp/kalman.hpp``."""
MOST = ((column.GYRO, 1e2), (column.ACC, 1e3), (column.Q, 1e2), (column.QD, 1e3))
"""Largest absolute value of each reading; samples beyond the range of any sensor are refused."""


class NumpyFilter:
    """The filter, sample by sample.

    Attributes:
        x: IMU position r and velocity v, accelerometer bias b, feet p0..p3, ground below r: height g, slope m (24,),
            world frame.
        P: covariance of ``x`` (24, 24).
    """

    def __init__(self, config: FilterConfig) -> None:
        self.c, self.x, self.P = config, np.zeros(24), np.zeros((24, 24))
        self.running, self.t, self.late, self.unseen = False, -np.inf, 0, 0.0
        self.age, self.contact = np.zeros(4), np.zeros(4)

        self.attitude, self.R, self.force = Rotation.identity(), np.eye(3), np.zeros(3)
        self.uneven = np.array([1.0, 1.0, config.sinking**2])

    def update(self, s: np.ndarray) -> Status:
        """Take a sample (51,)."""
        c = self.c
        speeds = c.foot_radius > 0 or c.foot_speed_noise > 0
        used = {"force": s[column.FOOT_FORCE], "torque": s[column.TAU], "height": np.zeros(1)}[c.contact_source]
        small = all((np.abs(s[k]) <= most).all() for k, most in MOST if k != column.QD or speeds)
        if not (np.isfinite(s[0]) and abs(np.linalg.norm(s[1:5]) - 1) < 0.1 and small and np.isfinite(used).all()):
            return Status.INVALID
        # Nine old samples in a row are dropped; the tenth means that the clock has jumped back.
        late = s[0] <= self.t
        self.late = self.late + 1 if late else 0
        if 0 < self.late < MOST_LATE:
            return Status.LATE
        dt, self.t, self.late = s[0] - self.t, s[0], 0
        anew = late or dt > c.longest_gap
        # Attitude and kinematics are inputs, not states: they come first, prediction and correction use them.
        self._turn(s[column.QUAT], s[column.GYRO], np.inf if anew else dt)
        self._look_at_feet(s, speeds, PERIOD if anew else dt)
        if anew:
            self.force = self.R @ s[column.ACC]
        if not self.running:
            # The first sample: at rest within ``initial_speed``, its lowest foot on the ground.
            self.running, self.P[3:6, 3:6] = True, c.initial_speed**2 * np.eye(3)
            self.P[21:, 21:] = np.diag([c.level_noise, c.slope_walk, c.slope_walk]) ** 2
            self.P[6:9, 6:9], self.x[2] = c.initial_bias**2 * np.eye(3), c.foot_radius - self.arm[:, 2].min()
        if anew:
            if np.isfinite(dt):
                self._widen_speed()
            for leg in range(4):
                self._anchor(leg)
            self.age[:] = 0
            return Status.RESTARTED if np.isfinite(dt) else Status.STARTED
        self._predict(s[column.ACC], dt)
        self._correct(dt)
        return Status.OK

    def _turn(self, quat: np.ndarray, gyro: np.ndarray, dt: float) -> None:
        attitude = Rotation.from_quat(quat, scalar_first=True)
        if np.isfinite(dt) and self.c.attitude_time > 0:
            # Half the rotation vector as the vector part: the error is of third order in the angle of one sample.
            turned = (self.attitude * Rotation.from_quat([*(0.5 * dt * gyro), 1.0])).as_quat()
            keep, reported = np.exp(-dt / self.c.attitude_time), attitude.as_quat()
            # Weighted mean of two near quaternions; q and -q are one rotation, so the sign is matched first.
            attitude = Rotation.from_quat(keep * turned + (1 - keep) * np.copysign(1, turned @ reported) * reported)
        self.attitude, self.R = attitude, attitude.as_matrix()

    def _look_at_feet(self, s: np.ndarray, speeds: bool, dt: float) -> None:
        c, R, w = self.c, self.R, s[column.GYRO]
        self.w = w
        feet = [foot(leg, q) for leg, q in zip(c.legs, s[column.Q].reshape(4, 3), strict=True)]
        # p (4, 3) m, J (4, 3, 3) m/rad, turn (4, 3, 3)
        p, J, turn = (np.array(part) for part in zip(*feet, strict=True))
        qd = s[column.QD].reshape(4, 3) if speeds else np.zeros((4, 3))
        self.arm = (p - c.imu_position) @ R.T
        self.moving = (np.cross(w, p - c.imu_position) + np.einsum("lij,lj->li", J, qd)) @ R.T
        self.rolling = c.foot_radius * np.cross((w + np.einsum("lij,lj->li", turn, qd)) @ R.T, [0, 0, 1.0])
        # Covariances of the foot in the world: JJ by errors of joint angles, AA = |s|^2 I - s s' by those of attitude.
        JJ = R @ J @ J.transpose(0, 2, 1) @ R.T
        AA = np.einsum("li,li->l", self.arm, self.arm)[:, None, None] * np.eye(3) - np.einsum(
            "li,lj->lij", self.arm, self.arm
        )
        self.place_noise = c.joint_noise**2 * JJ + c.attitude_noise**2 * AA + c.leg_noise**2 * np.eye(3)
        self.speed_noise = c.joint_speed_noise**2 * JJ + c.gyro_noise**2 * AA
        # A foot that gives way counts by time: per sample its variance is that of one period of the Go1, scaled.
        self.speed_noise += c.foot_speed_noise**2 * PERIOD / dt * np.diag(self.uneven)
        if c.contact_source == "force":
            load = s[column.FOOT_FORCE]
        elif c.contact_source == "height":
            load = np.sort(p[:, 2])[:2].mean() - p[:, 2]
        else:  # tau + J' f = 0
            # A straight leg has a singular Jacobian: its torques say nothing about the force along it.
            bent = np.abs(np.linalg.det(J)) >= 1e-6
            J = np.where(bent[:, None, None], J, np.eye(3))
            force = -np.linalg.solve(J.transpose(0, 2, 1), s[column.TAU].reshape(4, 3, 1))[..., 0]
            load = np.where(bent, force @ R[2], 0.0)
        self.contact = np.clip((load - c.contact_low) / (c.contact_high - c.contact_low), 0, 1)

    def _anchor(self, leg: int) -> None:
        # p = r + s, so p inherits all covariances of r; only the error of the kinematics is added.
        at = slice(9 + 3 * leg, 12 + 3 * leg)
        self.x[at] = self.x[:3] + self.arm[leg]
        self.P[at] = self.P[:3]
        self.P[:, at] = self.P[:, :3]
        self.P[at, at] = self.P[:3, :3] + self.place_noise[leg]

    def _widen_speed(self) -> None:
        # The speed forgets its correlations with everything else; the position is kept.
        self.P[3:6] = self.P[:, 3:6] = 0
        self.P[3:6, 3:6], self.unseen = self.c.initial_speed**2 * np.eye(3), 0.0

    def _predict(self, acc: np.ndarray, dt: float) -> None:
        c, eye = self.c, np.eye(3)
        # In steps longer than the Go1's period, the acceleration before that period is not known: it is taken as
        # uniformly distributed between the last and the present one, with their mean and the variance jump^2 / 12.
        unseen, jump = max(dt - PERIOD, 0.0), self.R @ acc - self.force
        self.force = self.R @ acc
        a, v = self.force - unseen / (2 * dt) * jump - self.R @ self.x[6:9] - WEIGHT, self.x[3:5].copy()
        self.x[21] += dt * self.x[22:] @ v
        self.x[:3] += dt * self.x[3:6] + dt**2 / 2 * a
        self.x[3:6] += dt * a
        # F is the derivative of the prediction above by the state
        F = np.eye(24)
        F[21, 22:], F[21, 3:5] = dt * v, dt * self.x[22:]
        F[:3, 3:6], F[:3, 6:9], F[3:6, 6:9] = dt * eye, -(dt**2) / 2 * self.R, -dt * self.R
        # Impacts: the noise grows with the excess of the acceleration over gravity.
        n = c.acceleration_noise**2 * (1 + ((np.linalg.norm(acc) - GRAVITY) / c.impact_acceleration) ** 2)
        Q = np.zeros((24, 24))
        along = np.diag(n + jump**2 * unseen**2 / (12 * dt))
        # White acceleration noise, integrated exactly over dt to position and velocity.
        Q[:6, :6] = np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], along)
        Q[6:9, 6:9] = c.bias_walk**2 * dt * eye
        drift = c.foot_drift / np.maximum(self.contact, c.contact_least)
        Q[9:21, 9:21] = np.diag(np.outer(drift**2 * dt, self.uneven).ravel())
        Q[21:, 21:] = np.diag([c.ground_walk, c.slope_walk, c.slope_walk]) ** 2 * dt
        self.x[9:21] += dt * self.rolling.ravel()
        self.P = F @ self.P @ F.T + Q

    def _correct(self, dt: float) -> None:
        c, any_foot, any_accepted = self.c, False, False
        self.age = np.where(self.contact >= c.contact_least, self.age + dt, 0.0)
        for leg in range(4):
            if self.age[leg] <= c.settle:  # in the air, or just set down
                self._anchor(leg)
                continue
            # the first sample in which the foot counts: it defines the ground below the robot
            if c.level_noise > 0 and self.age[leg] - dt <= c.settle:
                self._level(leg)
            holds, at = True, slice(9 + 3 * leg, 12 + 3 * leg)
            if c.foot_speed_noise > 0:
                # speed: contact divides the standard deviation, so that a loaded foot counts more
                H = np.eye(24)[3:6]
                R = self.speed_noise[leg] / self.contact[leg] ** 2
                holds = self._apply(H, R, self.rolling[leg] - self.moving[leg] - H @ self.x, robust=True)
            if holds:
                # place: p - r, from the kinematics
                H = np.eye(24)[at] - np.eye(24)[:3]
                holds = self._apply(H, self.place_noise[leg], self.arm[leg] - H @ self.x, robust=False)
            if not holds:
                self._anchor(leg)
            any_foot, any_accepted = True, any_accepted or holds
        self.unseen = self.unseen + dt if any_foot and not any_accepted else 0.0
        if self.unseen > c.lost_after:
            self._widen_speed()

    def _level(self, leg: int) -> None:
        H = np.eye(24)[[11 + 3 * leg]] - np.eye(24)[[21]]
        H[0, 22:] = self.x[:2] - self.x[9 + 3 * leg : 11 + 3 * leg]
        self._apply(H, self.c.level_noise**2 * np.eye(1), self.c.foot_radius - H @ self.x, robust=False)

    def _apply(self, H: np.ndarray, R: np.ndarray, error: np.ndarray, robust: bool) -> bool:
        S = H @ self.P @ H.T + R
        d2 = float(error @ np.linalg.solve(S, error))
        if d2 > self.c.gate:
            if not robust:
                return False
            # Beyond the gate the noise is inflated, so that the correction stays bounded however large the error.
            S += R * ((d2 / self.c.gate) ** 2 - 1)
        K = np.linalg.solve(S, H @ self.P).T  # (24, m): P H' S^-1, without an inverse
        self.x, self.P = self.x + K @ error, self.P - K @ S @ K.T
        return d2 <= self.c.gate

    @property
    def velocity_b(self) -> np.ndarray:
        """Velocity (3,) of the trunk's origin in its own frame, m/s."""
        return self.R.T @ self.x[3:6] - np.cross(self.w, self.c.imu_position)

    @property
    def position_w(self) -> np.ndarray:
        """Position (3,) of the trunk's origin, m."""
        return self.x[:3] - self.R @ self.c.imu_position


# ---------------------------------------------------------------------- kinematics

EXPONENTS = np.array([(i, j, k) for i in range(5) for j in range(5 - i) for k in range(5 - i - j)])
"""Exponents (35, 3) of a polynomial leg's terms."""


def foot(leg: ChainLeg | PolynomialLeg, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a foot in the trunk's frame for joint angles ``q`` (3,), rad.

    Returns:
        Its position (3,), m; the Jacobian (3, 3) of the position, m/rad; and ``turning`` (3, 3), which maps joint
        velocities to the angular velocity of the foot's link relative to the trunk (zero if that is not known).
    """
    if isinstance(leg, PolynomialLeg):
        u = (q - np.array(leg.centre)) / leg.scale
        coefficients = np.array([leg.x, leg.y, leg.z])
        terms = (u**EXPONENTS).prod(axis=1)
        slope = np.stack([_slope(u, d) for d in range(3)], axis=1) / leg.scale
        return coefficients @ terms, coefficients @ slope, np.zeros((3, 3))
    (hip, thigh, calf), (side, upper, lower) = q, leg.lengths
    # Rotation of the hip about x; thigh and calf move in the plane that it turns.
    about_x = np.array([[1, 0, 0], [0, np.cos(hip), -np.sin(hip)], [0, np.sin(hip), np.cos(hip)]])
    knee = np.array([-upper * np.sin(thigh), 0, -upper * np.cos(thigh)])
    shin = np.array([-lower * np.sin(thigh + calf), 0, -lower * np.cos(thigh + calf)])
    below = np.array([0, side, 0]) + knee + shin
    # Column j of the Jacobian: axis of joint j x arm from it to the foot.
    axes = np.array([[1.0, 0, 0], about_x[:, 1], about_x[:, 1]])
    arms = [about_x @ below, about_x @ (knee + shin), about_x @ shin]
    return np.array(leg.hip) + about_x @ below, np.cross(axes, arms).T, axes.T


def _slope(u: np.ndarray, axis: int) -> np.ndarray:
    """Return the derivative (35,) of the terms by one of their variables."""
    lower = EXPONENTS.copy()
    lower[:, axis] = np.maximum(lower[:, axis] - 1, 0)
    return EXPONENTS[:, axis] * (u**lower).prod(axis=1)
