"""Kinematics of the legs in the trunk's frame, by MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np

from go1exp import robot
from go1exp.physics.scene import build_model
from go1exp.robot import RobotConfig
from go1exp.terrain import TerrainConfig, build_terrain


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
