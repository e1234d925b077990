"""How much later than the fastest a robot's packets come, by its own clock.

The two clocks have different origins and a Go1 answers to no packet by name, so the time that the fastest packet takes
is not known. What another one takes beyond it is: arrival less the robot's clock, less the smallest such difference.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping

import numpy as np

WINDOW_S = 1.0
"""Time in which the fastest packet is looked for, s: 500 packets, and clocks that are 100 ppm apart move by 0.1 ms."""


MOST_SLIP = 1e-3
"""Share by which clocks may differ before delays are not told alone: within ``WINDOW_S`` that makes 1 ms of delay."""

SHORTEST_S = 2.0
"""Time over which clocks are compared at least, s: those that tick in ms make an error of 1 ms in half of it."""

FEWEST = 8
"""Packets that this takes at least."""


class PacketDelay:
    """Delays of packets beyond the fastest of the last ``WINDOW_S``."""

    def __init__(self) -> None:
        """Begin without any packet."""
        # Arrival and offset. Offsets increase, so that the first is the least.
        self._least: deque[tuple[float, float]] = deque()

    def note(self, arrived: float, clock: float) -> float:
        """Take a packet that ``arrived`` by our clock, s, measured at ``clock`` by the robot's; return its delay, s.

        Packets come in the order of arrival. NaN if the robot tells no clock.
        """
        if math.isnan(clock):
            return math.nan
        offset, least = arrived - clock, self._least
        while least and least[-1][1] >= offset:
            least.pop()
        least.append((arrived, offset))
        while least[0][0] < arrived - WINDOW_S:
            least.popleft()
        return offset - least[0][1]

    def age(self, now: float, clock: float) -> float:
        """Return how long ago by our clock, at ``now``, the robot's was ``clock``, less the fastest way, s.

        NaN if the robot tells no clock, or before the first packet.
        """
        return now - clock - self._least[0][1] if self._least else math.nan


def delays(arrived: Iterable[float], clock: Iterable[float]) -> np.ndarray:
    """Return the delays (T,), s, of packets in the order of arrival; arguments as those of ``PacketDelay.note``."""
    way = PacketDelay()
    return np.array([way.note(float(t), float(c)) for t, c in zip(arrived, clock, strict=True)])


def slip(arrived: np.ndarray, clock: np.ndarray) -> float | None:
    """Return by what share of our time the robot's clock, both (T,), s, runs slow, negative if it runs fast.

    By the fastest packets of the first and of the last quarter, so that a delay that varies is no slip. None without a
    clock, and over less than ``SHORTEST_S``, where its resolution would count.
    """
    known = np.isfinite(clock)
    arrived, offset = arrived[known], (arrived - clock)[known]
    if len(arrived) < FEWEST or arrived[-1] - arrived[0] < SHORTEST_S:
        return None
    quarter = len(arrived) // 4
    first, last = int(np.argmin(offset[:quarter])), len(arrived) - quarter + int(np.argmin(offset[-quarter:]))
    return float((offset[last] - offset[first]) / (arrived[last] - arrived[first]))


def spread(values: np.ndarray) -> Mapping[str, float] | None:
    """Return median, 99th percentile and largest of times, s, by name; None if none is known."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    p50, p99 = np.percentile(known, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "worst": float(known.max())}
