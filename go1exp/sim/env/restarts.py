"""Restarts of ended episodes, left out where none has ended."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor

from go1exp.base.tensors.randomness import EnvRandom


class Restarts:
    """Calls a restart of the rows of a mask; where looking at the mask is free and it is empty, only counters move.

    A restart draws the same number of random numbers whatever the mask, so that a robot's do not depend on the others
    of its batch. For a few robots on a CPU a restart of nobody would cost a quarter of the step; on a GPU looking would
    cost more.
    """

    def __init__(self, restart: Callable[[Tensor], None], randoms: Sequence[EnvRandom]) -> None:
        """Wrap ``restart``, which draws from ``randoms`` only."""
        self._restart, self._randoms = restart, list(dict.fromkeys(randoms))
        self._draws: list[dict[str, int]] | None = None

    def __call__(self, mask: Tensor) -> None:
        """Restart the rows of ``mask`` (N,) bool."""
        if mask.is_cuda:
            self._restart(mask)
        elif self._draws is None or mask.any():
            before = [random.counters() for random in self._randoms]
            self._restart(mask)
            after = [random.counters() for random in self._randoms]
            self._draws = [
                {name: count - old.get(name, 0) for name, count in new.items() if count != old.get(name, 0)}
                for old, new in zip(before, after, strict=True)
            ]
        else:
            for random, draws in zip(self._randoms, self._draws, strict=True):
                random.leave_out(draws)
