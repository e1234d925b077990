"""Kinematics of the legs in the trunk's frame, and their inverse dynamics, by MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np

from go1exp import robot
from go1exp.robot.config import RobotConfig
from go1exp.sim.physics.scene import build_model
from go1exp.sim.terrain import TerrainConfig, build_terrain


class Legs:
    """Kinematics of the legs.

    Attributes:
        radius: of the feet, m.
        imu_site: (3,) where the IMU sits in the trunk, m.
    """

    def __init__(self, config: RobotConfig) -> None:
        """Compile the robot with its trunk held level."""
        model, _ = build_model(config, build_terrain(TerrainConfig(kind="flat")), 0.002, held=(1.0, 0.0, 0.0, 0.0))
        self.model, self._data = model, mujoco.MjData(model)
        self._bodies = [model.body(f"{leg}_calf").id for leg in robot.LEGS]
        self._sites = [model.site(f"{leg}_foot").id for leg in robot.LEGS]
        self.trunk = model.body("trunk").id
        self.radius = float(model.geom(f"{robot.LEGS[0]}_foot").size[0])
        self.imu_site = np.array(model.site("imu").pos)

    def feet(self, q: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the feet (4, 3) touch a ground whose normal is ``up`` (3,), m, and how that moves (4, 3, 12)."""
        model, data = self.model, self._data
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        origin = data.xpos[self.trunk]
        points, moves = np.empty((4, 3)), np.empty((4, 3, model.nv))
        for k, (body, site) in enumerate(zip(self._bodies, self._sites, strict=True)):
            low = data.site_xpos[site] - self.radius * up
            mujoco.mj_jac(model, data, moves[k], None, low, body)
            points[k] = low - origin
        return points, moves

    def forces(self, moves: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the forces on the feet (4, 3), N, that balance joint torques (12,); a straight leg's is the least."""
        joints = np.arange(robot.NUM_JOINTS).reshape(robot.NUM_LEGS, -1)
        return np.stack([-np.linalg.lstsq(moves[k][:, joints[k]].T, torque[joints[k]])[0] for k in range(len(joints))])


class LegDynamics:
    """Inverse dynamics of legs in the air, on a trunk that moves, by MuJoCo."""

    def __init__(self, config: RobotConfig) -> None:
        """Compile the robot with its trunk free and nothing to touch."""
        self._model, _ = build_model(config, None, 0.002)
        self._data = mujoco.MjData(self._model)

    def torque(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, trunk: np.ndarray) -> np.ndarray:
        """Return the torques (12,), N m, that move the legs so.

        Args:
            q: (12,) angles, rad.
            qd: (12,) rad/s.
            qdd: (12,) rad/s2.
            trunk: (9,) specific force at its origin, m/s2, angular acceleration, rad/s2, and angular velocity, rad/s,
                in its own axes.
        """
        data, joints = self._data, slice(-robot.NUM_JOINTS, None)
        data.qpos[:3], data.qpos[3:7] = 0.0, (1.0, 0.0, 0.0, 0.0)
        data.qvel[:3], data.qvel[3:6] = 0.0, trunk[6:]
        data.qacc[:3], data.qacc[3:6] = trunk[:3] + self._model.opt.gravity, trunk[3:6]
        data.qpos[joints], data.qvel[joints], data.qacc[joints] = q, qd, qdd
        mujoco.mj_inverse(self._model, data)
        return np.array(data.qfrc_inverse[joints])
