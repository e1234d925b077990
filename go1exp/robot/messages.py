"""Messages between robot and runtime, for any link: joints and legs in the bundle's order, SI units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

OVERTAKEN_S = 0.01
"""Largest age of an accepted state relative to the newest, s: twice a jitter of 5 ms."""


@dataclass(frozen=True)
class LowState:
    """Readings of the robot's sensors at one instant.

    Attributes:
        t: when it arrived, on the runtime's own clock, s.
        joint_pos: (J,) rad.
        joint_vel: (J,) rad/s.
        joint_torque: (J,) N m, as reported by the motors.
        imu_quat: (4,) w-x-y-z, trunk to world.
        imu_gyro: (3,) rad/s, trunk frame.
        imu_acc: (3,) specific force, m/s2, trunk frame.
        foot_force: (4,) in the sensor's own unit, not calibrated.
        clock: the robot's clock at the measurement, s; NaN if the robot does not report it.
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


@dataclass(frozen=True)
class LowCmd:
    """Command for the motors: torque = kp (joint_target - joint_pos) - kd joint_vel + feedforward.

    Attributes:
        joint_target: (J,) rad.
        kp: (J,) N m/rad.
        kd: (J,) N m s/rad.
        damping: the motors brake: kp is zero, and a link may use the motors' damping mode.
        feedforward: (J,) N m; None for none.
    """

    joint_target: np.ndarray
    kp: np.ndarray
    kd: np.ndarray
    damping: bool = False
    feedforward: np.ndarray | None = None


class Link(Protocol):
    """The connection to a robot, real or simulated.

    Attributes:
        sent_at: time at which the last command was sent, s on the runtime's clock; NaN before.
    """

    sent_at: float

    def receive(self) -> Sequence[LowState]:
        """Return the states that have arrived since the last call, in the order of arrival, without waiting.

        Without duplicates. An overtaken one, by ``OVERTAKEN_S`` at most, follows those that overtook it.
        """

    def send(self, command: LowCmd) -> None:
        """Send a command, without waiting."""

    def repeat(self) -> None:
        """Send what the protocol requires between two commands; called every 2 ms."""

    def rehearse(self, command: LowCmd) -> None:
        """Do the work of sending a command, without sending it, so that caches are warm."""

    def close(self) -> None:
        """Close the connection."""
