"""A controller in the runtime's loop, in place of a bundle's policy."""

from __future__ import annotations

import numpy as np

from go1exp.evaluate.controller.types import Controller, Sensed
from go1exp.robot.messages import LowCmd, LowState


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
