"""Joints between the world and a trunk that is held, for a robot whose straps or stand give way.

A trunk that is bolted down has none of them. What the joints are made of, springs and dampers, is the effect
``soft_mount`` (``go1exp/effects/soft_mount.py``), which finds them as the degrees of freedom before those of the legs.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

MOUNT = ("mount_x", "mount_y", "mount_z", "mount_roll", "mount_pitch")
"""The mount's joints, the model's first: slides along the axes of the world, then hinges about those of the trunk.

None about z: legs that hang hardly turn a trunk that way, and a fit gets lost in what else it might explain.
"""


def add_mount(trunk: mujoco.MjsBody) -> None:
    """Let a held trunk move: three slides and two hinges, none of which has a spring or a damper yet.

    Args:
        trunk: body of the trunk, a child of the world, with its attitude set and without joints.
    """
    back = Rotation.from_quat(trunk.quat, scalar_first=True).inv().as_matrix()
    for k, name in enumerate(MOUNT):
        turns = k >= 3
        joint = trunk.add_joint()
        joint.name = name
        joint.type = mujoco.mjtJoint.mjJNT_HINGE if turns else mujoco.mjtJoint.mjJNT_SLIDE
        joint.axis = list(np.eye(3)[k - 3]) if turns else list(back[:, k])
