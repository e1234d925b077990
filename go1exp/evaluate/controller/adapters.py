"""Adapters of a controller: to actuators that take position targets alone, and to the runtime's loop."""

from __future__ import annotations

import numpy as np

from go1exp.evaluate.controller.types import Command, Controller, Drive, Sensed
from go1exp.robot.messages import LowCmd, LowState


class AsTargets:
    """Turns what a controller asks for into targets alone, so that the drives make the same torque at its ticks.

    With the gains kp and kd of the drives, the target is q + (torque + kd qd) / kp. Between two ticks the drives react
    with their own gains, not with those of the controller. Recordings of such a walk are complete: what moved the robot
    are its targets.

    Attributes:
        period: time between two calls, s.
    """

    def __init__(self, inner: Controller, kp: np.ndarray, kd: np.ndarray) -> None:
        """Wrap ``inner`` for drives with gains (12,), N m/rad, positive, and N m s/rad."""
        self.period = inner.period
        self._inner, self._kp, self._kd = inner, np.asarray(kp, dtype=float), np.asarray(kd, dtype=float)

    def reset(self) -> None:
        """Forget everything."""
        self._inner.reset()

    def step(self, command: Command, sensed: Sensed) -> Drive:
        """Return targets at the drives' own gains, without any torque that is fed forward."""
        drive, q, qd = self._inner.step(command, sensed), sensed.joint_pos, sensed.joint_vel
        torque = drive.kp * (drive.target - q) - drive.kd * qd
        if drive.feedforward is not None:
            torque = torque + drive.feedforward
        return Drive(q + (torque + self._kd * qd) / self._kp, self._kp, self._kd)


class Deployed:
    """Gives a controller what the robot reports, and the drives what the controller says.

    The loop must run at the controller's own rate.
    """

    def __init__(self, controller: Controller) -> None:
        """Walk by ``controller``."""
        self._controller = controller

    def step(self, velocity: np.ndarray, state: LowState, base_lin_vel: np.ndarray) -> LowCmd:
        """Return the command of a cycle; arguments as those of ``go1exp.deploy.runtime.controller.Mover``."""
        x, y, yaw = velocity.tolist()
        sensed = Sensed(
            joint_pos=state.joint_pos,
            joint_vel=state.joint_vel,
            quat=state.imu_quat,
            gyro=state.imu_gyro,
            velocity_b=base_lin_vel,
            foot_force=state.foot_force,
        )
        drive = self._controller.step((x, y, yaw), sensed)
        return LowCmd(drive.target, drive.kp, drive.kd, feedforward=drive.feedforward)
