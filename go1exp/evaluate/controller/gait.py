"""Feet of the controller: the gait's schedule, contacts, footholds and swing trajectories."""

from __future__ import annotations

import numpy as np

from go1exp import robot
from go1exp.evaluate.controller.types import Command

DAMPING = 1e-3  # of the least squares of a swinging leg


class Clock:
    """The clock of a gait: a leg stands in the first ``duty`` of each cycle of ``period`` s, and swings in the rest."""

    def __init__(self, offsets: tuple[float, ...], duty: float, period: float) -> None:
        """Start at phase 0; ``offsets`` (4,) are the legs' phases then, in cycles; ``duty`` in (0, 1)."""
        self._offsets, self.duty, self.period, self._phase = np.array(offsets), duty, period, 0.0

    def restart(self) -> None:
        """Go back to phase 0."""
        self._phase = 0.0

    def advance(self, dt: float) -> None:
        """Let ``dt`` s pass."""
        self._phase = (self._phase + dt / self.period) % 1.0

    @property
    def phases(self) -> np.ndarray:
        """(4,) the legs' phases, 0 to 1."""
        return (self._phase + self._offsets) % 1.0

    def stands(self) -> np.ndarray:
        """Return the scheduled stance (4,) bool."""
        return self.phases < self.duty

    def swing_share(self) -> np.ndarray:
        """Return the passed share of the swing (4,), 0 to 1; negative in stance."""
        return (self.phases - self.duty) / (1.0 - self.duty)

    def schedule(self, steps: int, dt: float) -> np.ndarray:
        """Return the scheduled stance (steps, 4) bool in the middle of each of the next intervals of ``dt`` s."""
        middles = (np.arange(steps) + 0.5)[:, None] * (dt / self.period)
        return (self._phase + middles + self._offsets) % 1.0 < self.duty


class Feet:
    """Schedule and contact of the four feet: which stand (``down``), and where they left the ground and stand, m.

    A foot lifts off by the schedule. It stands at its contact: early, in the second half of its swing, or after the
    scheduled touch-down; ``overdue`` is the time since that without contact, s, 0 for the others. ``anchor`` is where
    each stands or last stood.
    """

    def __init__(self, contact_force: float, dt: float) -> None:
        """Detect contact from ``contact_force`` N on; called every ``dt`` s."""
        self._contact_force, self._dt = contact_force, dt
        self.restart()

    def restart(self) -> None:
        """Reset: the next call is the first one."""
        legs = robot.NUM_LEGS
        self.down, self._planned = np.ones(legs, dtype=bool), np.ones(legs, dtype=bool)
        self.lift, self.anchor = np.zeros((legs, 3)), np.zeros((legs, 3))
        self.overdue, self._fresh = np.zeros(legs), True

    def update(self, clock: Clock, force: np.ndarray, places: np.ndarray) -> bool:
        """Update by forces (4,), N, and positions (4, 3), m, of the feet; return whether other feet stand."""
        planned, before = clock.stands(), self.down
        if self._fresh:
            self.lift[:], self.anchor[:] = places, places
            self.down, self._planned, self._fresh = planned, planned, False
            return True
        touches = force > self._contact_force
        leaves = self._planned & ~planned
        self._planned = planned
        may_land = planned | (clock.swing_share() > 0.5)
        self.down = (before & ~leaves) | (touches & may_land)
        self.overdue = np.where(planned & ~self.down, self.overdue + self._dt, 0.0)
        self.lift[leaves] = places[leaves]
        self.anchor[self.down] = places[self.down]
        return bool((self.down != before).any())


SIDES = np.array([[1.0, -1.0], [1.0, 1.0], [-1.0, -1.0], [-1.0, 1.0]])  # (4, 2) signs of x and y of the legs

HIPS = SIDES * [robot.HIP_OFFSET[0], robot.HIP_OFFSET[1] + robot.LINK_LENGTHS[0]]
"""(4, 2) points of the trunk above the nominal footholds: hip axes with abduction offset, trunk frame, m."""

ACROSS = HIPS[:, ::-1] * [-1.0, 1.0]  # (4, 2) velocities of these points at a yaw rate of 1 rad/s, m/s


def footholds(
    gain: float, velocity: np.ndarray, command: Command, left: np.ndarray, stance: float, legs: np.ndarray
) -> np.ndarray:
    """Return footholds (n, 2) of ``legs`` (n,) from the trunk's origin, m; all in the axes of the robot's heading.

    Below the position of the hip in mid-stance (Raibert 1986), plus ``gain``, s, times the error of the trunk's
    ``velocity`` (3,), m/s. ``left`` (n,) is the time until each touch-down, ``stance`` the duration of the stance, s.
    """
    vx, vy, _ = velocity.tolist()
    x, y, yaw = command
    moving = yaw * ACROSS[legs] + [vx, vy]
    return np.asarray(HIPS[legs] + moving * (left + 0.5 * stance)[:, None] + gain * np.array([vx - x, vy - y]))


def way(
    start: np.ndarray, end: np.ndarray, height: float, share: np.ndarray, duration: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return position (n, 3), m, and velocity (n, 3), m/s, of feet on their way from ``start`` to ``end``, m.

    Horizontally a cubic from rest to rest in ``duration`` s; vertically the same plus a bump 16 s^2 (1 - s)^2 of
    ``height`` m. ``share`` (n,) of the swing has passed.
    """
    left = share * (1.0 - share)
    blend, rate = share * share * (3.0 - 2.0 * share), 6.0 / duration * left
    ahead = end - start
    place, velocity = start + blend[:, None] * ahead, rate[:, None] * ahead
    place[:, 2] += 16.0 * height * left * left
    velocity[:, 2] += 32.0 * height / duration * left * (1.0 - 2.0 * share)
    return place, velocity


def solved(jacobians: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return joint changes (n, 3, k) that move feet by the columns of ``vectors`` (n, 3, k): damped least squares."""
    transposed = jacobians.transpose(0, 2, 1)
    square = jacobians @ transposed + DAMPING**2 * np.eye(3)
    return np.asarray(transposed @ np.linalg.solve(square, vectors))
