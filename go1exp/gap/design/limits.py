"""What a designed recording may ask of the robot: angle, speed, torque and power, from the robot's model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from go1exp.base.errors import Expected
from go1exp.gap.data.windows import Windows
from go1exp.gap.design.settings import Safety
from go1exp.gap.robots.protocol import Robot


class DesignError(Expected):
    """A recording that cannot be designed; the message says what is missing."""


@runtime_checkable
class Movable(Protocol):
    """A robot on a base that is held, whose model says how far and how fast its joints may go."""

    @property
    def top_speed(self) -> tuple[float, ...]:
        """Speed without load (J,), rad/s."""

    @property
    def angle_range(self) -> np.ndarray:
        """Lowest and highest angle (J, 2), rad; NaN where the model has no stops."""


@dataclass(frozen=True)
class Used:
    """Largest share of each limit that a motion uses; above 1 it is beyond. Power in W."""

    angle: float
    speed: float
    torque: float
    power: float


@dataclass(frozen=True)
class Limits:
    """Limits of motions.

    Attributes:
        centre: angles to move about (J,), rad.
        angle: lowest and highest (J, 2), rad.
        speed: (J,) rad/s.
        torque: (J,) N m.
        power: of all joints together, W.
    """

    centre: np.ndarray
    angle: np.ndarray
    speed: np.ndarray
    torque: np.ndarray
    power: float

    def used(self, q: np.ndarray, qd: np.ndarray, torque: np.ndarray) -> Used:
        """Return how much of the limits a motion uses: angles (T, J), speeds (T, J) and torques (T, J)."""
        middle, half = self.angle.mean(axis=1), 0.5 * np.ptp(self.angle, axis=1)
        return Used(
            float((np.abs(q - middle) / half).max()),
            float((np.abs(qd) / self.speed).max()),
            float((np.abs(torque) / self.torque).max()),
            float(np.abs(torque * qd).sum(axis=1).max()),
        )

    def allow(self, used: Used) -> bool:
        """Return whether a motion stays within all limits."""
        return max(used.angle, used.speed, used.torque, used.power / self.power) <= 1.0


def limits_of(robot: Robot, windows: Windows, targets: Sequence[np.ndarray], safety: Safety) -> Limits:
    """Return the limits of a robot.

    Motions are about the middle of the targets at hand, in which the robot has been. A joint whose model has no stops
    may go where it has been in the recordings.

    Args:
        robot: whose base is held.
        windows: of the recordings at hand.
        targets: of each of them (T, J), rad.
        safety: the user's shares.

    Raises:
        DesignError: if the robot's base is not held.
    """
    if not isinstance(robot, Movable):
        raise DesignError(
            "gap next designs motions of a robot whose base is held; record it suspended (support=suspended)"
        )
    been = windows.y[:, :, 0][windows.valid]
    sent = np.concatenate(targets)
    reach = np.stack([np.minimum(been.min(0), sent.min(0)), np.maximum(been.max(0), sent.max(0))], axis=1)
    angles = np.where(np.isfinite(robot.angle_range), robot.angle_range, reach)
    middle = angles.mean(axis=1, keepdims=True)
    angles = middle + safety.angle * (angles - middle)
    centre = np.median(sent, axis=0).clip(angles[:, 0], angles[:, 1])
    speed, torque = np.array(robot.top_speed) * safety.speed, np.array(robot.effort) * safety.torque
    return Limits(centre, angles, speed, torque, safety.power)
