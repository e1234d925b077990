"""One filter for each of N robots."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from go1exp.deploy.estimation import WIDTH, go1, make_filter
from go1exp.deploy.estimation import readings as column

PLACES = {
    "quat": column.QUAT,
    "gyro": column.GYRO,
    "acc": column.ACC,
    "q": column.Q,
    "qd": column.QD,
    "foot_force": column.FOOT_FORCE,
}
"""Names of readings and their columns in a sample."""


class Filters:
    """Filters with the settings of the Go1, updated together."""

    def __init__(self, count: int) -> None:
        """Make ``count`` filters.

        Raises:
            go1exp.deploy.estimation.EstimatorError: if the filter is not built.
        """
        self._filters = [make_filter(go1()) for _ in range(count)]

    def update(self, t: float, readings: Mapping[str, np.ndarray]) -> None:
        """Take one sample of every robot: time, s, and readings (N, ...) by the names of ``PLACES``."""
        rows = np.full((len(self._filters), WIDTH), np.nan)
        rows[:, column.T] = t
        for name, place in PLACES.items():
            rows[:, place] = readings[name]
        for one, row in zip(self._filters, rows, strict=True):
            one.update(row)

    def restart(self, robot: int) -> None:
        """Begin anew with one robot's next sample."""
        self._filters[robot].reset()

    @property
    def velocities(self) -> np.ndarray:
        """(N, 3) velocities of the trunks in their own frames, m/s; zero before the first sample."""
        return np.array([one.velocity_b if one.running else np.zeros(3) for one in self._filters])
