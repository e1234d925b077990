"""What the MDP sees of one moment, ``Snapshot``, and what a step of the environment returns, ``StepResult``.

``TermSetup`` is what a term with a memory is built from.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class TermSetup:
    """Arguments from which a reward, observation or termination that is a class is built."""

    num_envs: int
    """N."""
    device: torch.device
    """Of its tensors."""
    dt: float
    """Time from one call to the next, the policy's period, s."""

    def zeros(self, *shape: int) -> Tensor:
        """Return (N, *shape) float32 of zeros."""
        return torch.zeros(self.num_envs, *shape, device=self.device)


@dataclass(frozen=True)
class Snapshot:
    """One policy step of N robots, float32 unless stated.

    Joints and legs in the order of ``robot.py``; ``_b`` is the trunk frame, ``_w`` the world frame. Joint and base
    state are current. Contact forces and foot kinematics are MuJoCo sensors and describe the last physics substep,
    2 ms before the state (see ``sim/physics/backend.py``); timers, ``*_contact`` flags, peak force and touchdown speed
    cover every substep of the step.
    """

    base_pos_w: Tensor
    """(N, 3) trunk origin, m."""
    base_quat_w: Tensor
    """(N, 4) w-x-y-z, trunk to world."""
    base_lin_vel_b: Tensor
    """(N, 3) velocity of the trunk origin, m/s."""
    base_ang_vel_b: Tensor
    """(N, 3) rad/s."""
    projected_gravity_b: Tensor
    """(N, 3) direction of gravity, unit length; (0, 0, -1) when level."""
    joint_pos: Tensor
    """(N, 12) rad."""
    joint_vel: Tensor
    """(N, 12) rad/s."""
    joint_acc: Tensor
    """(N, 12) velocity change over the last physics substep, rad/s2."""
    joint_torque: Tensor
    """(N, 12) torque applied in the last physics substep, N m."""
    joint_target: Tensor
    """(N, 12) position target in force, rad."""
    action: Tensor
    """(N, 12) the policy's output of this step, unscaled."""
    previous_action: Tensor
    """(N, 12) that of the step before (zero after a reset)."""
    command: Tensor
    """(N, 3) commanded velocity: x, y in m/s, yaw rate in rad/s, body frame."""
    foot_height: Tensor
    """(N, 4) height of the centre of each foot sphere over the ground below it, m (0.023 when standing on it)."""
    foot_vel_w: Tensor
    """(N, 4, 3) velocity of the foot centres, m/s."""
    foot_force: Tensor
    """(N, 4) magnitude of the ground's force on each foot, N."""
    foot_contact: Tensor
    """(N, 4) bool, the foot bears force now."""
    foot_air_time: Tensor
    """(N, 4) duration of the running swing phase, 0 in stance, s."""
    foot_contact_time: Tensor
    """(N, 4) duration of the running stance phase, 0 in swing, s."""
    foot_last_air_time: Tensor
    """(N, 4) duration of the last completed swing phase, s."""
    foot_last_contact_time: Tensor
    """(N, 4) duration of the last completed stance phase, s."""
    foot_touchdown: Tensor
    """(N, 4) bool, the foot touched down during this policy step."""
    foot_peak_force: Tensor
    """(N, 4) largest magnitude of the ground's force on each foot over the substeps of this policy step, N."""
    foot_touchdown_speed: Tensor
    """(N, 4) speed of the foot's last touchdown, kept until the next one, 0 before the first, m/s: the downward
    component (world) of the velocity of the foot's centre just before the contact, 0 if it moved upward."""
    thigh_contact: Tensor
    """(N, 4) bool, the thigh touched the ground during this policy step."""
    calf_contact: Tensor
    """(N, 4) bool, the calf (without the foot) touched the ground during this policy step."""
    trunk_contact: Tensor
    """(N,) bool, trunk, head or a hip touched the ground during this policy step."""
    episode_time: Tensor
    """(N,) time since the last reset, s."""
    height_scan: Tensor | None = None
    """(N, 187) height of the ground over the trunk's origin, m, on the grid of ``mdp/ground.py``; None unless an
    observation reads it."""
    foot_rise: Tensor | None = None
    """(N, 4) rise of the ground up to 0.2 m ahead of each foot, where the command leads, over the ground below the
    foot, not negative, m; None unless a reward reads it."""


@dataclass(frozen=True)
class StepResult:
    """What one policy step returns, all float32 or bool and valid until the next step."""

    observation: Tensor
    """(N, O) what the policy sees next; of a new episode where one ended."""
    reward: Tensor
    """(N,)"""
    terminated: Tensor
    """(N,) bool, the robot fell."""
    truncated: Tensor
    """(N,) bool, time is up or the robot left the map."""
    final_observation: Tensor
    """(N, O) the observation before any reset."""
    episode_return: Tensor
    """(N,) sum of rewards so far; of the whole episode where one ended."""
    episode_length: Tensor
    """(N,) int64 steps so far; of the whole episode where one ended."""
