"""What is written down of every candidate: where it acts, how large, and why it was taken or not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from go1exp.gap.replay.machine import Machine
from go1exp.gap.replay.rows import Key, Theta
from go1exp.gap.result import Candidate
from go1exp.gap.search import thresholds
from go1exp.gap.search.fit import Model
from go1exp.sim.effects.tolerances import Tolerances, effect_class, sizes


def deviation(theta: Theta, key: Key, tolerances: Tolerances) -> np.ndarray:
    """Return how far a parameter is from null, in tolerances; 1 for a value that lies on its tolerance."""
    p = tolerances.param(key)
    away = np.asarray(np.abs(theta.get(key, np.array([p.null])) - p.null) / p.tolerance)
    return np.where(np.abs(away - 1.0) < thresholds.ROUNDING, 1.0, away)


def size(effect: str, theta: Theta, tolerances: Tolerances) -> float:
    """Return the largest deviation of an effect from null, in tolerances."""
    return max(float(np.max(deviation(theta, key, tolerances))) for key in sizes(effect))


def beyond(effect: str, theta: Theta, joints: Sequence[str], tolerances: Tolerances) -> np.ndarray:
    """Return at which joints (J,) an effect leaves its tolerance."""
    outside = np.zeros(len(joints), dtype=bool)
    for key in sizes(effect):
        if tolerances.param(key).per == "joint":
            outside |= np.broadcast_to(deviation(theta, key, tolerances) > 1.0, len(joints))
    return outside


def at_bound(key: Key, theta: Theta, tolerances: Tolerances) -> np.ndarray:
    """Return which values of a parameter (J,) or (1,) leave their tolerance and lie on a bound of the parameter."""
    p = tolerances.param(key)
    values = np.ravel(theta.get(key, np.array([p.null])))
    near = [np.abs(values - bound) <= thresholds.AT_BOUND * p.tolerance for bound in (p.low, p.high)]
    return np.asarray((near[0] | near[1]) & (np.abs(values - p.null) > p.tolerance))


def bounded(effect: str, theta: Theta, joints: Sequence[str], tolerances: Tolerances) -> np.ndarray:
    """Return at which joints (J,) a value of an effect lies on its bound, beyond its tolerance."""
    per_key = [at_bound(key, theta, tolerances) for key in sizes(effect)]
    return np.any([np.broadcast_to(one, len(joints)) for one in per_key], axis=0)


def count(effect: str, theta: Theta, machine: Machine) -> int:
    """Return how many values of an effect leave their tolerance, at least 1; one for all joints counts once."""
    beyond_it = 0
    for key in sizes(effect):
        outside = np.atleast_1d(deviation(theta, key, machine.tolerances) > 1.0)
        beyond_it += min(int(outside.sum()), 1) if effect_class(effect).identification.common else int(outside.sum())
    return max(beyond_it, 1)


def parameters(model: Model) -> int:
    """Return how many parameters a fitted model uses, at least 1: shapes, and those that leave their tolerance."""
    known = model.may.tolerances
    used = [key for key in model.keys if not math.isfinite(known.param(key).tolerance)]
    used += [key for key in sizes(model.name) if float(np.max(deviation(model.theta, key, known))) > 1.0]
    return max(len(used), 1)


def candidate(model: Model, joints: Sequence[str], **judged: object) -> Candidate:
    """Write a fitted model down; ``judged`` are the other fields of :class:`~go1exp.gap.result.Candidate`."""
    tolerances = model.may.tolerances
    where = beyond(model.name, model.theta, joints, tolerances)
    params: dict[str, list[float] | float] = {}
    for key, value in model.theta.items():
        if key[0] == model.name:
            per_joint = tolerances.param(key).per == "joint"
            full = np.broadcast_to(value, len(joints)) if per_joint else value
            params[key[1]] = [float(v) for v in full[where]] if per_joint else float(full[0])
    names = tuple(j for j, b in zip(joints, where, strict=True) if b)
    largest = size(model.name, model.theta, tolerances)
    return Candidate(effect=model.name, joints=names, params=params, size_over_tolerance=largest, **judged)  # type: ignore[arg-type]


def absorbed(
    search_keys: Sequence[Key], relief: Mapping[str, float], theta: Theta, tolerances: Tolerances, most: int
) -> list[Candidate]:
    """Return, for a gap that the tolerances close, the effects that would rather leave theirs, strongest first.

    None of them is claimed: all that the data ask for lies within what the model may be wrong by anyway.

    Args:
        search_keys: parameters of the box.
        relief: effect -> fall of chi2 and priors if it may.
        theta: fitted values within the tolerances.
        tolerances: these.
        most: rows.
    """
    order = sorted((e for e in relief if relief[e] > thresholds.LISTED_RELIEF), key=lambda e: -relief[e])
    return [
        Candidate(
            effect=effect,
            joints=(),
            params={},
            excess_after=math.nan,
            log_gain=0.0,
            p=math.nan,
            size_over_tolerance=max(
                float(np.max(deviation(theta, k, tolerances))) for k in search_keys if k[0] == effect
            ),
            alias_class=(effect,),
            status="rejected",
            reason=f"fits within its tolerance; without it chi2 would be {relief[effect]:.0f} lower",
        )
        for effect in order[:most]
    ]


def inaudible(signal: Mapping[str, float], threshold: float, judged: Sequence[str]) -> list[Candidate]:
    """Return rows for the effects that the data cannot show."""
    return [
        Candidate(
            effect, (), {}, math.nan, 0.0, 1.0, 0.0, (effect,), "not excited", "twice its tolerance would not show"
        )
        for effect, loud in signal.items()
        if loud < threshold and effect not in judged
    ]
