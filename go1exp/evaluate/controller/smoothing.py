"""Readings made smooth: their rates carry them on, the readings themselves correct slowly."""

from __future__ import annotations

import numpy as np

from go1exp.evaluate.controller.settings import SmoothingSettings
from go1exp.evaluate.controller.types import Sensed


class Smoothed:
    """Complementary filters of attitude, joint angles and velocity.

    Attributes:
        quat: (4,) w-x-y-z.
        joint_pos: (12,) rad.
        velocity_b: (3,) m/s.
    """

    def __init__(self, settings: SmoothingSettings, dt: float) -> None:
        """Smooth readings that come every ``dt`` s."""
        self._dt = dt
        times = (settings.attitude, settings.joints, settings.velocity)
        self._attitude, self._joints, self._velocity = (dt / (time + dt) for time in times)
        self.restart()

    def restart(self) -> None:
        """Take the next readings as they are."""
        self.quat, self.joint_pos, self.velocity_b = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(12), np.zeros(3)
        self._fresh = True

    def update(self, sensed: Sensed) -> None:
        """Take one set of readings."""
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
