"""Effort of the actuators, motion of the trunk, and loads on the feet: shares, impacts, slip."""

from __future__ import annotations

import numpy as np

from go1exp import robot
from go1exp.config.schema.registry import NonNegative, Positive, measure
from go1exp.mdp.measures.trace import (
    Array,
    Trace,
    largest_within,
    mean_over,
    percentile_by_robot,
    percentile_over,
    ratio,
)

HIGH = 99.0
"""Percentile over steps and joints that counts as high."""

HIGH_IMPACT = 95.0
"""Percentile of impacts that counts as high."""


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


@measure("foot_load", unit="N", per="foot")
def foot_load(trace: Trace) -> Array:
    """Mean force on each foot over all of the time, swings included (N, 4)."""
    return mean_over(trace.need("foot_force"), trace.counts)


@measure("load_share", unit="-", per="foot")
def load_share(trace: Trace) -> Array:
    """Share of each foot in the mean forces on all feet; they sum up to 1 (N, 4)."""
    load = foot_load(trace)
    return ratio(load, load.sum(-1, keepdims=True))


@measure("touchdown_speed_p95", unit="m/s")
def touchdown_speed_p95(trace: Trace) -> Array:
    """Speed of the feet just before they touch down, 95th percentile over all touchdowns (N,)."""
    speed = np.moveaxis(trace.need("foot_touchdown_speed"), 0, -1).reshape(-1, trace.steps)
    landed = trace.stances.where(1, whole=False)
    each = speed[landed.column, landed.start // trace.samples].astype(np.float64)
    return percentile_by_robot(each, landed.column // robot.NUM_LEGS, trace.robots, HIGH_IMPACT)


@measure("peak_force_p95", unit="body weights")
def peak_force_p95(trace: Trace) -> Array:
    """Largest force on a foot in each stance, 95th percentile over the stances of all feet, over m g (N,)."""
    weight = trace.need("mass") * robot.GRAVITY
    force = np.moveaxis(trace.need("foot_peak_force"), 0, -1).reshape(-1, trace.steps).astype(np.float64)
    stance = trace.stances.where(1, whole=False)
    first, last = stance.start // trace.samples, (stance.stop - 1) // trace.samples
    peak = largest_within(force, stance.column, first, last + 1)
    return percentile_by_robot(peak, stance.column // robot.NUM_LEGS, trace.robots, HIGH_IMPACT) / weight


@measure("sink_p99", unit="m", per="foot")
def sink_p99(trace: Trace, *, least_force: NonNegative = 5.0) -> Array:
    """Depth of each sole in the ground while it bears force, 99th percentile over the steps (N, 4)."""
    depth = np.where(_loaded(trace, least_force), trace.need("foot_depth"), np.nan).astype(np.float64)
    result = np.full(depth.shape[1:], np.nan)
    for place in np.ndindex(*result.shape):
        steps = depth[:, *place]
        if (steps >= 0).any():
            result[place] = np.nanpercentile(steps, 99.0)
    return result


@measure("slip_share", unit="-", per="foot")
def slip_share(trace: Trace, *, speed: Positive = 0.2, least_force: NonNegative = 5.0) -> Array:
    """Share of each foot's loaded time in which it moves faster than ``speed`` m/s over the ground (N, 4).

    Loaded: in contact, with more than ``least_force`` N in the mean over the step.
    """
    fast, loaded = _fast_and_loaded(trace, speed, least_force)
    return ratio(fast.sum(0), loaded.sum(0))


@measure("slip_share_all", unit="-")
def slip_share_all(trace: Trace, *, speed: Positive = 0.2, least_force: NonNegative = 5.0) -> Array:
    """Share of the loaded time of all feet together in which they move faster than ``speed`` m/s (N,)."""
    fast, loaded = _fast_and_loaded(trace, speed, least_force)
    return ratio(fast.sum((0, 2)), loaded.sum((0, 2)))


@measure("slip_distance", unit="m", per="foot")
def slip_distance(trace: Trace, *, least_force: NonNegative = 5.0) -> Array:
    """Way that each foot slides while it is loaded, per stride (N, 4)."""
    loaded = _loaded(trace, least_force)
    way = (np.where(loaded, trace.need("foot_slip_speed"), 0.0)).sum(0, dtype=np.float64) * trace.step_dt
    strides = np.bincount(trace.phases.where(1, whole=False).column, minlength=way.size).reshape(way.shape)
    return ratio(way, strides)


def _fast_and_loaded(trace: Trace, speed: float, least_force: float) -> tuple[Array, np.ndarray]:
    """(T, N, 4) each: 1 where a loaded foot moves faster than this, NaN where its speed is; and where it is loaded."""
    loaded, moves = _loaded(trace, least_force), trace.need("foot_slip_speed")
    return np.where(np.isnan(moves), moves, moves > speed) * np.where(loaded, 1.0, 0.0), loaded


def _loaded(trace: Trace, least_force: float) -> np.ndarray:
    """(T, N, 4) bool: the foot bears more than this at the end of a step that counts."""
    at_end = trace.contact[trace.samples - 1 :: trace.samples]
    return at_end & (trace.need("foot_force") > least_force) & trace.counts[:, :, None]
