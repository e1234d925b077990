"""Observation terms: Snapshot -> ``(N, k)`` float32, unscaled by default. The YAML's list is concatenated in its order.

Table II of the paper; a ``scale`` other than 1 is not the paper's. A term's ``noise`` in the YAML is the
half-width of a uniform distribution, drawn anew at each policy step and element, of the scaled number. ``mirror`` is
the term's image under a swap of left and right (``mdp/mirror.py``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.config.schema.registry import NonNegative, Positive, observation
from go1exp.mdp.derived import clock_angle, joint_deviation
from go1exp.mdp.ground import SCAN_COLUMNS, SCAN_ROWS
from go1exp.mdp.mirror import ACTION, AXIAL, CLOCK, COMMAND, JOINTS, LEGS, POLAR, grid
from go1exp.mdp.types import Snapshot

if TYPE_CHECKING:
    from torch import Tensor


@observation("base_linear_velocity", size=3, mirror=POLAR)
def base_linear_velocity(s: Snapshot) -> Tensor:
    """Velocity of the trunk origin in the trunk frame, (N, 3) m/s. On the robot it comes from an estimator."""
    return s.base_lin_vel_b


@observation("base_angular_velocity", size=3, mirror=AXIAL)
def base_angular_velocity(s: Snapshot) -> Tensor:
    """Angular velocity in the trunk frame, (N, 3) rad/s. The table prints omega_yaw, with three components."""
    return s.base_ang_vel_b


@observation("projected_gravity", size=3, mirror=POLAR)
def projected_gravity(s: Snapshot) -> Tensor:
    """Direction of gravity in the trunk frame, (N, 3), unit length."""
    return s.projected_gravity_b


@observation("velocity_command", size=3, mirror=COMMAND)
def velocity_command(s: Snapshot, *, scale: Positive = 1.0) -> Tensor:
    """Commanded velocity x, y (m/s) and yaw rate (rad/s) in the trunk frame, (N, 3), times ``scale``."""
    return s.command * scale


@observation("joint_position", size=12, mirror=JOINTS)
def joint_position(s: Snapshot) -> Tensor:
    """Joint angles relative to the nominal stance, (N, 12) rad."""
    return joint_deviation(s)


@observation("joint_velocity", size=12, mirror=JOINTS)
def joint_velocity(s: Snapshot, *, scale: Positive = 1.0) -> Tensor:
    """Joint velocities, (N, 12) rad/s, times ``scale``."""
    return s.joint_vel * scale


@observation("previous_action", size=12, mirror=ACTION)
def previous_action(s: Snapshot) -> Tensor:
    """The policy's last output, unscaled, (N, 12); zero after a reset."""
    return s.action


@observation("gait_clock", size=2, mirror=CLOCK)
def gait_clock(s: Snapshot, *, rate: Positive = 2.5) -> Tensor:
    """Sine and cosine of a clock of ``rate`` turns a second, (N, 2); zero while no motion is commanded.

    Reward ``foot_clock`` rewards following it. Not of the paper.
    """
    angle = clock_angle(s, rate)
    moving = s.command.norm(dim=-1, keepdim=True) > 0
    return torch.stack([torch.sin(angle), torch.cos(angle)], dim=-1) * moving


@observation("joint_torque", size=12, mirror=JOINTS)
def joint_torque(s: Snapshot, *, scale: Positive = 1.0) -> Tensor:
    """Torques of the actuators, (N, 12) N m, times ``scale``."""
    return s.joint_torque * scale


@observation("foot_contact", size=4, mirror=LEGS)
def foot_contact(s: Snapshot) -> Tensor:
    """Whether each foot bears force now, 1 or 0, (N, 4)."""
    return s.foot_contact.float()


@observation("foot_force", size=4, mirror=LEGS)
def foot_force(s: Snapshot, *, scale: Positive = 1.0) -> Tensor:
    """Magnitudes of the ground's forces on the feet, (N, 4) N, times ``scale``."""
    return s.foot_force * scale


@observation("foot_height", size=4, mirror=LEGS)
def foot_height(s: Snapshot, *, scale: Positive = 1.0) -> Tensor:
    """Heights of the feet's centres over the ground below them, (N, 4) m, times ``scale``."""
    return s.foot_height * scale


@observation("foot_air_time", size=4, mirror=LEGS)
def foot_air_time(s: Snapshot, *, scale: Positive = 1.0) -> Tensor:
    """Time that each foot has been in the air, 0 in stance, (N, 4) s, times ``scale``."""
    return s.foot_air_time * scale


@observation("height_scan", size=SCAN_ROWS * SCAN_COLUMNS, mirror=grid(SCAN_ROWS, SCAN_COLUMNS), reads=("height_scan",))
def height_scan(s: Snapshot, *, scale: Positive = 1.0, offset: NonNegative = 0.3, bound: Positive = 1.0) -> Tensor:
    """Ground around the robot: its height over the trunk's origin plus ``offset`` m, times ``scale``, cut at ``bound``.

    (N, 187), a grid of 1.6 m along the heading and 1.0 m across, every 0.1 m; 0 where the ground is ``offset`` below.
    After Isaac Lab's term of this name, which has the other sign.
    """
    assert s.height_scan is not None
    return ((s.height_scan + offset) * scale).clamp(-bound, bound)
