"""What goes between robot and runtime, whatever carries it: joints and legs in the bundle's order, SI units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class LowState:
    """What the robot's sensors say at one moment.

    Attributes:
        t: when it arrived, on the runtime's own clock, s.
        joint_pos: (J,) rad.
        joint_vel: (J,) rad/s.
        joint_torque: (J,) N m, as the drives report.
        imu_quat: (4,) w-x-y-z, trunk to world.
        imu_gyro: (3,) rad/s, trunk frame.
        imu_acc: (3,) specific force, m/s2, trunk frame.
        foot_force: (4,) in the sensor's own unit, not calibrated.
        clock: the robot's own clock when it was measured, s; NaN if the robot tells none.
        in_force: number of the newest command that the drives had then, counted from 1 by the link as it sends; 0 for
            none yet, -1 if the robot does not tell.
    """

    t: float
    joint_pos: np.ndarray
    joint_vel: np.ndarray
    joint_torque: np.ndarray
    imu_quat: np.ndarray
    imu_gyro: np.ndarray
    imu_acc: np.ndarray
    foot_force: np.ndarray
    clock: float = math.nan
    in_force: int = -1


@dataclass(frozen=True)
class LowCmd:
    """What the drives are to do: torque = kp (joint_target - joint_pos) - kd joint_vel.

    Attributes:
        joint_target: (J,) rad.
        kp: (J,) N m/rad.
        kd: (J,) N m s/rad.
        damping: let the drives brake: kp is zero, and a link may use its drives' own damping mode.
    """

    joint_target: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    damping: bool = False


class Link(Protocol):
    """The way to a robot, real or simulated."""

    def receive(self) -> Sequence[LowState]:
        """Return the states that have arrived since the last call, oldest first, without waiting."""

    def send(self, command: LowCmd) -> None:
        """Send a command, without waiting."""

    def close(self) -> None:
        """Give the way back."""
