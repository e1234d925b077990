"""Kinds of motion for which the errors of an actuator model are reported, by speed and torque of each joint."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from go1exp.gap.actuator_net.dataset import Rows

STILL, FAST, HIGH = 0.05, 0.5, 0.7
"""Share of a joint's speed scale below which it is still; above which it is fast; share of its torque scale that is
high."""

QUANTILE = 0.99
"""The scales are this quantile of |speed| and |torque| over all recordings, so that rare spikes have no effect."""

REVERSAL = 0.02
"""s; rows this close to a change of the velocity's sign count as reversal."""

REGIMES = ("all", "still", "slow", "fast", "reversal", "high torque")


@dataclass(frozen=True)
class Thresholds:
    """Limits of the regimes of one joint: speeds rad/s, torque N m, time s; None if there is no velocity."""

    joint: str
    still_below: float | None
    fast_above: float | None
    reversal_within: float
    high_torque_above: float


def thresholds(rows: Rows, joints: tuple[str, ...]) -> list[Thresholds]:
    """Compute the limits of each joint from ``rows``, which should be those of all recordings."""
    limits = []
    for j, joint in enumerate(joints):
        joint_rows = rows.take(rows.joint == j)
        known = len(joint_rows) > 0 and bool(np.isfinite(joint_rows.speed).all())
        speed = float(np.quantile(np.abs(joint_rows.speed), QUANTILE)) if known else None
        torque = float(np.quantile(np.abs(joint_rows.y), QUANTILE)) if len(joint_rows) else 0.0
        slow, fast = (None, None) if speed is None else (STILL * speed, FAST * speed)
        limits.append(Thresholds(joint, slow, fast, REVERSAL, HIGH * torque))
    return limits


def masks(rows: Rows, limits: list[Thresholds]) -> dict[str, np.ndarray]:
    """Return which rows belong to each regime ``(R,)``. Still, slow and fast exclude each other; the others do not."""

    def per_row(values: list[float | None]) -> np.ndarray:
        return np.array([np.nan if v is None else v for v in values])[rows.joint]

    speed = np.abs(rows.speed)  # NaN where it is unknown: compares as false
    still, fast = per_row([x.still_below for x in limits]), per_row([x.fast_above for x in limits])
    return {
        "all": np.ones(len(rows), bool),
        "still": speed < still,
        "slow": (speed >= still) & (speed < fast),
        "fast": speed >= fast,
        "reversal": rows.since_reversal <= REVERSAL,
        "high torque": np.abs(rows.y) > per_row([x.high_torque_above for x in limits]),
    }


def as_text(limits: list[Thresholds]) -> list[str]:
    """Return one line per joint with its limits."""
    lines = []
    for x in limits:
        values = asdict(x)
        description = "speed unknown: no still, slow, fast or reversal"
        if x.still_below is not None:
            description = (
                "still below {still_below:.3g} rad/s, fast from {fast_above:.3g} rad/s, "
                "reversal within {reversal_within:g} s of a sign change"
            ).format(**values)
        lines.append(f"{x.joint}: {description}; high torque above {x.high_torque_above:.3g} N m")
    return lines
