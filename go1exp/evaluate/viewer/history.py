"""The last seconds of everything that is drawn as a curve."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SPAN = 10.0
"""How long a curve is, s."""


class History:
    """A ring of rows, one for each period of the policy.

    Attributes:
        widths: columns by the name of a quantity.
        dt: time from row to row, s.
    """

    def __init__(self, widths: Mapping[str, int], dt: float) -> None:
        """Keep the last ``SPAN`` s."""
        self.widths, self.dt = dict(widths), dt
        self._rows = max(2, round(SPAN / dt))
        ends = np.cumsum([0, *self.widths.values()])
        spans = pairwise(ends)
        self._place = {name: slice(int(a), int(b)) for name, (a, b) in zip(self.widths, spans, strict=True)}
        self._values = np.full((self._rows, int(ends[-1])), np.nan)
        self.count = 0

    def add(self, quantities: Mapping[str, NDArray[np.floating]]) -> None:
        """Add a row; a quantity that is not given is not drawn there."""
        row = self._values[self.count % self._rows]
        row.fill(np.nan)
        for name, values in quantities.items():
            row[self._place[name]] = values
        self.count += 1

    def clear(self) -> None:
        """Forget all rows."""
        self.count = 0

    @property
    def filled(self) -> int:
        """How many rows there are."""
        return min(self.count, self._rows)

    def _indices(self, every: int) -> NDArray[np.int64]:
        """Numbers of the kept rows, oldest first: whole multiples of ``every``, so that a curve does not flicker."""
        first = self.count - self.filled
        return np.arange(-(-first // every) * every, self.count, every)

    def times(self, every: int = 1) -> Array:
        """Return the time of each row, oldest first: 0 for the newest, s."""
        return np.asarray((self._indices(every) - (self.count - 1)) * self.dt, dtype=np.float64)

    def series(self, name: str, every: int = 1) -> Array:
        """Return a quantity's rows (T, W), oldest first; every n-th of them for ``every`` = n."""
        return np.asarray(self._values[self._indices(every) % self._rows, self._place[name]])

    def last(self, name: str, seconds: float) -> Array:
        """Return the rows (T, W) of the last ``seconds`` s."""
        return self.series(name)[-max(1, round(seconds / self.dt)) :]
