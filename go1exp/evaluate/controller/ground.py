"""The ground below the robot: a plane through the places where its feet last stood."""

from __future__ import annotations

import math

import numpy as np

from go1exp import robot
from go1exp.evaluate.controller.settings import StanceSettings


class Ground:
    """Slope of the ground and height of the trunk above it, both smoothed.

    Attributes:
        gradient: (2,) rise of the ground per m along x and y of the world.
        height: of the trunk's origin, vertically above the ground, m.
    """

    def __init__(self, settings: StanceSettings, height_time: float, dt: float) -> None:
        """Smooth the height with time constant ``height_time`` s; called every ``dt`` s."""
        self._settings, self._dt = settings, dt
        self._share, self._rise = dt / (settings.slope_time + dt), dt / (height_time + dt)
        self.restart()

    def restart(self) -> None:
        """Forget the ground: at the next call it is where the feet are."""
        self.gradient, self.height = np.zeros(2), 0.0
        self._fresh = True

    def update(self, feet: np.ndarray, down: np.ndarray, velocity: np.ndarray) -> None:
        """Take the places (4, 3) of the feet, from the trunk's origin in the world's axes, m.

        Args:
            feet: where each stands or last stood.
            down: (4,) bool, which ones stand now.
            velocity: (3,) of the trunk, m/s.
        """
        if self._settings.slope:
            share = 1.0 if self._fresh else self._share
            self.gradient = self._limited(self.gradient + share * (_gradient(feet) - self.gradient))
        a, b = self.gradient.tolist()
        below = [z - a * x - b * y for (x, y, z), stands in zip(feet.tolist(), down.tolist(), strict=True) if stands]
        vx, vy, vz = velocity.tolist()
        carried = self.height + self._dt * (vz - a * vx - b * vy)
        measured = robot.FOOT_RADIUS - sum(below) / len(below) if below else carried
        self.height = measured if self._fresh else carried + self._rise * (measured - carried)
        self._fresh = False

    def _limited(self, gradient: np.ndarray) -> np.ndarray:
        """Return a gradient cut at the steepest one."""
        steepest, most = math.hypot(*gradient.tolist()), math.tan(self._settings.max_slope)
        return gradient if steepest <= most else gradient * (most / steepest)


def _gradient(feet: np.ndarray) -> np.ndarray:
    """Return the gradient (2,) of the plane through four points (4, 3), by least squares."""
    x, y, z = (feet - feet.mean(0)).T
    xx, xy, yy, xz, yz = float(x @ x), float(x @ y), float(y @ y), float(x @ z), float(y @ z)
    # Feet that nearly stand in a line say nothing about the slope across it.
    determinant = max(xx * yy - xy * xy, 1e-4)
    return np.array([yy * xz - xy * yz, xx * yz - xy * xz]) / determinant


def frame(a: float, b: float) -> np.ndarray:
    """Return (3, 3): two tangents and the normal of the plane z = a x + b y, in columns; the first one along x."""
    normal = np.array([-a, -b, 1.0]) / math.sqrt(1.0 + a * a + b * b)
    along = np.array([1.0, 0.0, a]) / math.sqrt(1.0 + a * a)
    return np.column_stack([along, np.cross(normal, along), normal])
