"""What a policy remembers, at another rate than that of training.

A policy has learnt the effect of an action over one training period. An earlier shipped policy, trained at 50 Hz, run
at 400 Hz and commanded 1.0 m/s sideways, walked at 0.33 m/s with its action of 2.5 ms ago, and at 1.01 m/s with that of
20 ms ago. The same holds for earlier frames of what it observes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

import numpy as np

from go1exp.config.schema.history import columns_of
from go1exp.deploy.runtime.metadata import Metadata

A = TypeVar("A", bound=Any)  # an array of NumPy or torch


class Past(Generic[A]):
    """The newest values of something, of one training period.

    Args:
        trained: period of the policy in training, s.
        period: present period of the policy, s.

    Attributes:
        cycles: policy cycles in one training period, at least 1.
    """

    def __init__(self, trained: float, period: float) -> None:
        self.cycles = max(1, round(trained / period))
        self._kept: deque[A] = deque(maxlen=self.cycles)

    def after(self, newest: A, before: A) -> A:
        """Add the newest value; return that of one training period before the next cycle, ``before`` if there is none.

        The next cycle then sees what it would have seen in training.
        """
        self._kept.append(newest)
        return before if len(self._kept) < self.cycles else self._kept[0]


class PolicyMemory:
    """Runs a policy and keeps what its inputs ``previous_action`` and ``past`` are in the next cycle.

    Attributes:
        values: these inputs by name, float32 (rows, size), as far as the policy has them.
    """

    def __init__(self, about: Metadata, period: float, rows: int = 1) -> None:
        """Begin an episode of ``rows`` robots; ``period`` of the policy now, s."""
        sizes = {port.name: port.size for port in about.inputs}
        self.values: dict[str, np.ndarray] = {
            name: np.zeros((rows, sizes[name]), np.float32) for name in ("previous_action", "past") if name in sizes
        }
        self._columns = columns_of((block.size // block.history, block.history) for block in about.observation)
        self._actions = Past[np.ndarray](about.policy_dt, period)
        self._frames = Past[np.ndarray](about.policy_dt, period)
        self._first: np.ndarray | None = None

    def __call__(
        self, policy: Callable[[Mapping[str, np.ndarray]], dict[str, np.ndarray]], readings: dict[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Return the policy's outputs for the readings, to which what it remembers is added in place."""
        readings |= self.values
        if "past" in self.values and self._first is None:  # before the first frame there were others like it
            self._first = policy(readings)["observation"][:, self._columns.newest]
            readings["past"] = self.values["past"] = self._first
        outputs = policy(readings)
        if "previous_action" in self.values:
            self.values["previous_action"] = self._actions.after(outputs["action"], 0.0 * outputs["action"])
        if self._first is not None:
            self.values["past"] = self._frames.after(outputs["observation"][:, self._columns.carried], self._first)
        return outputs
