"""Which feet stand: the schedule, corrected by what the feet feel."""

from __future__ import annotations

import numpy as np

from go1exp import robot
from go1exp.evaluate.controller.gait import Clock

LEGS = robot.NUM_LEGS


class Feet:
    """Schedule and contact of the four feet.

    A foot leaves the ground when the schedule says so. It stands again as soon as it feels the ground: early, in the
    second half of its swing, or late, when its stance has begun without any ground to push on.

    Attributes:
        down: (4,) bool, which feet stand.
        lift: (4, 3) where each foot last left the ground, m.
        anchor: (4, 3) where each foot stands or last stood, m.
        overdue: (4,) time since a foot should have found the ground, s; 0 for those that stand or swing.
    """

    def __init__(self, contact_force: float, dt: float) -> None:
        """Feel the ground from ``contact_force`` N on; called every ``dt`` s."""
        self._contact_force, self._dt = contact_force, dt
        self.restart()

    def restart(self) -> None:
        """Forget all; the next call is the first one."""
        self.down, self._planned = np.ones(LEGS, dtype=bool), np.ones(LEGS, dtype=bool)
        self.lift, self.anchor = np.zeros((LEGS, 3)), np.zeros((LEGS, 3))
        self.overdue = np.zeros(LEGS)
        self._fresh = True

    def update(self, clock: Clock, force: np.ndarray, places: np.ndarray) -> bool:
        """Take forces (4,), N, and places (4, 3), m, of the feet; return whether other feet stand than before."""
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
