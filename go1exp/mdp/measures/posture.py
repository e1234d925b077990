"""How the trunk is carried."""

from __future__ import annotations

import numpy as np

from go1exp.config.schema.registry import measure
from go1exp.mdp.measures.trace import Array, Trace, mean_over


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
