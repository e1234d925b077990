"""Joints between the world and a trunk that is held, for a robot whose straps or stand give way.

A trunk that is bolted down has none of them. What the joints are made of, springs and dampers, is the effect
``soft_mount`` (``sim/effects/soft_mount.py``), which finds them as the degrees of freedom before those of the legs.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from go1exp.robot import MOUNT_HINGES, MOUNT_SLIDES


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
