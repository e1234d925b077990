"""Loads on the feet: shares, impacts, slip."""

from __future__ import annotations

import numpy as np

from go1exp import robot
from go1exp.config.schema.registry import NonNegative, Positive, measure
from go1exp.mdp.measures.trace import Array, Trace, largest_within, mean_over, percentile_by_robot, ratio

HIGH = 95.0
"""Percentile of impacts that counts as high."""


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
    return percentile_by_robot(each, landed.column // robot.NUM_LEGS, trace.robots, HIGH)


@measure("peak_force_p95", unit="body weights")
def peak_force_p95(trace: Trace) -> Array:
    """Largest force on a foot in each stance, 95th percentile over the stances of all feet, over m g (N,)."""
    weight = trace.need("mass") * robot.GRAVITY
    force = np.moveaxis(trace.need("foot_peak_force"), 0, -1).reshape(-1, trace.steps).astype(np.float64)
    stance = trace.stances.where(1, whole=False)
    first, last = stance.start // trace.samples, (stance.stop - 1) // trace.samples
    peak = largest_within(force, stance.column, first, last + 1)
    return percentile_by_robot(peak, stance.column // robot.NUM_LEGS, trace.robots, HIGH) / weight


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
