"""Robot + ground + sensors -> one compiled MuJoCo model, the same for every backend.

Whatever the MDP needs beyond qpos and qvel is a sensor declared here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from go1exp import robot
from go1exp.base.paths import data_root
from go1exp.config.schema.physics import MUJOCO_CONTACT, ContactConfig
from go1exp.robot import MOUNT_HINGES, MOUNT_SLIDES
from go1exp.robot.config import RobotConfig
from go1exp.sim.terrain import Terrain

FLOOR = "floor"
"""Name of the geom, its asset and its material."""

FRICTION = (1.0, 0.005, 0.0001)
"""Sliding (-), torsional (m), rolling (m) friction of the ground; the last two are MuJoCo's defaults."""

BASE_THICKNESS = 0.1
"""Solid ground below the lowest sample of a height field, m."""

VIEW_EXTENT = 2.0
"""Length that MuJoCo's viewers scale by, m: about a robot, whatever the size of the field."""


def add_to_spec(spec: mujoco.MjSpec, terrain: Terrain) -> mujoco.MjsGeom:
    """Add the ground, its look and a sun to `spec`, and return the geom.

    The geom offers contacts and accepts none (contype 1, conaffinity 0): a body that is to touch it has conaffinity 1.
    Its surface has the world heights of `terrain`: exactly, up to float64 rounding. It also fixes the visual extent and
    centre of the model, which MuJoCo would take from the whole field and clip everything near the camera.
    """
    floor = spec.worldbody.add_geom(
        name=FLOOR, contype=1, conaffinity=0, condim=3, friction=list(FRICTION), material=FLOOR, group=0
    )
    floor.castshadow = False  # it would only speckle itself, and every triangle would be drawn twice
    flat = terrain.config.kind == "flat"
    spec.add_texture(
        name=FLOOR,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.34, 0.38, 0.42] if flat else [0.52, 0.50, 0.45],
        rgb2=[0.28, 0.32, 0.36] if flat else [0.47, 0.45, 0.40],
        markrgb=[0.5, 0.54, 0.58] if flat else [0.38, 0.36, 0.32],  # lines show the edges of steps, too
        width=300,
        height=300,
    )
    material = spec.add_material(name=FLOOR, specular=0.1, shininess=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = FLOOR
    material.texrepeat = [2.0, 2.0]  # with texuniform: per metre, so a square has an edge of 0.5 m
    material.texuniform = True
    if flat:
        floor.type = mujoco.mjtGeom.mjGEOM_PLANE
        floor.size = [0.0, 0.0, 0.05]
    else:
        low, high = float(terrain.heights.min()), float(terrain.heights.max())
        span = high - low if high > low else 1.0
        x_min, x_max, y_min, y_max = terrain.extent
        spec.add_hfield(
            name=FLOOR,
            nrow=terrain.heights.shape[0],
            ncol=terrain.heights.shape[1],
            size=[0.5 * (x_max - x_min), 0.5 * (y_max - y_min), span, BASE_THICKNESS],
            userdata=((terrain.heights - low) / span).astype(np.float32).ravel(),
        )
        floor.type = mujoco.mjtGeom.mjGEOM_HFIELD
        floor.hfieldname = FLOOR
        floor.pos = [0.5 * (x_min + x_max), 0.5 * (y_min + y_max), low]
    _add_sun(spec)
    spec.stat.extent = VIEW_EXTENT
    spec.stat.center = [0.0, 0.0, 0.3]
    spec.visual.map.zfar = 150.0  # in extents: a whole field is in view
    return floor


def _add_sun(spec: mujoco.MjSpec) -> None:
    """Add a directional light above the first body, and a sky.

    The light travels with the body because MuJoCo draws shadows only within a few extents of the light's own axis.
    """
    direction = np.array([0.4, 0.3, -0.85])
    body = spec.worldbody.first_body()
    (body or spec.worldbody).add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM if body else mujoco.mjtCamLight.mjCAMLIGHT_FIXED,
        pos=(-4.0 * direction).tolist(),
        dir=direction.tolist(),
        diffuse=[0.7, 0.7, 0.7],
        specular=[0.2, 0.2, 0.2],
        castshadow=True,
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.72, 0.82],
        rgb2=[0.22, 0.30, 0.40],
        width=128,
        height=768,
    )
    spec.visual.rgba.haze = [0.42, 0.51, 0.61, 1.0]  # the sky at the horizon


TRUNK_WITH_HIP_ROTORS = {
    "mass": 5.560,
    "ipos": [0.020872158, 0.001871942, -0.000467986],
    "fullinertia": [0.0180397001, 0.0678915698, 0.0773160421, -2.44537877e-4, -2.90814056e-4, -4.15398942e-5],
}
"""Trunk plus the four hip rotors that turn inside it, trunk frame: mass, kg; COM, m; inertia about the COM as xx, yy,
zz, xy, xz, yz, kg m2.

Computed from the vendor URDF: trunk 5.204 kg and four rotors of 0.089 kg at (+-0.11215, +-0.04675, 0), 1.11842e-4 about
their x axis and 5.9647e-5 across it. Its IMU, camera and ultrasound links (1.08 g together) are left out.
"""

INERTIA_VARIANTS = ("merged", "rotor_complete")


def load_robot(inertia: str = "merged") -> mujoco.MjSpec:
    """Load ``assets/go1/go1.xml``: the robot alone, without floor, lights or sensors.

    Args:
        inertia: ``merged`` (12.743 kg) omits the hip rotors, as MuJoCo Menagerie and its descendants do;
            ``rotor_complete`` (13.099 kg) adds them to the trunk, as the vendor URDF does.
    """
    if inertia not in INERTIA_VARIANTS:
        raise ValueError(f"inertia {inertia!r} is none of {', '.join(INERTIA_VARIANTS)}")
    spec = mujoco.MjSpec.from_file(str(data_root() / "assets/go1/go1.xml"))
    if inertia == "rotor_complete":
        trunk = spec.body("trunk")
        for field, value in TRUNK_WITH_HIP_ROTORS.items():
            setattr(trunk, field, value)
    return spec


@cache
def _shaped(inertia: str, touches: bool, decoration: bool) -> mujoco.MjSpec:
    """Return the robot with the shapes that a scene needs, to be copied: to delete the others takes the longest."""
    spec = load_robot(inertia)
    for geom in list(spec.geoms):
        if not touches or (geom.group == DECORATION_GROUP and not decoration):
            spec.delete(geom)
    return spec


def add_mount(trunk: mujoco.MjsBody) -> None:
    """Let a held trunk move: three slides and two hinges, none of which has a spring or a damper yet.

    The slides are along the axes of the world, the hinges about those of the trunk.

    Args:
        trunk: body of the trunk, a child of the world, with its attitude set and without joints.
    """
    back = Rotation.from_quat(trunk.quat, scalar_first=True).inv().as_matrix()
    slides = [(name, mujoco.mjtJoint.mjJNT_SLIDE, back[:, k]) for k, name in enumerate(MOUNT_SLIDES)]
    hinges = [(name, mujoco.mjtJoint.mjJNT_HINGE, np.eye(3)[k]) for k, name in enumerate(MOUNT_HINGES)]
    for name, kind, axis in (*slides, *hinges):
        joint = trunk.add_joint()
        joint.name, joint.type, joint.axis = name, kind, list(axis)


DECORATION_GROUP = 2
"""Geom group of the visual shapes; they cost kinematics and are left out of training."""

HELD_HEIGHT = 1.0
"""Height at which a held trunk hangs, m: no foot reaches the ground."""

RIGID = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""MuJoCo's impedance of dry friction; its default of 0.9 to 0.95 lets a joint creep."""

CONTACT_LINKS = (
    *(f"{leg}_{part}" for part in ("thigh", "calf") for leg in robot.LEGS),
    *("trunk", *(f"{leg}_hip" for leg in robot.LEGS)),
)
"""Links whose contacts are counted, in the order of ``Sensors.link_contacts``."""

_DATA_FOUND = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)
_DATA_FORCE = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
_REDUCE_NONE, _REDUCE_NETFORCE = 0, 3


@dataclass(frozen=True)
class Sensors:
    """Where each quantity lies in ``sensordata``: contiguous blocks, so that reading one is a view, not a copy.

    Legs in the order of ``robot.LEGS``.
    """

    foot_pos_w: slice
    """4 x 3: centre of the foot spheres, m."""
    foot_vel_w: slice
    """4 x 3: their velocity, m/s."""
    foot_contact: slice
    """4 x 4: number of contacts of the foot sphere with the ground, then the ground's net force on it (world), N."""
    link_contacts: slice
    """13: number of contacts of thighs (4), calves with their feet (4), trunk with head (1), hips (4)."""
    imu_gyro: slice
    """3: angular velocity in the IMU's frame, rad/s; empty, like the next two, unless asked for."""
    imu_acc: slice
    """3: specific force in the IMU's frame, m/s2."""
    imu_quat: slice
    """4: orientation of the IMU in the world, w-x-y-z."""


NO_SENSORS = Sensors(*[slice(0, 0)] * 7)
"""Blocks of a model without any."""


def build_model(
    config: RobotConfig,
    terrain: Terrain | None,
    physics_dt: float,
    decoration: bool = False,
    *,
    contact: ContactConfig = MUJOCO_CONTACT,
    imu: bool = False,
    held: tuple[float, float, float, float] | None = None,
    mounted: bool = False,
) -> tuple[mujoco.MjModel, Sensors]:
    """Compile the scene.

    Args:
        config: which Go1.
        terrain: the ground, which touches every collision shape of the robot; None for a robot that touches nothing and
            is nowhere seen: without shapes, sites and sensors a step is a twentieth shorter.
        physics_dt: timestep, s.
        decoration: keep the visual shapes (they change no trajectory).
        contact: of the feet with the ground.
        imu: add the IMU's sensors (they cost time and a policy does not need them).
        held: orientation w-x-y-z in which the trunk is held in the air, as on a stand; None lets it go. A held robot's
            state is its joints' alone.
        mounted: the held trunk has the joints of ``sim/physics/scene.py``, whose state stands before that of the legs.
    """
    spec = _shaped(config.inertia, terrain is not None, decoration).copy()
    if held is not None:
        spec.delete(spec.joint("root"))
        for key in list(spec.keys):  # their state has a free trunk
            spec.delete(key)
        spec.body("trunk").pos, spec.body("trunk").quat = [0.0, 0.0, HELD_HEIGHT], list(held)
        if mounted:
            add_mount(spec.body("trunk"))
    spec.option.timestep = physics_dt
    # A fault must be seen, not healed: MuJoCo would otherwise reset a robot whose state is not finite.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # One robot is one island: looking for more costs a tenth of the step and changes nothing.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    # Torques are computed outside, so nothing but joint damping could be implicit, and Euler treats that so as well.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for kind, name in enumerate(robot.JOINT_KINDS):
        for leg in robot.LEGS:
            joint = spec.joint(f"{leg}_{name}")
            joint.armature = config.armature[kind]
            joint.damping[0] = config.damping[kind]
            joint.frictionloss = config.friction_loss[kind]
            # Dry friction is as rigid as a step allows: it stops a joint within one (see docs/notebook/actuators.md).
            joint.solref_friction, joint.solimp_friction = [2.0 * physics_dt, 1.0], list(RIGID)
            motor = spec.actuator(f"{leg}_{name}")
            motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            motor.forcerange = [-config.effort_limit[kind], config.effort_limit[kind]]
    if terrain is None:
        for part in (*spec.sites, *spec.lights, *spec.cameras):
            spec.delete(part)
        return spec.compile(), NO_SENSORS
    add_to_spec(spec, terrain)
    _set_contact(spec, contact)
    sensors = _add_sensors(spec, imu)
    return spec.compile(), sensors


def weigh_down(model: mujoco.MjModel, heavy: float) -> None:
    """Make a trunk so heavy that legs do not move it: a mass, kg, and moments of inertia about its origin, kg m2."""
    trunk = model.body("trunk").id
    model.body_mass[trunk], model.body_inertia[trunk] = heavy, heavy
    model.body_ipos[trunk], model.body_iquat[trunk] = 0.0, (1.0, 0.0, 0.0, 0.0)
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _set_contact(spec: mujoco.MjSpec, contact: ContactConfig) -> None:
    """Give the feet their contact: they have priority over the ground, so that what they say holds for the pair."""
    spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{contact.cone.upper()}")
    spec.option.impratio = contact.impratio
    for name in robot.FEET:
        spec.geom(name).solref[0] = contact.time_constant


def _add_sensors(spec: mujoco.MjSpec, imu: bool) -> Sensors:
    """Declare the sensors, block by block, and return where they will lie."""
    site, geom, body = mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_BODY
    end = 0

    def block(
        targets: list[str], size: int, kind: mujoco.mjtSensor, objtype: mujoco.mjtObj, intprm: list[int]
    ) -> slice:
        nonlocal end
        start = end
        for target in targets:
            name = f"{target}_{kind.name.removeprefix('mjSENS_').lower()}"
            sensor = spec.add_sensor(
                name=name, type=kind, objtype=objtype, objname=target, intprm=[*intprm, 0, 0, 0][:3]
            )
            if objtype == geom:  # the force is the first's on the second
                sensor.objname, sensor.reftype, sensor.refname = FLOOR, geom, target
            end += size
        return slice(start, end)

    feet = list(robot.FEET)
    contact, on_imu = mujoco.mjtSensor.mjSENS_CONTACT, ["imu"] if imu else []
    return Sensors(
        foot_pos_w=block(feet, 3, mujoco.mjtSensor.mjSENS_FRAMEPOS, site, []),
        foot_vel_w=block(feet, 3, mujoco.mjtSensor.mjSENS_FRAMELINVEL, site, []),
        foot_contact=block(feet, 4, contact, geom, [_DATA_FOUND | _DATA_FORCE, _REDUCE_NETFORCE, 1]),
        link_contacts=block(list(CONTACT_LINKS), 1, contact, body, [_DATA_FOUND, _REDUCE_NONE, 1]),
        imu_gyro=block(on_imu, 3, mujoco.mjtSensor.mjSENS_GYRO, site, []),
        imu_acc=block(on_imu, 3, mujoco.mjtSensor.mjSENS_ACCELEROMETER, site, []),
        imu_quat=block(on_imu, 4, mujoco.mjtSensor.mjSENS_FRAMEQUAT, site, []),
    )
