"""Delays of a robot's packets relative to the fastest one, by the robot's clock.

The two clocks have different origins, so the latency of the fastest packet is unknown. The delay of another one
relative to it is: arrival less the robot's clock, less the smallest such difference.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping

import numpy as np

WINDOW_S = 1.0
"""Window of the fastest packet, s: 500 packets, and clocks that differ by 100 ppm drift by 0.1 ms."""


MOST_SLIP = 1e-3
"""Relative difference of the clocks from which it is reported: 1 ms of delay within ``WINDOW_S``."""

SHORTEST_S = 2.0
"""Shortest time over which clocks are compared, s: the tick's resolution is 1 ms."""

FEWEST = 8
"""Smallest number of packets for that."""


class PacketDelay:
    """Delays of packets relative to the fastest of the last ``WINDOW_S``."""

    def __init__(self) -> None:
        """Start without any packet."""
        # Arrival and offset. Offsets increase, so that the first is the least.
        self._least: deque[tuple[float, float]] = deque()

    def note(self, arrived: float, clock: float) -> float:
        """Add a packet that ``arrived`` by our clock, s, measured at ``clock`` by the robot's; return its delay, s.

        Packets are given in the order of arrival. NaN if the robot reports no clock.
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
        """Return the age at ``now`` of a state measured at ``clock``, less the latency of the fastest packet, s.

        NaN if the robot reports no clock, or before the first packet.
        """
        return now - clock - self._least[0][1] if self._least else math.nan


def delays(arrived: Iterable[float], clock: Iterable[float]) -> np.ndarray:
    """Return the delays (T,), s, of packets in the order of arrival; arguments as those of ``PacketDelay.note``."""
    packets = PacketDelay()
    return np.array([packets.note(float(t), float(c)) for t, c in zip(arrived, clock, strict=True)])


def slip(arrived: np.ndarray, clock: np.ndarray) -> float | None:
    """Return the relative rate error of the robot's clock, both (T,), s: positive if it runs slow.

    Computed from the fastest packets of the first and of the last quarter, so that variable delays do not count. None
    without a clock, or over less than ``SHORTEST_S``.
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
