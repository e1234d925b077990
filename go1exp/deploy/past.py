"""The previous action at another rate than that of training.

A policy has learnt the effect of an action over one training period. The shipped policy, trained at 50 Hz, run at
400 Hz and commanded 1.0 m/s sideways, walked at 0.33 m/s with its action of 2.5 ms ago, and at 1.01 m/s with that of
20 ms ago.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Generic, TypeVar

A = TypeVar("A", bound=Any)  # an array of NumPy or torch


class PastActions(Generic[A]):
    """The newest actions, of one training period.

    Args:
        trained: period of the policy in training, s.
        period: present period of the policy, s.

    Attributes:
        cycles: policy cycles in one training period, at least 1.
    """

    def __init__(self, trained: float, period: float) -> None:
        self.cycles = max(1, round(trained / period))
        self._kept: deque[A] = deque(maxlen=self.cycles)

    def after(self, action: A) -> A:
        """Add the action just taken; return the one that the policy is to see next: zeros in the first period."""
        self._kept.append(action)
        if len(self._kept) < self.cycles:
            nothing: A = action * 0.0
            return nothing
        return self._kept[0]
