"""Protocol of actuators, and their gains."""

from __future__ import annotations

import inspect
from typing import Any, Protocol, TypeGuard, runtime_checkable

from torch import Tensor

from go1exp.base.tensors.memory import Memory


class Actuator(Protocol):
    """Turns position targets into torques at the physics rate; owns whatever history that takes."""

    def torque(self, target: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        """Return joint torques (N, J), N m, for targets and angles in rad and speeds in rad/s.

        An actuator that can be fed forward has a fourth argument, ``feedforward: Tensor | None = None``, (N, J), N m:
        added to its own torque before the limit, and delayed as the target is (``TakesFeedforward``).
        """

    def reset(self, mask: Tensor) -> None:
        """Forget the history of the rows of ``mask`` (N,) bool."""

    def state_dict(self) -> dict[str, Any]:
        """Return the history."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue with that history."""


class TakesFeedforward(Actuator, Protocol):
    """An actuator to which a torque can be added, as a Go1's motors add ``LowCmd.tau``."""

    def torque(self, target: Tensor, q: Tensor, qd: Tensor, feedforward: Tensor | None = None) -> Tensor:
        """Return joint torques (N, J), N m, that of the law plus ``feedforward``, within the actuator's limit."""


def takes_feedforward(actuator: Actuator) -> TypeGuard[TakesFeedforward]:
    """Return whether an actuator, and the one that it may wrap, can be fed forward."""
    inner = getattr(actuator, "drive", None)
    itself = "feedforward" in inspect.signature(actuator.torque).parameters
    return itself and (inner is None or takes_feedforward(inner))


@runtime_checkable
class HasGains(Protocol):
    """An actuator whose gains, both (N, J), can be written in place: its own or the wrapped actuator's."""

    @property
    def kp(self) -> Tensor:
        """N m/rad."""

    @property
    def kd(self) -> Tensor:
        """N m s/rad."""


class Gains(Memory):
    """Base of actuators with a position gain ``kp`` and a speed gain ``kd``, both (N, J) and writable in place.

    Registered with ``gains=True``, so that effects on the gains know where they can act.
    """

    memory = ("kp", "kd")
    kp: Tensor
    """N m/rad."""
    kd: Tensor
    """N m s/rad."""
