"""Timing of the feet: phases, duty, stride rate, clearance, and which gait that is.

A stride of a foot lasts from one touchdown to the next. At zero command a robot has no gait: its values are NaN.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from go1exp import robot
from go1exp.config.schema.registry import Fraction, measure
from go1exp.mdp.measures.trace import Array, Runs, Trace, largest_within, mean_over, ratio

FR = robot.LEGS.index("FR")

GAITS = {
    "trot": (0.0, 0.5, 0.5, 0.0),
    "pace": (0.0, 0.5, 0.0, 0.5),
    "bound": (0.0, 0.0, 0.5, 0.5),
    "pronk": (0.0, 0.0, 0.0, 0.0),
    "lateral sequence": (0.0, 0.5, 0.75, 0.25),
    "diagonal sequence": (0.0, 0.5, 0.25, 0.75),
}
"""Touchdowns of FR FL RR RL after that of FR, in cycles. The last two have four beats: a walk or an amble, in which a
hind foot is followed by the fore foot of its side or of the other one (Hildebrand, Symmetrical gaits of horses,
Science 1965)."""

WALK_DUTY = 0.5
"""A gait of four beats whose feet are on the ground for more than this share of the time is a walk, else an amble."""


def distance(a: Array, b: ArrayLike) -> Array:
    """Return the distance of two phases around the circle, in cycles, 0 to 0.5."""
    return np.abs((a - np.asarray(b) + 0.5) % 1.0 - 0.5)


def _touchdowns(trace: Trace) -> Runs:
    return trace.phases.where(1, whole=False)


def _unbroken(trace: Trace, robot_index: int, times: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which strides, each from one of a foot's touchdowns (E,) to the next, have no pause in them (E - 1,)."""
    pauses = trace.pauses[times // trace.samples, robot_index]
    return pauses[1:] == pauses[:-1]


def _mean_phasors(trace: Trace) -> NDArray[np.complex128]:
    """(N, 4) mean over the strides of FR of exp(2 pi i phase) of each foot's touchdowns; NaN without any."""
    landed = _touchdowns(trace)
    leg, owner = landed.column % robot.NUM_LEGS, landed.column // robot.NUM_LEGS
    sums = np.zeros((trace.robots, robot.NUM_LEGS), complex)
    counts = np.zeros((trace.robots, robot.NUM_LEGS))
    for n in np.unique(owner):
        reference = landed.start[(owner == n) & (leg == FR)]
        if len(reference) < 2:
            continue
        whole = _unbroken(trace, n, reference)
        for foot in range(robot.NUM_LEGS):
            times = landed.start[(owner == n) & (leg == foot)]
            k = np.searchsorted(reference, times, side="right") - 1
            inside = (k >= 0) & (k < len(whole))
            inside &= whole[np.minimum(np.maximum(k, 0), len(whole) - 1)]
            k, times = k[inside], times[inside]
            turn = (times - reference[k]) / (reference[k + 1] - reference[k])
            sums[n, foot], counts[n, foot] = np.exp(2j * np.pi * turn).sum(), len(turn)
    missing = complex(np.nan, np.nan)
    return np.where(counts > 0, sums / np.maximum(counts, 1), missing)


@measure("touchdown_phase", unit="cycles", per="foot", circular=True)
def touchdown_phase(trace: Trace) -> Array:
    """Touchdown of each foot after that of FR, circular mean over strides, 0 to 1 (N, 4)."""
    mean = _mean_phasors(trace)
    turn = np.angle(mean) / (2.0 * np.pi)
    return np.where(np.abs(turn) < 1e-12, 0.0, turn) % 1.0


@measure("phase_consistency", unit="-", per="foot")
def phase_consistency(trace: Trace) -> Array:
    """Consistency of the strides: 1 if a foot always lands at the same phase, about 0 if at any (N, 4)."""
    return np.abs(_mean_phasors(trace))


def phase_error(phase: Array, gait: str) -> Array:
    """Return the largest circular distance (N,) of the feet's phases (N, 4) to those of a gait, in cycles."""
    return distance(phase, GAITS[gait]).max(-1)


@measure("trot_error", unit="cycles")
def trot_error(trace: Trace) -> Array:
    """Largest circular distance of FL, RR and RL to their phases in a trot: .5, .5 and 0 after FR (N,)."""
    return phase_error(touchdown_phase(trace), "trot")


def _errors(trace: Trace) -> tuple[list[str], Array]:
    """Names of the gaits, and the error of each, (G, N)."""
    phase = touchdown_phase(trace)
    return list(GAITS), np.stack([phase_error(phase, name) for name in GAITS])


@measure("gait", unit="name")
def gait(trace: Trace, *, largest_error: Fraction = 0.125, least_consistency: Fraction = 0.7) -> NDArray[np.str_]:
    """Nearest gait: trot, pace, bound, pronk, walk, amble; none if far from all; empty without strides (N,).

    ``largest_error``, cycles: half of the way from a trot to a walk. ``least_consistency`` of the least consistent
    foot.
    """
    names, errors = _errors(trace)
    defined = np.isfinite(errors.sum(0))
    best = np.where(defined, errors, np.inf).argmin(0)
    duty = duty_factor(trace).mean(-1)
    consistency = phase_consistency(trace).min(-1)
    result = []
    for n in range(trace.robots):
        name = names[best[n]]
        if not defined[n]:
            name = ""
        elif errors[best[n], n] > largest_error or consistency[n] < least_consistency:
            name = "none"
        elif name.endswith("sequence"):
            name = "walk" if duty[n] > WALK_DUTY else "amble"
        result.append(name)
    return np.array(result)


@measure("gait_clarity", unit="-")
def gait_clarity(trace: Trace) -> Array:
    """How clear the nearest gait is: 1 - its error / that of the second nearest; 1 for a pure one, 0 for a tie (N,)."""
    errors = np.sort(_errors(trace)[1], axis=0)
    return 1.0 - ratio(errors[0], errors[1])


@measure("duty_factor", unit="-", per="foot")
def duty_factor(trace: Trace) -> Array:
    """Share of the time in which each foot bears force (N, 4)."""
    return mean_over(trace.touching.astype(np.float32), np.repeat(trace.moving, trace.samples, axis=0))


@measure("stride_rate", unit="Hz")
def stride_rate(trace: Trace) -> Array:
    """Strides per second while they go on, the median over the feet that made two or more (N,)."""
    landed = _touchdowns(trace)
    rate = np.full((trace.robots * robot.NUM_LEGS,), np.nan)
    for column in np.unique(landed.column):
        times = landed.start[landed.column == column]
        if len(times) > 2 and (whole := _unbroken(trace, column // robot.NUM_LEGS, times)).any():
            rate[column] = 1.0 / (np.diff(times)[whole].mean() * trace.contact_dt)
    feet = rate.reshape(trace.robots, robot.NUM_LEGS)
    return np.array([np.median(r[np.isfinite(r)]) if np.isfinite(r).any() else np.nan for r in feet])


@measure("clearance", unit="m", per="foot")
def clearance(trace: Trace) -> Array:
    """Height of each sole over the ground at the top of its swing, mean over whole swings (N, 4)."""
    height = np.moveaxis(trace.need("foot_height"), 0, -1).reshape(-1, trace.steps).astype(np.float64)
    swing = trace.phases.where(0, whole=True)
    top = largest_within(height, swing.column, swing.start // trace.samples, (swing.stop - 1) // trace.samples + 1)
    columns = trace.robots * robot.NUM_LEGS
    total = np.bincount(swing.column, top - robot.FOOT_RADIUS, columns)
    return ratio(total, np.bincount(swing.column, minlength=columns)).reshape(trace.robots, robot.NUM_LEGS)


@measure("flight_share", unit="-")
def flight_share(trace: Trace) -> Array:
    """Share of the time with no foot on the ground (N,)."""
    flying = (~trace.touching).all(-1).astype(np.float32)
    return mean_over(np.asarray(flying), np.repeat(trace.moving, trace.samples, axis=0))
