"""How often the page draws: the robot comes first."""

from __future__ import annotations

FRAME_S = 1.0 / 33.0
"""Least time from picture to picture, s. A browser asks for up to 60 in a second; each costs the panels anew."""

SLOWEST_FRAME_S = 0.1
"""Time from picture to picture where the computer is too slow for robot and pictures, s."""

DECISION_S = 1.0
"""How often the time from picture to picture is decided on, s."""

LOST_SHARE = 0.02
"""Share of its time that the robot may lose before pictures become fewer."""

LONGER, SHORTER = 1.3, 0.95
"""Factors of the time from picture to picture when the robot loses time, and when it does not."""


class PictureRate:
    """Fewer pictures while the robot loses time, and slowly more again.

    Attributes:
        every: least time from picture to picture, s.
    """

    def __init__(self, now: float) -> None:
        """Begin at the time ``now``, s, with as many pictures as are ever drawn."""
        self.every, self._begin, self._lost = FRAME_S, now, 0.0

    def note(self, now: float, lost: float) -> bool:
        """Take in that the robot lost ``lost`` s of its time just now; return whether ``every`` has changed."""
        self._lost += lost
        passed = now - self._begin
        if passed < DECISION_S:
            return False
        before, factor = self.every, LONGER if self._lost > LOST_SHARE * passed else SHORTER
        self.every = min(max(self.every * factor, FRAME_S), SLOWEST_FRAME_S)
        self._begin, self._lost = now, 0.0
        return self.every != before
