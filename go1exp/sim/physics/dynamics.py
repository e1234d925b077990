"""Kinematics and inverse dynamics of one robot, and quadratic programs within bounds, by MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np

from go1exp import robot
from go1exp.robot.config import RobotConfig
from go1exp.sim.physics.scene import build_model, load_robot
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
        self._sites = [model.site(name).id for name in robot.FEET]
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


def joint_torques(
    config: RobotConfig, base_quat: tuple[float, float, float, float], q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Return M(q) qdd + c(q, qd) + g(q) of a robot with a fixed trunk: torque of actuator and friction together.

    Args:
        config: the robot; its damping and dry friction are the model's own, so that they are not in the result.
        base_quat: attitude of the trunk, w-x-y-z.
        q: joint angles (T, 12), rad.
        qd: joint velocities (T, 12), rad/s.
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
        self._sites = [model.site(name).id for name in robot.FEET]
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


def box_minimum(matrix: np.ndarray, slope: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the minimum (n,) of x' A x / 2 + slope' x within bounds (``mju_boxQP``, a projected Newton method).

    Args:
        matrix: A (n, n), positive definite.
        slope: at x = 0 (n,).
        low: bounds (n,), below ``high`` each.
        high: bounds (n,).

    Raises:
        LinAlgError: if there is none.
    """
    size = len(slope)
    x, factor, free = np.zeros(size).clip(low, high), np.zeros((size, size + 7)), np.zeros(size, dtype=np.int32)
    if size and mujoco.mju_boxQP(x, factor, free, matrix, slope, low, high) < 0:
        raise np.linalg.LinAlgError("MuJoCo found no minimum within bounds")
    return x
