"""Contact readings of PhysX, laid out as MuJoCo's contact sensors (``go1exp.sim.physics.scene.Sensors``).

PhysX gives the normal impulse of each contact point in the step, and no friction. Friction under a foot follows from
the equation of motion: the torque of its leg's joints that nothing else explains is J^T f of the foot.
The part of that f along the ground counts, as far as the friction coefficient allows with the normal force of PhysX.
Where another link of the leg touches too, or dry friction or a stop acts on a joint, that part is of all of them.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from go1exp import robot
from go1exp.sim.physics.physx_robot import pair_friction
from go1exp.sim.physics.scene import CONTACT_LINKS, FLOOR

ROUNDING = 1e-4
"""Depth of a contact, m, beyond which it is one although it bears nothing: its body is pushed out at another point."""


class Contacts:
    """Contact readings of N robots.

    Attributes:
        body_points: (N, bodies) contact points that bear load or lie below the ground, by MuJoCo's body.
        foot_points: (N, 4) those of the feet's spheres.
        foot_force: (N, 4, 3) normal force of the ground on them, world, N.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int) -> None:
        """Prepare for N robots of one model."""
        self.body_points = np.zeros((num_envs, model.nbody))
        self.foot_points = np.zeros((num_envs, robot.NUM_LEGS))
        self.foot_force = np.zeros((num_envs, robot.NUM_LEGS, 3))
        self._floor, self._body, self._dt = model.geom(FLOOR).id, model.geom_bodyid.tolist(), model.opt.timestep
        self._foot = {model.geom(name).id: k for k, name in enumerate(robot.FEET)}
        self._links = [model.body(name).id for name in CONTACT_LINKS]

    def read(self, env: int, contacts: list[Any], shapes: dict[Any, int]) -> None:
        """Take in the contacts of one robot's last step; ``shapes`` gives the geom of each collision shape."""
        self.body_points[env] = self.foot_points[env] = self.foot_force[env] = 0.0
        for contact in contacts:
            count, total = 0, [0.0, 0.0, 0.0]
            for point in contact.points:  # plain numbers: arrays of three would take most of the time of a step
                impulse = point.impulse.tolist()
                if any(impulse) or point.separation < -ROUNDING:
                    count += 1
                    total = [a + b for a, b in zip(total, impulse, strict=True)]
            if count:
                first, second = (shapes[shape] for shape in contact.shapes)
                self._add(env, first, second, count, total)

    def _add(self, env: int, first: int, second: int, count: int, impulse: list[float]) -> None:
        geom, sign = (second, -1.0) if first == self._floor else (first, 1.0)
        self.body_points[env, self._body[geom]] += count
        if (leg := self._foot.get(geom)) is not None:
            self.foot_points[env, leg] += count
            self.foot_force[env, leg] += np.multiply(impulse, sign / self._dt)

    @property
    def links(self) -> np.ndarray:
        """(N, 13) in the order of ``Sensors.link_contacts``."""
        return self.body_points[:, self._links]


class FootFriction:
    """Forces along the ground on the feet, from the equation of motion."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """Prepare for robots of one model."""
        rows = np.repeat(np.arange(model.nv), model.M_rownnz)
        self._place = rows, np.asarray(model.M_colind)
        self._nv = model.nv
        feet = [model.geom(name).id for name in robot.FEET]
        self._feet, self._model = feet, model
        self._radius = model.geom_size[feet, 0]
        joints = [model.joint(f"{leg}_{kind}").id for leg in robot.LEGS for kind in robot.JOINT_KINDS]
        self._joints = np.array(joints)
        self._dofs = model.jnt_dofadr[self._joints].reshape(robot.NUM_LEGS, -1)

    def excess(self, mass: np.ndarray, acceleration: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Return the generalised forces (N, nv) that are left: M a minus all that is known.

        Args:
            mass: MuJoCo's sparse lower triangle of M (N, nC).
            acceleration: change of qvel over the step (N, nv).
            known: actuators, gravity, inertia and applied forces, MuJoCo's ``qfrc_smooth`` (N, nv).
        """
        row, column = self._place
        dense = np.zeros((len(mass), self._nv, self._nv))
        dense[:, row, column] = dense[:, column, row] = mass
        return (dense @ acceleration[..., None])[..., 0] - known

    def __call__(
        self, left: np.ndarray, anchors: np.ndarray, axes: np.ndarray, feet: np.ndarray, normal: np.ndarray,
        friction: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Return the forces along the ground (N, 4, 3), world, N.

        Args:
            left: generalised forces of ``excess`` (N, nv).
            anchors: points on the joints' axes (N, joints, 3), world, m.
            axes: directions of the joints' axes (N, joints, 3), world.
            feet: centres of the feet's spheres (N, 4, 3), world, m.
            normal: forces of the ground on the feet along its normals (N, 4, 3), world, N.
            friction: each robot's ``geom_friction`` (N, geoms, 3).
        """
        size = np.linalg.norm(normal, axis=-1, keepdims=True)
        up = normal / np.maximum(size, 1e-9)
        points = feet - self._radius[:, None] * up
        shape = (len(left), robot.NUM_LEGS, -1, 3)
        arms = points[:, :, None] - anchors[:, self._joints].reshape(shape)
        rows = np.cross(axes[:, self._joints].reshape(shape), arms)  # J^T of each leg
        force = np.linalg.solve(rows + 1e-9 * np.eye(3), left[:, self._dofs][..., None])[..., 0]  # never singular
        along = force - (force * up).sum(-1, keepdims=True) * up
        coefficients = [pair_friction(self._model, g, friction) for g in self._feet]
        bound = np.stack(coefficients, axis=-1)[..., None] * size
        return along * np.minimum(1.0, bound / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9))
