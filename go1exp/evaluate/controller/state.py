"""State of the trunk and the ground: rotations, smoothed readings, and the plane through the stance feet."""

from __future__ import annotations

import math

import numpy as np

from go1exp import robot
from go1exp.evaluate.controller.settings import SmoothingSettings, StanceSettings
from go1exp.evaluate.controller.types import Sensed


def matrix(quat: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) of a unit quaternion (4,), w-x-y-z."""
    w, x, y, z = quat.tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def skew(w: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) whose product with r (3,) is the cross product of w (3,) and r."""
    x, y, z = w.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def heading(yaw: float) -> np.ndarray:
    """Return the rotation (3, 3) by ``yaw``, rad, about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def wrapped(angle: float) -> float:
    """Return an angle between -pi and pi, rad."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return the angles of R = R_z(yaw) R_y(pitch) R_x(roll), rad."""
    down = max(-1.0, min(1.0, float(rotation[2, 0])))
    return (math.atan2(rotation[2, 1], rotation[2, 2]), -math.asin(down), math.atan2(rotation[1, 0], rotation[0, 0]))


class Smoothed:
    """Complementary filters of ``quat`` (4,) w-x-y-z, ``joint_pos`` (12,), rad, and ``velocity_b`` (3,), m/s."""

    def __init__(self, settings: SmoothingSettings, dt: float) -> None:
        """Smooth readings with a period of ``dt`` s."""
        self._dt = dt
        times = (settings.attitude, settings.joints, settings.velocity)
        self._attitude, self._joints, self._velocity = (dt / (time + dt) for time in times)
        self.restart()

    def restart(self) -> None:
        """Reset: the next readings are taken without smoothing."""
        self.quat, self.joint_pos, self.velocity_b = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(12), np.zeros(3)
        self._fresh = True

    def update(self, sensed: Sensed) -> None:
        """Update by one set of readings."""
        if self._fresh:
            self.quat, self.joint_pos, self.velocity_b = sensed.quat, sensed.joint_pos, sensed.velocity_b
            self._fresh = False
            return
        turned = _turned(self.quat, self._dt * sensed.gyro)
        near = sensed.quat if turned @ sensed.quat >= 0.0 else -sensed.quat
        turned += self._attitude * (near - turned)
        self.quat = turned / np.sqrt(turned @ turned)
        carried = self.joint_pos + self._dt * sensed.joint_vel
        self.joint_pos = carried + self._joints * (sensed.joint_pos - carried)
        self.velocity_b = self.velocity_b + self._velocity * (sensed.velocity_b - self.velocity_b)


def _turned(quat: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Return a quaternion turned by a small rotation vector in the body's axes, rad, to first order."""
    w, x, y, z = quat.tolist()
    a, b, c = (0.5 * by).tolist()
    return np.array(
        [w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a]
    )


class Ground:
    """Smoothed ``gradient`` (2,) of the ground along the world's x and y, and ``height`` of the trunk above it, m."""

    def __init__(self, settings: StanceSettings, height_time: float, dt: float) -> None:
        """Smooth the height with time constant ``height_time`` s; called every ``dt`` s."""
        self._settings, self._dt = settings, dt
        self._share, self._rise = dt / (settings.slope_time + dt), dt / (height_time + dt)
        self.restart()

    def restart(self) -> None:
        """Reset: the next call initialises the ground by the feet."""
        self.gradient, self.height = np.zeros(2), 0.0
        self._fresh = True

    def update(self, feet: np.ndarray, down: np.ndarray, velocity: np.ndarray) -> None:
        """Update by where the feet (4, 3) stand or last stood, relative to the trunk's origin in the world's axes, m.

        ``down`` (4,) says which stand now; ``velocity`` (3,) is the trunk's, m/s.
        """
        if self._settings.slope:
            share = 1.0 if self._fresh else self._share
            self.gradient = self.gradient + share * (_gradient(feet) - self.gradient)
            steepest, most = math.hypot(*self.gradient.tolist()), math.tan(self._settings.max_slope)
            if steepest > most:
                self.gradient = self.gradient * (most / steepest)
        a, b = self.gradient.tolist()
        below = [z - a * x - b * y for (x, y, z), stands in zip(feet.tolist(), down.tolist(), strict=True) if stands]
        vx, vy, vz = velocity.tolist()
        carried = self.height + self._dt * (vz - a * vx - b * vy)
        measured = robot.FOOT_RADIUS - sum(below) / len(below) if below else carried
        self.height = measured if self._fresh else carried + self._rise * (measured - carried)
        self._fresh = False


def _gradient(feet: np.ndarray) -> np.ndarray:
    """Return the gradient (2,) of the plane through four points (4, 3), by least squares."""
    x, y, z = (feet - feet.mean(0)).T
    xx, xy, yy, xz, yz = float(x @ x), float(x @ y), float(y @ y), float(x @ z), float(y @ z)
    # Feet in a line do not determine the slope across it.
    determinant = max(xx * yy - xy * xy, 1e-4)
    return np.array([yy * xz - xy * yz, xx * yz - xy * xz]) / determinant


def frame(a: float, b: float) -> np.ndarray:
    """Return (3, 3): two tangents and the normal of the plane z = a x + b y, in columns; the first one along x."""
    normal = np.array([-a, -b, 1.0]) / math.sqrt(1.0 + a * a + b * b)
    along = np.array([1.0, 0.0, a]) / math.sqrt(1.0 + a * a)
    return np.column_stack([along, np.cross(normal, along), normal])
