"""Table III of the paper to the letter, where ``rewards.py`` departs from it: ``reward=paper_literal``.

These expressions are kept so that the claim "ill-posed" can be run. Several are signed, one is identically zero;
``docs/paper.md`` says what each does to a policy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp import robot
from go1exp.base.tensors.memory import constant_like
from go1exp.config.schema.registry import NonNegative, Positive, reward
from go1exp.mdp.derived import foot_speed_xy, joint_deviation
from go1exp.mdp.types import Snapshot

if TYPE_CHECKING:
    from torch import Tensor


@reward("feet_air_time_literal")
def feet_air_time_literal(s: Snapshot, *, threshold: NonNegative = 0.175) -> Tensor:
    """As printed: sum_i (t_air,i - threshold) of the running air time, s; grows for as long as feet stay up."""
    return (s.foot_air_time - threshold).sum(-1)


@reward("foot_clearance_literal")
def foot_clearance_literal(s: Snapshot, *, target_height: NonNegative = 0.08) -> Tensor:
    """As printed: exp(-sum_i (z_i - h)), z over the ground in m; largest with all feet on the ground."""
    return torch.exp(-(s.foot_height - target_height).sum(-1))


@reward("air_time_variance_literal")
def air_time_variance_literal(s: Snapshot) -> Tensor:
    """As printed: sum_i sum_j (t_air,i - t_air,j), s; zero for every gait, up to rounding."""
    air = s.foot_last_air_time
    return (air.unsqueeze(2) - air.unsqueeze(1)).sum((1, 2))


@reward("base_motion_literal")
def base_motion_literal(s: Snapshot) -> Tensor:
    """As printed: |w_x + w_y|, rad/s; zero for a roll with an opposite pitch."""
    return s.base_ang_vel_b[:, :2].sum(-1).abs()


@reward("foot_slip_literal")
def foot_slip_literal(s: Snapshot) -> Tensor:
    """As printed: norm over the feet of [contact_i] u_i, m/s."""
    return (foot_speed_xy(s) * s.foot_contact).norm(dim=-1)


@reward("joint_deviation_literal")
def joint_deviation_literal(s: Snapshot) -> Tensor:
    """As printed: sum over joints of (q - q0), signed, rad."""
    return joint_deviation(s).sum(-1)


@reward("joint_position_limit_literal")
def joint_position_limit_literal(s: Snapshot) -> Tensor:
    """As printed: number of joints at or above the upper hard limit, 0 to 12."""
    top = constant_like(tuple(robot.JOINT_POS_LIMITS[:, 1].tolist()), s.joint_pos)
    return (s.joint_pos >= top).sum(-1).to(s.joint_pos.dtype)


@reward("joint_velocity_limit_literal")
def joint_velocity_limit_literal(
    s: Snapshot, *, limit: tuple[Positive, Positive, Positive] = robot.VELOCITY_LIMIT
) -> Tensor:
    """As printed: number of joints with qd >= limit (hip, thigh, calf, rad/s), positive speeds only, 0 to 12."""
    top = constant_like(tuple(robot.per_joint(limit).tolist()), s.joint_vel)
    return (s.joint_vel >= top).sum(-1).to(s.joint_vel.dtype)
