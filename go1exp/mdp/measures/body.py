"""Effort of the actuators, and height, heave and pitch of the trunk."""

from __future__ import annotations

import numpy as np

from go1exp import robot
from go1exp.config.schema.registry import NonNegative, Positive, measure
from go1exp.mdp.measures.trace import Array, Trace, mean_over, percentile_over, ratio

HIGH = 99.0
"""Percentile over steps and joints that counts as high."""


@measure("target_step_p99", unit="rad")
def target_step_p99(trace: Trace, *, period: Positive = 0.02) -> Array:
    """Change of a joint's target within ``period`` s, 99th percentile of its size over steps and joints (N,)."""
    target = trace.need("joint_target")
    lag = max(round(period / trace.step_dt), 1)
    both = trace.counts[lag:] & trace.counts[:-lag]
    return percentile_over(np.abs(target[lag:] - target[:-lag]).astype(np.float64), both, HIGH)


@measure("cost_of_transport", unit="-")
def cost_of_transport(trace: Trace, *, least_speed: NonNegative = 0.1) -> Array:
    """Positive mechanical work over weight and way, int sum_j max(0, tau_j qd_j) dt / (m g int |v_xy| dt) (N,).

    v_xy is the trunk's velocity in its frame. NaN below a mean speed of ``least_speed`` m/s, where it says nothing.
    """
    if trace.positive_power is not None:
        power = trace.positive_power
    else:
        power = np.maximum(trace.need("joint_torque") * trace.need("joint_vel"), 0.0).sum(-1)
    speed = mean_over(np.hypot(*np.moveaxis(trace.need("base_lin_vel_b")[..., :2], -1, 0)), trace.moving)
    quick = np.where(speed >= least_speed, speed, np.nan)
    return ratio(mean_over(power, trace.moving), trace.need("mass") * robot.GRAVITY * quick)


@measure("torque_share_p99", unit="-")
def torque_share_p99(trace: Trace) -> Array:
    """Torque over the actuator's peak torque, 99th percentile over steps and joints (N,)."""
    return percentile_over(_torque_share(trace), trace.counts, HIGH)


@measure("joint_speed_share_p99", unit="-")
def joint_speed_share_p99(trace: Trace) -> Array:
    """Joint velocity over the actuator's largest velocity, 99th percentile over steps and joints (N,)."""
    return percentile_over(_speed_share(trace), trace.counts, HIGH)


@measure("envelope_share_p99", unit="-")
def envelope_share_p99(trace: Trace) -> Array:
    """Share of the motors' torque-speed line, 99th percentile over steps and joints; above 1 is outside it (N,).

    |tau| / peak + |qd| / top speed while driving, |tau| / peak while braking (tau qd <= 0). The line falls from peak
    torque at rest to zero at top speed, which is pessimistic (``actuator=dc_motor``).
    """
    driving = trace.need("joint_torque") * trace.need("joint_vel") > 0.0
    return percentile_over(_torque_share(trace) + driving * _speed_share(trace), trace.counts, HIGH)


def _torque_share(trace: Trace) -> Array:
    return np.abs(trace.need("joint_torque")) / robot.per_joint(robot.EFFORT_LIMIT)


def _speed_share(trace: Trace) -> Array:
    return np.abs(trace.need("joint_vel")) / robot.per_joint(robot.VELOCITY_LIMIT)


@measure("heave", unit="m/s")
def heave(trace: Trace) -> Array:
    """Root mean square of the trunk's vertical speed, world frame (N,)."""
    vertical = -(trace.need("base_lin_vel_b") * trace.need("projected_gravity_b")).sum(-1)
    return np.sqrt(mean_over(np.square(vertical, dtype=np.float64), trace.counts))


@measure("trunk_height", unit="m")
def trunk_height(trace: Trace) -> Array:
    """Mean height of the trunk's origin over the ground (N,)."""
    return mean_over(trace.need("base_height"), trace.counts)


@measure("trunk_pitch", unit="rad")
def trunk_pitch(trace: Trace) -> Array:
    """Mean pitch of the trunk; positive is nose down (N,)."""
    gravity = trace.need("projected_gravity_b")
    return mean_over(np.arctan2(gravity[..., 0], -gravity[..., 2]), trace.counts)
