"""What goes into a controller and what comes out of it, for one robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

Command = tuple[float, float, float]
"""Commanded velocity of the trunk: x, y in m/s, yaw rate in rad/s, trunk frame."""


@dataclass(frozen=True)
class Sensed:
    """What the robot's computer knows at one instant. Legs and joints in the order of ``robot.py``.

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


@dataclass(frozen=True)
class Drive:
    """What the drives are told: torque = kp (target - q) - kd qd + feedforward, each (12,).

    Attributes:
        target: rad.
        kp: N m/rad.
        kd: N m s/rad.
        feedforward: N m; None for none.
    """

    target: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    feedforward: np.ndarray | None = None


class Controller(Protocol):
    """Moves one robot, called once every ``period``.

    Attributes:
        period: time between two calls, s.
    """

    period: float

    def reset(self) -> None:
        """Forget everything: the next call is the first one."""

    def step(self, command: Command, sensed: Sensed) -> Drive:
        """Return what the drives are told until the next call."""


@runtime_checkable
class Savable(Protocol):
    """A controller that can be put back to an instant; one that cannot is played from its start again."""

    def save(self) -> Any:
        """Return a copy of everything that it remembers."""

    def load(self, state: Any) -> None:
        """Put back what ``save`` returned."""
