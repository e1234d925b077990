"""Interface of a controller of one robot, and its adapters to other interfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from go1exp.robot.messages import LowCmd, LowState

Command = tuple[float, float, float]  # commanded velocity of the trunk: x, y in m/s, yaw rate in rad/s, trunk frame


TrunkVelocity = Literal["exact", "estimated"]
"""Velocity of the trunk that is observed: the true one, or what the filter makes of the sensors."""


@dataclass(frozen=True)
class Sensed:
    """Sensor readings and estimate at one instant. Legs and joints in the order of ``go1exp.robot``."""

    joint_pos: np.ndarray  # (12,) rad
    joint_vel: np.ndarray  # (12,) rad/s
    quat: np.ndarray  # (4,) attitude of the trunk in the world, w-x-y-z; its heading may drift
    gyro: np.ndarray  # (3,) angular velocity, trunk frame, rad/s
    velocity_b: np.ndarray  # (3,) estimated velocity of the trunk's origin, trunk frame, m/s
    foot_force: np.ndarray  # (4,) N


class Controller(Protocol):
    """Controls one robot, called once every ``period`` s.

    One that can go back to a saved state also has ``save``, which returns a copy of it, and ``load``, which takes that.
    """

    period: float

    def reset(self) -> None:
        """Reset: the next call is the first one."""

    def step(self, command: Command, sensed: Sensed) -> LowCmd:
        """Return the motors' command until the next call."""


class AsTargets:
    """Converts a controller's commands to position targets at fixed gains, with the same torque at its ticks.

    With the actuator's gains kp and kd, the target is q + (torque + kd qd) / kp. Between two ticks the actuator's gains
    act, not the controller's. Recordings of such a walk are complete: the targets determine the motion.
    """

    def __init__(self, inner: Controller, kp: np.ndarray, kd: np.ndarray) -> None:
        """Wrap ``inner`` for an actuator with gains (12,), N m/rad, positive, and N m s/rad."""
        self.period = inner.period
        self._inner, self._kp, self._kd = inner, np.asarray(kp, dtype=float), np.asarray(kd, dtype=float)

    def reset(self) -> None:
        """Reset the controller."""
        self._inner.reset()

    def step(self, command: Command, sensed: Sensed) -> LowCmd:
        """Return targets at the actuator's gains, without feed-forward torque."""
        inner, q, qd = self._inner.step(command, sensed), sensed.joint_pos, sensed.joint_vel
        torque = inner.kp * (inner.joint_target - q) - inner.kd * qd
        if inner.feedforward is not None:
            torque = torque + inner.feedforward
        return LowCmd(q + (torque + self._kd * qd) / self._kp, self._kp, self._kd)


class Deployed:
    """A controller in the runtime's loop, which must run at its rate, in place of a bundle's policy."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller

    def step(self, velocity: np.ndarray, state: LowState, base_lin_vel: np.ndarray) -> LowCmd:
        """Return the command of a cycle; arguments as those of ``go1exp.deploy.runtime.controller.Mover``."""
        x, y, yaw = velocity.tolist()
        readings = state.joint_pos, state.joint_vel, state.imu_quat, state.imu_gyro, base_lin_vel, state.foot_force
        return self._controller.step((x, y, yaw), Sensed(*readings))
