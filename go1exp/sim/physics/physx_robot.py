"""One robot in PhysX 5, built from a compiled MuJoCo model, and its ground.

Link frames are MuJoCo's body frames. What a PhysX link has by default and a MuJoCo body has not is switched off:
damping of its motion, friction of its joints (0.05), sleep, and limits of its speed that a fall would reach.

Friction. PhysX takes the mean of the two materials' coefficients. The ground has 0 and each shape twice the
coefficient that MuJoCo would give the pair, so the mean is MuJoCo's. Restitution is 0.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from go1exp.config.schema.physics import PhysxBackend
from go1exp.config.schema.registry import Expected
from go1exp.sim.physics.scene import FLOOR

try:
    with warnings.catch_warnings():  # that it brings its own Vulkan, which nothing here uses
        warnings.simplefilter("ignore")
        import sapien
        from sapien import physx
except ImportError as error:
    raise Expected(
        f"engine=physx needs the package sapien ({error}): pip install 'go1exp[physx]', or use engine=mujoco"
    ) from error

FAST = 1000.0
"""Limit of the speeds of links and joints, m/s and rad/s, that no robot reaches; sapien's are 10, 50 and 100."""

HOLD = 1000.0
"""N m s/rad: damping of the drive that is dry friction; its torque is cut at the friction's bound."""

FLOOR_GROUPS, ROBOT_GROUPS = [1, 0, 0, 0], [0, 1, 0, 0]
"""Collision groups as MuJoCo's contype and conaffinity: shapes of robots meet the ground and never each other."""

X_TO_Z = Rotation.from_quat([np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0], scalar_first=True)
"""Turns the x axis, along which PhysX has its planes' normals, capsules and joints, to z."""


def quat(rotation: Rotation) -> np.ndarray:
    """Return a rotation as w-x-y-z."""
    return rotation.as_quat(scalar_first=True)


def rotation(w_x_y_z: np.ndarray) -> Rotation:
    """Return the rotation of a quaternion w-x-y-z."""
    return Rotation.from_quat(w_x_y_z, scalar_first=True)


def pose(position: ArrayLike, w_x_y_z: ArrayLike) -> sapien.Pose:
    """Return a pose in PhysX's single precision."""
    return sapien.Pose(np.asarray(position, dtype=np.float32), np.asarray(w_x_y_z, dtype=np.float32))


def ground_shape(model: mujoco.MjModel, settings: PhysxBackend) -> physx.PhysxCollisionShape:
    """Return the ground as one shape that all robots' systems share: a plane, or a height field's triangles.

    A cell of the field is split along the diagonal along which MuJoCo splits it (``go1exp.sim.terrain.Terrain``).

    Raises:
        Expected: if the floor is something else.
    """
    floor, smooth = model.geom(FLOOR), physx.PhysxMaterial(0.0, 0.0, 0.0)
    if floor.type == mujoco.mjtGeom.mjGEOM_PLANE:
        shape = physx.PhysxCollisionShapePlane(smooth)
        shape.local_pose = pose(floor.pos, quat(rotation(floor.quat) * X_TO_Z))
    elif floor.type == mujoco.mjtGeom.mjGEOM_HFIELD:
        shape = physx.PhysxCollisionShapeTriangleMesh(*triangles(model, int(floor.dataid[0])), [1.0, 1.0, 1.0], smooth)
        shape.local_pose = pose(floor.pos, floor.quat)
    else:
        raise Expected(f"engine=physx: the geom {FLOOR!r} is neither a plane nor a height field")
    return _meeting(shape, FLOOR_GROUPS, settings)


def _meeting(shape: physx.PhysxCollisionShape, groups: list[int], settings: PhysxBackend) -> physx.PhysxCollisionShape:
    """Return a shape that meets what it is to meet, at no distance."""
    shape.set_collision_groups(groups)
    shape.contact_offset, shape.rest_offset = settings.contact_offset, 0.0
    return shape


def triangles(model: mujoco.MjModel, field: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a height field's vertices (V, 3), m, and triangles (T, 3), counter-clockwise from above."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    half_x, half_y, span, _ = model.hfield_size[field]
    start = model.hfield_adr[field]
    heights = span * model.hfield_data[start : start + rows * columns].reshape(rows, columns)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    vertices = np.stack([x, y, heights], axis=-1).reshape(-1, 3).astype(np.float32)
    index = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    low, right, high, far = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    corners = [np.stack(c, axis=-1).reshape(-1, 3) for c in ((low, right, high), (low, high, far))]
    return vertices, np.concatenate(corners)


class PhysxRobot:
    """One robot alone with the ground in a PhysX system of its own, so that robots in one place cost nothing.

    Attributes:
        system: steps it.
        articulation: the tree of links.
        links: in the order of MuJoCo's bodies, the world left out.
        joints: in the order of MuJoCo's joints.
        shapes: collision shape -> MuJoCo geom; that of the ground too.
        order: for each joint of MuJoCo the place that PhysX gives it.
    """

    def __init__(self, model: mujoco.MjModel, settings: PhysxBackend, ground: physx.PhysxCollisionShape) -> None:
        """Build it.

        Raises:
            Expected: if the model has joints or shapes other than a Go1's.
        """
        self._model, self._settings = model, settings
        self.shapes = {ground: model.geom(FLOOR).id}
        physx.set_scene_config(gravity=model.opt.gravity, enable_tgs=settings.solver == "tgs")
        physx.set_body_config(settings.position_iterations, settings.velocity_iterations, sleep_threshold=0.0)
        self.system = physx.PhysxCpuSystem()
        self.system.timestep = model.opt.timestep
        self._scene = sapien.Scene([self.system])
        floor = physx.PhysxRigidStaticComponent()
        floor.attach(ground)
        self._materials: dict[int, physx.PhysxMaterial] = {}
        self.links: list[physx.PhysxArticulationLinkComponent] = []
        for body in range(1, model.nbody):
            self.links.append(self._link(body))
        for component in (floor, *self.links):
            entity = sapien.Entity()
            entity.add_component(component)
            self._scene.add_entity(entity)
        self.articulation = self.links[0].articulation
        self.articulation.set_root_pose(pose(model.body_pos[1], model.body_quat[1]))  # where a held one stays
        hinges = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
        self.joints = [self.links[model.jnt_bodyid[j] - 1].joint for j in hinges]
        names = [joint.name for joint in self.articulation.get_active_joints()]
        self.order = np.array([names.index(model.joint(j).name) for j in hinges])

    # ------------------------------------------------------------------ construction

    def _link(self, body: int) -> physx.PhysxArticulationLinkComponent:
        model, parent = self._model, int(self._model.body_parentid[body])
        link = physx.PhysxArticulationLinkComponent(self.links[parent - 1] if parent else None)
        link.name = model.body(body).name
        link.mass, link.inertia = model.body_mass[body], model.body_inertia[body]
        link.cmass_local_pose = pose(model.body_ipos[body], model.body_iquat[body])
        link.linear_damping = link.angular_damping = 0.0
        link.max_linear_velocity = link.max_angular_velocity = FAST
        first = int(model.body_geomadr[body])
        for geom in range(first, first + int(model.body_geomnum[body])):
            if model.geom_conaffinity[geom] or model.geom_contype[geom]:
                link.attach(self._shape(geom))
        joints = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        kinds = [int(model.jnt_type[j]) for j in joints]
        if not parent:
            if kinds not in ([], [int(mujoco.mjtJoint.mjJNT_FREE)]):
                raise Expected(f"engine=physx: {link.name} must be free or held")
            link.joint.type = "undefined" if kinds else "fixed"
            return link
        if kinds != [int(mujoco.mjtJoint.mjJNT_HINGE)]:
            raise Expected(f"engine=physx: {link.name} must turn about one axis")
        self._hinge(link.joint, body, joints[0])
        return link

    def _hinge(self, hinge: physx.PhysxArticulationJoint, body: int, joint: int) -> None:
        """Make a link's joint, whose axis PhysX has along the x axis of the joint's frame."""
        model, axis = self._model, self._model.jnt_axis[joint]
        z_to_axis = np.zeros(4)
        mujoco.mju_quatZ2Vec(z_to_axis, axis)
        turned = rotation(z_to_axis) * X_TO_Z
        hinge.type, hinge.name = "revolute", model.joint(joint).name
        frame = rotation(model.body_quat[body])
        hinge.pose_in_child = pose(model.jnt_pos[joint], quat(turned))
        hinge.pose_in_parent = pose(model.body_pos[body] + frame.apply(model.jnt_pos[joint]), quat(frame * turned))
        limited = bool(model.jnt_limited[joint])
        hinge.set_limits(model.jnt_range[[joint]] if limited else np.array([[-np.inf, np.inf]]))
        hinge.friction, hinge.max_velocity = 0.0, FAST
        dof = model.jnt_dofadr[joint]
        hinge.set_armature(model.dof_armature[[dof]])
        hinge.set_drive_properties(0.0, *dry_friction(float(model.dof_frictionloss[dof])))

    def _shape(self, geom: int) -> physx.PhysxCollisionShape:
        model, size = self._model, self._model.geom_size[geom]
        mu = 2.0 * float(pair_friction(model, geom, model.geom_friction))
        material, turned = physx.PhysxMaterial(mu, mu, 0.0), rotation(model.geom_quat[geom])
        kind = mujoco.mjtGeom(model.geom_type[geom])
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            shape = physx.PhysxCollisionShapeSphere(size[0], material)
        elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            shape, turned = physx.PhysxCollisionShapeCapsule(size[0], size[1], material), turned * X_TO_Z
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            shape = physx.PhysxCollisionShapeBox(size, material)
        else:
            raise Expected(f"engine=physx: the geom {model.geom(geom).name!r} is no sphere, capsule or box")
        shape.local_pose = pose(model.geom_pos[geom], quat(turned))
        self.shapes[shape], self._materials[geom] = geom, material
        return _meeting(shape, ROBOT_GROUPS, self._settings)

    # ------------------------------------------------------------------ its own model

    def set_field(self, name: str, values: np.ndarray) -> None:
        """Put one robot's values (...) of a field of ``APPLIED`` into force."""
        APPLIED[name](self, values)

    def _set_masses(self, values: np.ndarray) -> None:
        for link, mass in zip(self.links, values[1:], strict=True):
            link.mass = mass

    def _set_inertias(self, values: np.ndarray) -> None:
        for link, moments in zip(self.links, values[1:], strict=True):
            link.inertia = moments

    def _set_centres(self, values: np.ndarray) -> None:
        for link, centre in zip(self.links, values[1:], strict=True):
            link.cmass_local_pose = pose(centre, link.cmass_local_pose.q)

    def _set_axes(self, values: np.ndarray) -> None:
        for link, axes in zip(self.links, values[1:], strict=True):
            link.cmass_local_pose = pose(link.cmass_local_pose.p, axes)

    def _set_friction(self, values: np.ndarray) -> None:
        for geom, material in self._materials.items():
            mu = 2.0 * float(pair_friction(self._model, geom, values))
            material.static_friction = material.dynamic_friction = mu

    def _set_armature(self, values: np.ndarray) -> None:
        for joint, inertia in zip(self.joints, values[-len(self.joints) :], strict=True):
            joint.set_armature([inertia])

    def _set_dry_friction(self, values: np.ndarray) -> None:
        for joint, bound in zip(self.joints, values[-len(self.joints) :], strict=True):
            joint.set_drive_properties(0.0, *dry_friction(float(bound)))

    # ------------------------------------------------------------------ state

    def put(self, root: np.ndarray | None, joints: np.ndarray) -> None:
        """Set the state.

        Args:
            root: position, quaternion w-x-y-z, velocity of the root's centre of mass, angular velocity, all in the
                world (13,); None for a held one.
            joints: angles, then speeds (2, J), in MuJoCo's order.
        """
        if root is not None:
            self.articulation.set_root_pose(pose(root[:3], root[3:7]))
            self.articulation.set_root_linear_velocity(root[7:10].astype(np.float32))
            self.articulation.set_root_angular_velocity(root[10:13].astype(np.float32))
        given = np.empty_like(joints)
        given[:, self.order] = joints
        self.articulation.set_qpos(given[0])
        self.articulation.set_qvel(given[1])

    def read(self) -> np.ndarray:
        """Return its state (13 + 2 J,) as PhysX keeps it.

        The root's quaternion, position, velocity of its centre of mass, angular velocity; then angles and speeds of
        the joints in PhysX's order.
        """
        return np.frombuffer(self.system.pack(), dtype=np.float32, count=13 + 2 * len(self.joints))


def dry_friction(bound: float) -> tuple[float, float]:
    """Return damping and torque limit of the drive that holds a joint still with up to ``bound`` N m."""
    return (HOLD if bound > 0.0 else 0.0), bound


def pair_friction(model: mujoco.MjModel, geom: int, friction: np.ndarray) -> np.ndarray:
    """Return a geom's sliding friction with the ground by MuJoCo's rule: the higher priority's, else the larger.

    Args:
        model: whose priorities count.
        geom: the geom.
        friction: ``geom_friction`` of any number of robots (..., geoms, 3); the answer has the shape (...).
    """
    floor = model.geom(FLOOR).id
    first, second = model.geom_priority[geom], model.geom_priority[floor]
    of_geom, of_floor = friction[..., geom, 0], friction[..., floor, 0]
    return np.maximum(of_geom, of_floor) if first == second else (of_geom if first > second else of_floor)


APPLIED: dict[str, Callable[[PhysxRobot, np.ndarray], None]] = {
    "body_mass": PhysxRobot._set_masses,
    "body_inertia": PhysxRobot._set_inertias,
    "body_ipos": PhysxRobot._set_centres,
    "body_iquat": PhysxRobot._set_axes,
    "geom_friction": PhysxRobot._set_friction,
    "dof_armature": PhysxRobot._set_armature,
    "dof_frictionloss": PhysxRobot._set_dry_friction,
}
"""Model fields that may differ between robots, and how PhysX takes them."""
