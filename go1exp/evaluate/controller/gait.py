"""When each foot is meant to stand: a clock and four offsets."""

from __future__ import annotations

import numpy as np


class Clock:
    """The clock of a gait.

    A leg stands in the first ``duty`` of its cycle and swings in the rest.

    Attributes:
        duty: that share.
        period: of a cycle, s.
    """

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

    @property
    def stance_time(self) -> float:
        """Time that a foot stands in each cycle, s."""
        return self.duty * self.period

    @property
    def swing_time(self) -> float:
        """Time that a foot swings in each cycle, s."""
        return (1.0 - self.duty) * self.period

    def stands(self) -> np.ndarray:
        """(4,) bool: meant to stand now."""
        return self.phases < self.duty

    def swing_share(self) -> np.ndarray:
        """(4,) how much of the swing has passed, 0 to 1; negative while standing."""
        return (self.phases - self.duty) / (1.0 - self.duty)

    def schedule(self, steps: int, dt: float) -> np.ndarray:
        """(steps, 4) bool: meant to stand in the middle of each of the coming intervals of ``dt`` s."""
        middles = (np.arange(steps) + 0.5)[:, None] * (dt / self.period)
        return (self._phase + middles + self._offsets) % 1.0 < self.duty
