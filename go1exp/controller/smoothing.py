"""Readings made smooth: their rates carry them on, the readings themselves correct slowly."""

from __future__ import annotations

import numpy as np

from go1exp.controller.settings import SmoothingSettings
from go1exp.controller.types import Sensed


class Smoothed:
    """Complementary filters of attitude, joint angles, height and velocity.

    Attributes:
        quat: (4,) w-x-y-z.
        joint_pos: (12,) rad.
        velocity_b: (3,) m/s.
    """

    def __init__(self, settings: SmoothingSettings, dt: float) -> None:
        """Smooth readings that come every ``dt`` s."""
        self._dt = dt

        def share(time: float) -> float:
            return dt / (time + dt)

        self._attitude, self._joints = share(settings.attitude), share(settings.joints)
        self._rise, self._speed = share(settings.height), share(settings.velocity)
        self.restart()

    def restart(self) -> None:
        """Take the next readings as they are."""
        self.quat, self.joint_pos, self.velocity_b = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(12), np.zeros(3)
        self._height = 0.0
        self._fresh = self._fresh_height = True

    def update(self, sensed: Sensed) -> None:
        """Take one set of readings."""
        if self._fresh:
            self.quat, self.joint_pos, self.velocity_b = sensed.quat, sensed.joint_pos, sensed.velocity_b
            self._fresh = False
            return
        w, x, y, z = self.quat
        a, b, c = 0.5 * self._dt * sensed.gyro
        turned = np.array(
            [w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a]
        )
        near = sensed.quat if turned @ sensed.quat >= 0.0 else -sensed.quat
        turned += self._attitude * (near - turned)
        self.quat = turned / np.sqrt(turned @ turned)
        carried = self.joint_pos + self._dt * sensed.joint_vel
        self.joint_pos = carried + self._joints * (sensed.joint_pos - carried)
        self.velocity_b = self.velocity_b + self._speed * (sensed.velocity_b - self.velocity_b)

    def height(self, reading: float, rate: float) -> float:
        """Return the smoothed height, m, of readings, m, and its rate, m/s."""
        if self._fresh_height:
            self._height, self._fresh_height = reading, False
        carried = self._height + self._dt * rate
        self._height = carried + self._rise * (reading - carried)
        return self._height
