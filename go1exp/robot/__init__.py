"""The Unitree Go1 in numbers: order of legs and joints, limits, nominal stance, frames.

All other modules take order and names from here. SI units; trunk frame x forward, y left, z up;
quaternions w-x-y-z. Source, unless another is given: vendor URDF (unitree_ros, go1.urdf, 2024-05).
"""

from __future__ import annotations

import numpy as np

LEGS = ("FR", "FL", "RR", "RL")
"""Leg order of the vendor SDK, used for every ``(N, 4)`` array."""

JOINT_KINDS = ("hip", "thigh", "calf")
JOINTS = tuple(f"{leg}_{kind}" for leg in LEGS for kind in JOINT_KINDS)
"""Joint order of the vendor SDK (leg-major), used for every ``(N, 12)`` array."""

GRAVITY = 9.81
"""m/s2; MuJoCo's own, and what is taken for it on a robot."""

FEET = tuple(f"{leg}_foot" for leg in LEGS)
"""Names of the foot spheres, and of the sites at their centres."""

NUM_JOINTS = len(JOINTS)
NUM_LEGS = len(LEGS)

MOUNT_SLIDES = ("mount_x", "mount_y", "mount_z")
MOUNT_HINGES = ("mount_roll", "mount_pitch")
MOUNT = (*MOUNT_SLIDES, *MOUNT_HINGES)
"""Joints between the world and a trunk on a compliant mount, before those of the legs (``sim/physics/scene.py``).

None about z: suspended legs hardly excite the yaw of the trunk, so its compliance is not identifiable.
"""

MIRROR_LEGS = (1, 0, 3, 2)
"""Index of the leg opposite across the sagittal (x-z) plane."""

MIRROR_JOINTS = tuple(3 * leg + kind for leg in MIRROR_LEGS for kind in range(3))
MIRROR_JOINT_SIGNS = (-1.0, 1.0, 1.0) * NUM_LEGS
"""A mirrored robot has ``q[MIRROR_JOINTS] * MIRROR_JOINT_SIGNS``: hips turn about +x on both sides, so they flip."""

NOMINAL_STANCE = np.array([-0.1, 0.8, -1.5, 0.1, 0.8, -1.5, -0.1, 1.0, -1.5, 0.1, 1.0, -1.5])
"""Joint angles (12,), rad: the stance that Isaac Lab and walk-these-ways use (feet outside the hips)."""

NOMINAL_HEIGHT = 0.33
"""Trunk height over flat ground, m, at which the nominal stance is spawned (first touch at 0.3248)."""

JOINT_POS_LIMITS = np.tile([[-0.863, 0.863], [-0.686, 4.501], [-2.818, -0.888]], (NUM_LEGS, 1))
"""Hard stops (12, 2), rad."""

EFFORT_LIMIT = (23.7, 23.7, 35.55)
"""Peak torque of hip, thigh, calf, N m. The calf has an additional linkage of 1.5:1."""

VELOCITY_LIMIT = (30.1, 30.1, 20.06)
"""Top speed of hip, thigh, calf, rad/s."""

ROTOR_ARMATURE = (0.00449, 0.00449, 0.01009)
"""Reflected rotor inertia of hip, thigh, calf, kg m2: 1.11842e-4 times the gear ratio (6.333, calf 9.5) squared."""

FOOT_RADIUS = 0.023
"""Radius of the foot sphere, m."""

LINK_LENGTHS = (0.08, 0.213, 0.213)
"""Abduction offset, thigh and calf length, m."""

HIP_OFFSET = (0.1881, 0.04675)
"""|x|, |y| of the hip axes in the trunk frame, m."""


def per_joint(hip_thigh_calf: tuple[float, float, float]) -> np.ndarray:
    """Spread three per-kind values over the twelve joints, ``(12,)`` in joint order."""
    return np.tile(np.asarray(hip_thigh_calf, dtype=float), NUM_LEGS)


def soft_limits(factor: float) -> np.ndarray:
    """Joint limits shrunk about the centre of each range by ``factor``: ``(12, 2)``, rad."""
    centre = JOINT_POS_LIMITS.mean(axis=1, keepdims=True)
    return centre + factor * (JOINT_POS_LIMITS - centre)
