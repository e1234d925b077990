"""The robot model against figures computed independently from the vendor URDF (unitree_ros, go1.urdf, 2024-05)."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from go1exp import robot
from go1exp.sim.physics.scene import load_robot

POSES = {
    "isaac_lab": robot.NOMINAL_STANCE,
    "home": np.tile([0.0, 0.9, -1.8], 4),
    "mjlab": np.array([0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2),
}
"""Joint angles (12,), rad: our nominal stance and two stances of published models."""


# ----------------------------------------------------------------------------------------------------------- helpers


@cache
def bare_model(inertia: str = "merged") -> mujoco.MjModel:
    """The robot without armature, so that joint-space inertia is that of the links alone."""
    model = load_robot(inertia).compile()
    model.dof_armature[:] = 0.0
    return model


def at_origin(model: mujoco.MjModel, joints: np.ndarray) -> mujoco.MjData:
    """Data with the trunk frame on the world frame and the joints (12,) in SDK order at rest."""
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[7:] = joints
    mujoco.mj_forward(model, data)
    return data


def feet(joints: np.ndarray) -> np.ndarray:
    """Foot centres (4, 3) in the trunk frame, m, by the compiled model."""
    data = at_origin(bare_model(), joints)
    return np.array([data.site(f"{leg}_foot").xpos for leg in robot.LEGS])


def random_joints(count: int, seed: int = 0) -> np.ndarray:
    """Joint angles (count, 12), uniform within the hard stops."""
    low, high = robot.JOINT_POS_LIMITS.T
    return np.random.default_rng(seed).uniform(low, high, (count, robot.NUM_JOINTS))


def first_touch_height(joints: np.ndarray) -> float:
    """Height of a level trunk over a flat floor at which the first foot touches it, m."""
    return float(robot.FOOT_RADIUS - feet(joints)[:, 2].min())


class Inertial(NamedTuple):
    """Mass in kg, COM (3,) in m and inertia (3, 3) about it in kg m2, in axes parallel to the trunk at q = 0."""

    mass: float
    com: np.ndarray
    inertia: np.ndarray

    def at(self, x: float, y: float, z: float) -> Inertial:
        return self._replace(com=self.com + np.array([x, y, z]))


def inertial(mass: float, com: Iterable[float], six: Iterable[float]) -> Inertial:
    """From the URDF's numbers; ``six`` is xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = six
    return Inertial(mass, np.array(list(com), dtype=float), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))


def combine(parts: Iterable[Inertial]) -> Inertial:
    """Several rigid parts as one (parallel axes)."""
    parts = list(parts)
    mass = sum(part.mass for part in parts)
    com = sum((part.mass * part.com for part in parts), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for part in parts:
        r = part.com - com
        inertia += part.inertia + part.mass * (r @ r * np.eye(3) - np.outer(r, r))
    return Inertial(mass, com, inertia)


def body_inertial(model: mujoco.MjModel, name: str) -> Inertial:
    """What the compiled model holds for one body, in its link frame."""
    body = model.body(name)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, body.iquat)
    axes = rotation.reshape(3, 3)
    return Inertial(float(body.mass[0]), body.ipos.copy(), axes @ np.diag(body.inertia) @ axes.T)


def whole_robot(model: mujoco.MjModel, joints: np.ndarray) -> Inertial:
    """All bodies frozen at the given angles, in the trunk frame."""
    data = at_origin(model, joints)
    bodies = []
    for i in range(1, model.nbody):
        axes = data.ximat[i].reshape(3, 3)
        bodies.append(Inertial(model.body_mass[i], data.xipos[i], axes @ np.diag(model.body_inertia[i]) @ axes.T))
    return combine(bodies)


class Standing(NamedTuple):
    """The robot after standing for a while on a floor."""

    height: float
    pitch_deg: float


@cache
def standing(pose: str, kp: float, kd: float) -> Standing:
    """Hold a pose with PD position actuators on a plane for 8 s, only the feet touching, armature 0.01 kg m2."""
    spec = load_robot()
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], friction=[0.8, 0.005, 1e-4])
    for actuator in spec.actuators:
        actuator.set_to_position(kp=kp, kv=kd)
    for geom in spec.geoms:
        if geom.name != "floor" and not geom.name.endswith("_foot"):
            geom.conaffinity = 0
    model = spec.compile()
    model.dof_armature[6:] = 0.01
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, first_touch_height(POSES[pose]) + 1e-4, 1, 0, 0, 0]
    data.qpos[7:] = data.ctrl[:] = POSES[pose]
    mujoco.mj_step(model, data, nstep=round(8.0 / model.opt.timestep))
    w, x, y, z = data.qpos[3:7]
    pitch = np.degrees(np.arcsin(2 * (w * y - x * z)))
    return Standing(float(data.qpos[2]), float(pitch))


# ------------------------------------------------------------------------------------------------ names, order, sizes


def test_model_has_a_free_trunk_and_twelve_motors() -> None:
    model = bare_model()
    assert (model.nq, model.nv, model.nu) == (19, 18, 12)
    assert model.joint("root").type == mujoco.mjtJoint.mjJNT_FREE
    assert model.nsensor == 0


def test_joints_and_motors_follow_the_sdk_order() -> None:
    model = bare_model()
    assert tuple(model.joint(i).name for i in range(1, model.njnt)) == robot.JOINTS
    assert tuple(model.actuator(i).name for i in range(model.nu)) == robot.JOINTS
    assert [model.joint(model.actuator(i).trnid[0]).name for i in range(model.nu)] == list(robot.JOINTS)
    assert tuple(model.body(i).name for i in range(2, model.nbody)) == robot.JOINTS


def test_model_agrees_with_the_constants_of_robot_py() -> None:
    model = load_robot().compile()
    assert_allclose(model.jnt_range[1:], robot.JOINT_POS_LIMITS, atol=0)
    assert_allclose(model.dof_armature[6:], robot.per_joint(robot.ROTOR_ARMATURE), atol=0)
    assert not model.dof_damping.any()
    assert not model.dof_frictionloss.any()
    stance = model.key("stance").qpos
    assert_allclose(stance[:7], [0, 0, robot.NOMINAL_HEIGHT, 1, 0, 0, 0], atol=0)
    assert_allclose(stance[7:], robot.NOMINAL_STANCE, atol=0)


def test_motors_are_plain_torque_sources_without_limits() -> None:
    model = bare_model()
    assert_allclose(model.actuator_gear[:, 0], 1.0, atol=0)
    assert_allclose(model.actuator_gainprm[:, 0], 1.0, atol=0)
    assert not model.actuator_biasprm.any()
    assert not model.actuator_ctrllimited.any()
    assert not model.actuator_forcelimited.any()
    assert not model.jnt_actfrclimited.any()


def test_simulation_options_are_those_of_the_settling_figures() -> None:
    option = bare_model().opt
    assert option.timestep == 0.002
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL


def test_imu_sits_where_the_urdf_puts_it() -> None:
    imu = bare_model().site("imu")
    assert_allclose(imu.pos, [-0.01592, -0.06659, -0.00617], atol=0)
    assert_allclose(imu.quat, [1, 0, 0, 0], atol=0)


def test_an_unknown_inertia_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="heavy"):
        load_robot("heavy")


# ----------------------------------------------------------------------------------------------------------- contacts


def touching_geoms(model: mujoco.MjModel) -> list[int]:
    return [i for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]]


def test_every_touching_geom_is_named_and_there_are_few() -> None:
    model = bare_model()
    parts = ("hip", "thigh", "thigh_motor", "calf_upper", "calf_lower", "foot")
    expected = {"trunk", "head"} | {f"{leg}_{part}" for leg in robot.LEGS for part in parts}
    assert {model.geom(i).name for i in touching_geoms(model)} == expected


def test_robot_meets_terrain_but_never_itself() -> None:
    model = bare_model()
    touching = touching_geoms(model)
    assert not model.geom_contype[touching].any()
    assert (model.geom_conaffinity[touching] == 1).all()
    for joints in random_joints(20):
        assert at_origin(model, joints).ncon == 0


def test_foot_friction_decides_a_foot_contact() -> None:
    spec = load_robot()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], friction=[2.0, 1.0, 1.0])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[2] = 0.31
    mujoco.mj_forward(model, data)
    touching = {model.geom(int(g)).name for g in data.contact.geom.ravel()} - {""}
    assert touching == {f"{leg}_foot" for leg in robot.LEGS}
    assert_allclose(data.contact.friction, np.tile([0.8, 0.8, 0.02, 0.01, 0.01], (data.ncon, 1)), atol=0)
    assert (data.contact.dim == 3).all()


def test_foot_spheres_sit_on_the_foot_sites() -> None:
    model = bare_model()
    for leg in robot.LEGS:
        foot = model.geom(f"{leg}_foot")
        assert foot.size[0] == robot.FOOT_RADIUS
        assert_allclose(foot.pos, model.site(f"{leg}_foot").pos, atol=0)
        assert foot.bodyid == model.body(f"{leg}_calf").id


# ----------------------------------------------------------------------------------------------------------- inertials


@pytest.mark.parametrize(("inertia", "mass"), [("merged", 12.743448), ("rotor_complete", 13.099448)])
def test_total_mass(inertia: str, mass: float) -> None:
    assert bare_model(inertia).body_mass.sum() == pytest.approx(mass, abs=1e-4)


def rotor(axis: int) -> Inertial:
    """One motor's rotor, URDF: 0.089 kg, 1.11842e-4 kg m2 about its spin axis, 5.9647e-5 across."""
    moments = np.full(3, 5.9647e-5)
    moments[axis] = 1.11842e-4
    return Inertial(0.089, np.zeros(3), np.diag(moments))


@cache
def vendor_inertials(leg: str) -> dict[str, Inertial]:
    """Hip, thigh and calf of one leg, put together from the URDF's separate links."""
    f, s = (1 if leg[0] == "F" else -1), (1 if leg[1] == "L" else -1)
    hip_six = (3.34008405e-4, 6.19101213e-4, 4.0057614e-4, -1.0826066e-5 * f * s, 1.290732e-6 * f, 1.643194e-6 * s)
    thigh_six = (4.431760472e-3, 4.485671726e-3, 7.40309489e-4, 5.7496807e-5 * s, -2.18457134e-4, 5.72001265e-4 * s)
    calf_six = (1.088793059e-3, 1.100428748e-3, 2.4787446e-5, -2.55679e-7, 7.117814e-6, 2.077264e-6)
    return {
        "hip": combine(
            [inertial(0.591, (-0.005657 * f, -0.008752 * s, -0.000102), hip_six), rotor(axis=1).at(0, -0.00015 * s, 0)]
        ),
        "thigh": combine(
            [inertial(0.92, (-0.003342, -0.018054 * s, -0.033451), thigh_six), rotor(axis=1).at(0, -0.03235 * s, 0)]
        ),
        "calf": combine(
            [
                inertial(0.135862, (0.006197, 0.001408, -0.116695), calf_six),
                inertial(0.06, (0, 0, -0.213), (9.6e-6, 9.6e-6, 9.6e-6, 0, 0, 0)),
            ]
        ),
    }


@pytest.mark.parametrize("joint", robot.JOINTS)
def test_leg_inertials_follow_from_the_vendors_separate_links(joint: str) -> None:
    leg, kind = joint.split("_")
    expected, actual = vendor_inertials(leg)[kind], body_inertial(bare_model(), joint)
    assert actual.mass == pytest.approx(expected.mass, abs=1e-9)
    assert_allclose(actual.com, expected.com, atol=1e-9)
    assert_allclose(actual.inertia, expected.inertia, atol=1e-11)


def test_rotor_complete_trunk_is_the_trunk_with_four_hip_rotors() -> None:
    rotors = [rotor(axis=0).at(x, y, 0) for x in (0.11215, -0.11215) for y in (0.04675, -0.04675)]
    expected = combine([body_inertial(bare_model(), "trunk"), *rotors])
    actual = body_inertial(bare_model("rotor_complete"), "trunk")
    assert actual.mass == pytest.approx(expected.mass, abs=1e-9)
    assert_allclose(actual.com, expected.com, atol=1e-9)
    assert_allclose(actual.inertia, expected.inertia, atol=1e-10)


def test_principal_moments_of_the_trunk() -> None:
    assert_allclose(bare_model().body("trunk").inertia, [0.0716565, 0.0630105, 0.0168101], rtol=1e-5)


@pytest.mark.parametrize(
    ("inertia", "pose", "com"),
    [
        ("merged", "isaac_lab", [-0.003959, 0.000876, -0.018427]),
        ("rotor_complete", "isaac_lab", [-0.003851, 0.000853, -0.017927]),
        ("merged", "home", [-0.002113, 0.000877, -0.018992]),
    ],
)
def test_whole_body_com(inertia: str, pose: str, com: list[float]) -> None:
    model = bare_model(inertia)
    assert_allclose(at_origin(model, POSES[pose]).subtree_com[1], com, atol=2e-4)
    assert_allclose(whole_robot(model, POSES[pose]).com, com, atol=2e-4)


@pytest.mark.parametrize(
    ("pose", "expected"),
    [("isaac_lab", [0.14206, 0.41398, 0.44138, -0.01636]), ("home", [0.12684, 0.39403, 0.42288, -0.01433])],
)
def test_composite_inertia_about_the_com(pose: str, expected: list[float]) -> None:
    tensor = whole_robot(bare_model(), POSES[pose]).inertia
    assert_allclose([tensor[0, 0], tensor[1, 1], tensor[2, 2], tensor[0, 2]], expected, rtol=0.01)


# ---------------------------------------------------------------------------------------------------------- kinematics


@pytest.mark.parametrize(
    ("angles", "leg", "foot"),
    [
        ((0.0, 0.0, -0.9), "FR", (0.354949, -0.12675, -0.345403)),
        ((0.0, 0.0, -0.9), "RL", (-0.021251, 0.12675, -0.345403)),
        ((0.3, 0.5, -1.2), "FR", (0.223201, -0.019793, -0.357853)),
        ((0.3, 0.5, -1.2), "FL", (0.223201, 0.226561, -0.310570)),
        ((0.3, 0.5, -1.2), "RR", (-0.152999, -0.019793, -0.357853)),
        ((0.3, 0.5, -1.2), "RL", (-0.152999, 0.226561, -0.310570)),
        ((-0.4, 1.1, -2.2), "FR", (0.1881, -0.195683, -0.146825)),
        ((-0.4, 1.1, -2.2), "FL", (0.1881, 0.045187, -0.209132)),
    ],
)
def test_foot_positions(angles: tuple[float, float, float], leg: str, foot: tuple[float, float, float]) -> None:
    assert_allclose(feet(np.tile(angles, 4))[robot.LEGS.index(leg)], foot, atol=1e-5)


def test_link_frames_are_parallel_when_the_legs_hang_straight() -> None:
    data = at_origin(bare_model(), np.zeros(12))
    assert_allclose(data.xquat[1:], np.tile([1, 0, 0, 0], (13, 1)), atol=0)


@pytest.mark.parametrize(("pose", "height"), [("isaac_lab", 0.324768), ("home", 0.287806), ("mjlab", 0.294470)])
def test_first_touch_height(pose: str, height: float) -> None:
    assert first_touch_height(POSES[pose]) == pytest.approx(height, abs=1e-5)


# ------------------------------------------------------------------------------------------------------------ standing


@pytest.mark.parametrize(
    ("pose", "gains", "height", "pitch_deg"),
    [
        ("isaac_lab", (100.0, 2.0), (0.3109, 3e-3), (0.0, 1.0)),
        ("home", (100.0, 2.0), (0.2764, 3e-3), (0.0, 1.0)),
        ("mjlab", (100.0, 2.0), (0.2842, 3e-3), (0.0, 1.0)),
        ("isaac_lab", (20.0, 0.5), (0.261, 0.012), (2.6, 0.4)),  # the real robot's
        ("isaac_lab", (35.0, 0.5), (0.290, 5e-3), (1.0, 0.5)),
    ],
)
def test_legs_settle_level_the_lower_the_softer(
    pose: str, gains: tuple[float, float], height: tuple[float, float], pitch_deg: tuple[float, float]
) -> None:
    stand = standing(pose, *gains)
    assert stand.height == pytest.approx(height[0], abs=height[1])
    assert stand.pitch_deg == pytest.approx(pitch_deg[0], abs=pitch_deg[1])
