"""Interface of a controller of one robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from go1exp.robot.messages import LowCmd

Command = tuple[float, float, float]
"""Commanded velocity of the trunk: x, y in m/s, yaw rate in rad/s, trunk frame."""


@dataclass(frozen=True)
class Sensed:
    """Sensor readings and estimate at one instant. Legs and joints in the order of ``go1exp.robot``.

    Attributes:
        joint_pos: (12,) rad.
        joint_vel: (12,) rad/s.
        quat: (4,) attitude of the trunk in the world, w-x-y-z; its heading may drift.
        gyro: (3,) angular velocity, trunk frame, rad/s.
        velocity_b: (3,) estimated velocity of the trunk's origin, trunk frame, m/s.
        foot_force: (4,) N.
    """

    joint_pos: np.ndarray
    joint_vel: np.ndarray
    quat: np.ndarray
    gyro: np.ndarray
    velocity_b: np.ndarray
    foot_force: np.ndarray


class Controller(Protocol):
    """Controls one robot, called once every ``period``.

    Attributes:
        period: time between two calls, s.
    """

    period: float

    def reset(self) -> None:
        """Reset: the next call is the first one."""

    def step(self, command: Command, sensed: Sensed) -> LowCmd:
        """Return the motors' command until the next call."""


@runtime_checkable
class Savable(Protocol):
    """A controller whose state can be saved and restored."""

    def save(self) -> Any:
        """Return a copy of its state."""

    def load(self, state: Any) -> None:
        """Restore what ``save`` returned."""
