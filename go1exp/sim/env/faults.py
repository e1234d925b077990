"""Detection of values that are not finite, and the moment at which one appeared."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Self

import numpy as np
import torch
from torch import Tensor

from go1exp.config.schema.registry import Expected


class NumericalFault(Expected):
    """A value is NaN or infinite.

    Attributes:
        quantity: what it was, such as ``reward.foot_force`` or ``gradient of policy.action_net.bias``.
        dump: arrays that describe the moment, to be saved in the run folder.
    """

    def __init__(
        self, message: object, quantity: str = "", dump: Mapping[str, np.ndarray] = MappingProxyType({})
    ) -> None:
        """Take the message alone, too: so Gymnasium passes errors on from its worker processes."""
        self.quantity, self.dump = quantity, dict(dump)
        super().__init__(str(message))

    @classmethod
    def not_finite(cls, quantity: str, where: str, dump: Mapping[str, np.ndarray] = MappingProxyType({})) -> Self:
        """Return the fault of a quantity at a moment, such as ``in environment 3 at step 7``."""
        return cls(f"{quantity} is not finite {where}", quantity, dump)


def accuse(named: Mapping[str, Tensor], steps: Tensor) -> None:
    """Raise NumericalFault if a value is not finite, about the first such of ``named`` and its first environment.

    Args:
        named: values (N, ...) by name, causes before their effects.
        steps: (N,) steps since the episode began.
    """
    for name, values in named.items():
        bad = ~torch.isfinite(values.reshape(len(values), -1)).all(-1)
        if bad.any():
            env = int(bad.nonzero()[0])
            dump = {key: value[env].cpu().numpy() for key, value in named.items()}
            raise NumericalFault.not_finite(name, f"in environment {env} at step {int(steps[env])}", dump)


class Evidence:
    """Keeps, on the device, the values of the first step in which one was not finite: no step waits to be looked at."""

    def __init__(self) -> None:
        self._kept: dict[str, Tensor] = {}
        self._fault: Tensor | None = None

    def note(self, named: Mapping[str, Tensor], steps: Tensor) -> None:
        """Look at the values of a step, as ``accuse`` takes them; their shapes are those of the first call."""
        values = {**named, "steps": steps}
        if self._fault is None:
            self._kept = {name: torch.zeros_like(value) for name, value in values.items()}
            self._fault = torch.zeros((), dtype=torch.bool, device=steps.device)
        total = torch.stack([value.sum() for value in named.values()]).sum()
        now = ~torch.isfinite(total) & ~self._fault
        for name, value in values.items():
            self._kept[name].copy_(torch.where(now, value, self._kept[name]))
        self._fault.logical_or_(now)

    def check(self) -> None:
        """Raise NumericalFault if a step had a value that was not finite. Waits for the device."""
        if self._fault is not None and self._fault:
            named = {name: value for name, value in self._kept.items() if name != "steps"}
            self._fault.zero_()
            accuse(named, self._kept["steps"])
