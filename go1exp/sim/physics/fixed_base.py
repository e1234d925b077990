"""Any chain of hinges on a fixed base, from a MuJoCo file -> one compiled model as the plant expects it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco

from go1exp.base.errors import Unusable
from go1exp.robot import MOUNT
from go1exp.sim.physics.scene import RIGID, add_mount

BASE = "trunk"
"""Name that the base body gets, whatever the file calls it: effects on the attitude of a held robot look for it."""


class FixedBaseError(Unusable):
    """A MuJoCo file that does not hold the robot that a configuration says."""


def build_fixed_base(
    file: Path,
    base: str,
    joints: Sequence[str],
    effort: Sequence[float],
    physics_dt: float,
    base_quat: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    mounted: bool = False,
) -> mujoco.MjModel:
    """Compile a robot with a fixed base.

    Joints that are not asked for are held at zero, those of the base included; so are touching shapes and the file's
    own motors and sensors left out. Each link takes the name of its joint, so that effects on links find it.

    Args:
        file: MJCF or URDF, whose path names what it includes.
        base: body that is fixed to the world.
        joints: hinges in the order in which the model will have them, J.
        effort: peak torque of each, (J,) N m.
        physics_dt: timestep, s.
        base_quat: attitude of the base, w-x-y-z, base to world; it replaces the file's.
        mounted: the base has the joints of ``sim/physics/scene.py``, before its own.

    Raises:
        FixedBaseError: if the file is missing or no model, has no such body or hinge, has them in another order, or has
            two of them in one link.
    """
    if not file.is_file():
        raise FixedBaseError(f"mjcf = {str(file)!r}: no such file")
    try:
        spec = mujoco.MjSpec.from_file(str(file))
    except ValueError as error:
        raise FixedBaseError(f"mjcf = {str(file)!r}: not a MuJoCo model ({_in_a_line(error)})") from None
    spec.compiler.fusestatic = False  # the base, which has no joint, must remain a body of its own
    _checked(spec, file, base, joints)
    held = {joint.name: joint for joint in spec.joints if joint.name not in joints}
    ties = [e for e in spec.equalities if e.type == mujoco.mjtEq.mjEQ_JOINT and {e.name1, e.name2} & held.keys()]
    # A joint that is held cannot mimic another.
    references = (*spec.excludes, *spec.pairs, *spec.cameras, *spec.lights, *spec.skins, *spec.flexes)
    for part in (*ties, *held.values(), *spec.actuators, *spec.sensors, *spec.keys, *references):
        spec.delete(part)
    for body in spec.bodies:
        body.simple = False  # a link whose mass an effect moves is not what MuJoCo calls simple
    given = _rename(spec, base, joints)
    trunk = spec.body(BASE)
    trunk.quat = list(base_quat)
    if mounted:
        add_mount(trunk)
    for name, limit in zip(joints, effort, strict=True):
        joint = spec.joint(name)
        # Dry friction is as rigid as a step allows (see sim/physics/scene.py).
        joint.solref_friction, joint.solimp_friction = [2.0 * physics_dt, 1.0], list(RIGID)
        motor = spec.add_actuator()
        motor.name, motor.target, motor.trntype = name, name, mujoco.mjtTrn.mjTRN_JOINT
        motor.forcelimited, motor.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-limit, limit]
    spec.option.timestep = physics_dt
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    without = mujoco.mjtDisableBit
    for flag in (without.mjDSBL_AUTORESET, without.mjDSBL_ISLAND, without.mjDSBL_CONTACT, without.mjDSBL_SENSOR):
        spec.option.disableflags |= int(flag)
    try:
        model = spec.compile()
    except ValueError as error:
        raise FixedBaseError(f"mjcf = {str(file)!r}: {_cause(error, given)}") from None
    order = [model.joint(k).name for k in range(len(MOUNT) if mounted else 0, model.njnt)]
    if order != list(joints):
        raise FixedBaseError(f"joints: must be in the order of {str(file)!r}: {', '.join(order)}")
    return model


def _rename(spec: mujoco.MjSpec, base: str, joints: Sequence[str]) -> dict[str, str]:
    """Name the base ``BASE`` and each link as its joint, whatever others are called; return new name -> the file's."""
    renamed = [spec.body(base), *[spec.joint(name).parent for name in joints]]
    given = {}
    for k, body in enumerate(spec.bodies[1:], start=1):
        given[f"body {k}"], body.name = body.name or "without a name", f"body {k}"
    for body, name in zip(renamed, (BASE, *joints), strict=True):
        given[name], body.name = given.pop(body.name), name
    new = {old: name for name, old in given.items()}
    for tie in spec.equalities:
        if tie.objtype == mujoco.mjtObj.mjOBJ_BODY:
            tie.name1, tie.name2 = new.get(tie.name1, tie.name1), new.get(tie.name2, tie.name2)
    return given


def _cause(error: ValueError, given: Mapping[str, str]) -> str:
    """Return what MuJoCo's compiler refuses; ``given``: name of a body in the compiled model -> that in the file."""
    text = _in_a_line(error)
    body = re.search(r"inertia.* Element name '([^']*)'", text)
    if body is None:
        return f"does not compile ({text})"
    name, how = body[1], "can move in its mount" if body[1] == BASE else f"is moved by joint {body[1]!r}"
    if "mass and inertia" in text:
        return f"body {given[name]!r} {how}: its mass and inertia must be above zero"
    return f"does not compile ({text.replace(repr(name), repr(given[name]))})"


def _in_a_line(error: ValueError) -> str:
    """Return MuJoCo's complaint in one line; its later lines say where in the file."""
    return " ".join(str(error).split())


def _checked(spec: mujoco.MjSpec, file: Path, base: str, joints: Sequence[str]) -> None:
    bodies, hinges = [b.name for b in spec.bodies], {}
    if base not in bodies[1:]:
        known = ", ".join(name for name in bodies[1:] if name)
        raise FixedBaseError(f"base = {base!r}: no body of {str(file)!r}; it has {known or 'none with a name'}")
    if taken := {BASE, *MOUNT} & set(joints):
        raise FixedBaseError(f"joints: {min(taken)!r} is a name of the base in the compiled model; rename that joint")
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
            hinges[joint.name] = joint.parent.name or str(joint.parent.id)
    for name in joints:
        if name not in hinges:
            raise FixedBaseError(f"joints: {name!r} is no hinge of {str(file)!r}; it has {', '.join(hinges) or 'none'}")
    links = [hinges[name] for name in joints]
    twice = next((link for link in links if links.count(link) > 1), None)
    if twice is not None:
        raise FixedBaseError(f"joints: two of them move the body {twice!r}; give each a body of its own")
    if base in links:
        raise FixedBaseError(f"base = {base!r}: is moved by a joint of the list")


def feel_each_other(model: mujoco.MjModel, a: int, b: int) -> bool:
    """Return whether one of two degrees of freedom carries the other."""

    def above(dof: int) -> set[int]:
        ancestors = {dof}
        while (dof := int(model.dof_parentid[dof])) >= 0:
            ancestors.add(dof)
        return ancestors

    return a in above(b) or b in above(a)
