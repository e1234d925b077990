"""Which torques a hung robot's joints must have got, from how they moved."""

from __future__ import annotations

import mujoco
import numpy as np

from go1exp import robot
from go1exp.robot.config import RobotConfig
from go1exp.sim.physics.scene import build_model


def joint_torques(
    config: RobotConfig, base_quat: tuple[float, float, float, float], q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Return M(q) qdd + c(q, qd) + g(q) of a robot whose trunk is held: what actuator and friction together gave.

    Args:
        config: the robot; its damping and dry friction are the model's own, so that they are not in the result.
        base_quat: attitude of the trunk, w-x-y-z.
        q: joint angles (T, 12), rad.
        qd: joint speeds (T, 12), rad/s.
        qdd: joint accelerations (T, 12), rad/s2.

    Returns:
        torques (T, 12), N m.
    """
    model, _ = build_model(config, None, physics_dt=0.002, held=base_quat)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)  # no stop and no ground is touched
    data = mujoco.MjData(model)
    torque = np.zeros_like(q)
    for row in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[row], qd[row], qdd[row]
        mujoco.mj_inverse(model, data)
        torque[row] = data.qfrc_inverse
    return torque + robot.per_joint(config.friction_loss) * np.sign(qd)
