"""The robot's own model of itself, in MuJoCo: where its feet are and what its joints need."""

from __future__ import annotations

import mujoco
import numpy as np

from go1exp import robot
from go1exp.sim.physics.model import load_robot

BASE = 6
"""Degrees of freedom of the free trunk, before the joints."""


class Kinematics:
    """One robot's kinematics, all of it from one pass of MuJoCo for each state.

    Attributes:
        mass: kg.
        rotation: (3, 3) of the trunk, live.
        feet: (4, 3) centres of the foot spheres in the world, live, m.
        com: (3,) centre of mass in the world, live, m.
        bias: (12,) joint torques that balance gravity and velocities of the legs, live, N m.
        jacobians: (4, 3, 3) of each foot by the joints of its leg, world frame, m/rad.
    """

    def __init__(self, inertia: str = "merged") -> None:
        """Compile the robot (``RobotConfig.inertia``) without any ground."""
        self._model = model = load_robot(inertia).compile()
        self._data = data = mujoco.MjData(model)
        self._sites = [model.site(f"{leg}_foot").id for leg in robot.LEGS]
        joints = np.array([model.joint(name).id for name in robot.JOINTS])
        trunk = model.body("trunk").id
        assert list(model.jnt_dofadr[joints]) == list(range(BASE, BASE + robot.NUM_JOINTS))
        self.mass = float(model.body_subtreemass[trunk])
        self.rotation = data.xmat[trunk].reshape(3, 3)
        self.com = data.subtree_com[trunk]
        self._bias = np.zeros(model.nv)
        self.bias = self._bias[BASE:]
        self._whole = np.zeros((3, model.nv))
        self.feet, self.jacobians = np.zeros((robot.NUM_LEGS, 3)), np.zeros((robot.NUM_LEGS, 3, 3))

    def update(
        self,
        position: np.ndarray,
        quat: np.ndarray,
        q: np.ndarray,
        velocity: np.ndarray,
        gyro: np.ndarray,
        qd: np.ndarray,
    ) -> None:
        """Take a state: trunk's place m, attitude w-x-y-z, angles rad, velocities m/s (world), rad/s (trunk), rad/s."""
        model, data = self._model, self._data
        data.qpos[:3], data.qpos[3:7], data.qpos[7:] = position, quat, q
        data.qvel[:3], data.qvel[3:6], data.qvel[6:] = velocity, gyro, qd
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 0, self._bias)
        for leg, site in enumerate(self._sites):
            self.feet[leg] = data.site_xpos[site]
            mujoco.mj_jacSite(model, data, self._whole, None, site)
            first = BASE + 3 * leg
            self.jacobians[leg] = self._whole[:, first : first + 3]

    def composite_inertia(self) -> np.ndarray:
        """Return the robot's inertia (3, 3) in its nominal stance, about its COM, trunk frame; changes the state."""
        model, data = self._model, self._data
        level, still = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
        self.update(still, level, robot.NOMINAL_STANCE, still, still, np.zeros(robot.NUM_JOINTS))
        mujoco.mj_crb(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        c = self.com - data.qpos[:3]
        return np.asarray(full[3:6, 3:6] - self.mass * (c @ c * np.eye(3) - np.outer(c, c)))
