"""What the solver may know beside the logs: the nominal robot, the tolerances, and the names that it may give.

The numbers are copied from the effects' declared tolerances (``go1exp/sim/effects``) on purpose and not imported: the
benchmark must not change when the library does.
"""

from __future__ import annotations

import math
from typing import Any

from go1exp import robot

TOLERANCES: dict[str, dict[str, float]] = {
    "armature": {"added": 0.001},
    "asymmetric_friction": {"forward": 0.05, "backward": 0.05},
    "backlash": {"gap": 0.001},
    "base_tilt": {"roll": 0.0087, "pitch": 0.0087},
    "cogging": {"amplitude": 0.05},
    "com_offset": {"x": 0.005, "y": 0.005, "z": 0.005},
    "command_delay": {"delay": 0.001},
    "coulomb": {"bound": 0.05},
    "dead_band": {"band": 0.001},
    "encoder_offset": {"offset": 0.003},
    "external_wrench": {"x": 1.0, "y": 1.0, "z": 1.0, "roll": 0.2, "pitch": 0.2, "yaw": 0.2},
    "fixed_point": {"steps": 1.0},
    "flexibility": {"compliance": 5e-4},
    "foot_friction": {"scale": 0.1},
    "ground_compliance": {"time_constant": 0.003},
    "joint_stop": {"time_constant": 0.003, "restitution": 0.1, "lower": 0.02, "upper": 0.02},
    "kd_scale": {"scale": 0.15},
    "kp_scale": {"scale": 0.1},
    "lag": {"time": 0.001},
    "link_com": {"along": 0.002, "forward": 0.002, "left": 0.002},
    "link_inertia": {"scale": 0.1},
    "link_mass": {"scale": 0.05},
    "load_friction": {"coefficient": 0.01},
    "parallel_stiffness": {"stiffness": 0.1},
    "payload": {"mass": 0.2},
    "point_load": {"mass": 0.01},
    "quadratic_drag": {"drag": 0.002},
    "soft_mount": {"sway": 2e-5, "heave": 2e-5, "roll": 5e-4, "pitch": 5e-4},
    "strength": {"scale": 0.05},
    "strength_drift": {"rate": 0.0025},
    "stribeck": {"strength": 0.05},
    "torque_delay": {"delay": 0.001},
    "torque_speed_limit": {"peak": 0.05, "droop": 0.1},
    "viscous": {"damping": 0.02},
}
"""Effect -> parameter -> deviation from its null value that a user does not care about.

Units: friction, cogging N m; viscous N m s/rad; drag N m s2/rad2; delays and lag s; angles rad; ``link_*`` shares of
a link's own; ``payload`` kg on the trunk, ``point_load`` kg on a link; armature kg m2; shift m; stiffness N m/rad;
compliance rad/(N m), of a mount's slides m/N; rate 1/s; steps over those of a Go1's packets.
"""

LIBRARY = tuple(TOLERANCES)
"""The effects that a solver may name; what a case hides beyond them is ``outside``."""

GROUND_ONLY = ("com_offset", "external_wrench", "foot_friction", "ground_compliance", "payload")
"""Effects that a robot whose trunk is held does not feel."""

NEVER_HIDDEN = ("fixed_point", "soft_mount")
"""Effects that no case hides: on logs at one gain the first is ``kp_scale`` and ``viscous`` to the last bit, and the
benchmark's robots are suspended, fixed-base."""

ALIASES: tuple[frozenset[str], ...] = (
    frozenset({"kd_scale", "viscous"}),
    frozenset({"torque_delay", "lag"}),
    frozenset({"base_tilt", "encoder_offset"}),
    frozenset({"armature", "link_inertia"}),
)
"""Families that logs of this kind may be unable to tell apart; a name counts as right within its family."""

EQUIVALENT = {"asymmetric_friction": frozenset({"coulomb", "encoder_offset"})}
"""Effects that a set of others describes exactly (friction that depends on direction: its mean and a constant)."""

NOMINAL: dict[str, Any] = {
    "model": "assets/go1/go1.xml",
    "inertia": "merged",
    "armature": list(robot.ROTOR_ARMATURE),
    "damping": [0.0, 0.0, 0.0],
    "friction_loss": [0.0, 0.0, 0.0],
    "effort_limit": list(robot.EFFORT_LIMIT),
    "velocity_limit": list(robot.VELOCITY_LIMIT),
    "drive": "kp (q_target - q) - kd qd, clipped at effort_limit; q_target from its own row's instant on",
}
"""The model that the robot is believed to be; triples are hip, thigh, calf."""


def null(effect: str, parameter: str) -> float:
    """Return the value of a parameter at which the effect is absent."""
    if effect == "torque_speed_limit" and parameter == "peak":
        return 1.0
    return {"scale": 1.0, "time_constant": 0.02, "restitution": math.exp(-2.0)}.get(parameter, 0.0)


def family(effect: str) -> frozenset[str]:
    """Return the effects that count as this one."""
    return frozenset({effect}).union(*(a for a in ALIASES if effect in a))
