"""Profile likelihood of effects of the whole robot: every value is scored by initial states that suit it.

Initial states that were moved to suit the nominal model hide a part of what is missing. Where feet slip or land, a fit
at those states stops early: a payload of 2 kg on a walk comes out as 1 kg, and the truth looks worse than nothing. So
for every value the windows begin at the states that sensors measure, which are then moved to suit that value alone.
Where feet stick, derivatives say little. So values on a ladder are tried, and then values between the best rungs.

In all functions ``score`` is what :func:`begun` returns, ``windows`` (V,) are the numbers of those that count, and
``dt`` is the physics step, s.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar

from go1exp.gap.replay.rows import Key, Theta, variants
from go1exp.gap.score.initial_state import FARTHEST, solved
from go1exp.gap.score.likelihood import Scorer, gram, log_chi2, scorer
from go1exp.gap.search import thresholds
from go1exp.sim.effects.base import Param
from go1exp.sim.effects.tolerances import declared


def begun(score: Scorer, dt: float) -> Scorer:
    """Return a scorer with the same floors whose initial states are those that sensors tell."""
    assert score.expected is not None
    replayer = dataclasses.replace(score.replayer, windows=score.expected)
    return scorer(replayer, {}, score.scale, dt, score.clock_s)


def chi2(score: Scorer, theta: Theta, windows: np.ndarray, dt: float) -> np.ndarray:
    """Return chi2 per value (V, 1) of a model, each window's initial state moved to suit it.

    What the states are away from what sensors tell counts as much as readings do.
    """
    w = score.windows
    joints, coordinates = len(w.joints), 2 * len(w.joints) + w.base_sd.shape[1]
    sd = np.concatenate([w.q_sd, w.qd_sd, w.base_sd], axis=1)[windows]
    state = score.state[windows]
    rows = variants(score.replayer.machine, theta, windows, [])

    def at(off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved = off * sd
        q, qd, base = moved[:, :joints], moved[:, joints : 2 * joints], moved[:, 2 * joints :]
        residual = score.residual(dataclasses.replace(rows, q=q, qd=qd, base=base), dt)
        # As if the state had stayed, and the change by it were a line: then the priors are those of the metric.
        back = residual + (state[..., :coordinates] @ off[:, None, :, None].astype(np.float32))[..., 0]
        return residual, np.asarray(gram(back[..., None], state)[..., 0, 0] / score.size[windows][:, None])

    off = np.zeros((len(windows), coordinates))
    residual, best = at(off)
    for _ in range(thresholds.STATE_ROUNDS):
        step = solved(state[:, 0], residual[:, 0], off)[0][:, :coordinates].clip(-FARTHEST, FARTHEST)
        begin = off.copy()
        for share in thresholds.STATE_STEPS:
            other, value = at(begin + share * step)
            better = value[:, 0] < best[:, 0]
            off[better], residual[better], best[better] = (begin + share * step)[better], other[better], value[better]
    return best


def cost(score: Scorer, theta: Theta, windows: np.ndarray, dt: float) -> float:
    """Return what fits make small, the mean log :func:`chi2` (arguments as there)."""
    return float(log_chi2(chi2(score, theta, windows, dt)).mean())


def fitted(
    score: Scorer, keys: Sequence[Key], windows: np.ndarray, dt: float, nominal: float | None = None
) -> tuple[Theta, float]:
    """Return the values of an effect that fit best, one number for each parameter, one parameter after the other.

    Returns:
        The values and their cost.
    """
    theta: Theta = {}
    least = cost(score, {}, windows, dt) if nominal is None else nominal
    for key in keys:
        p = score.replayer.machine.tolerances.param(key)
        at, rungs = _along(score, key, theta, windows, dt), ladder(p)
        costs = [least if value == p.null else at(value) for value in rungs]
        k = int(np.argmin(costs))
        if rungs[k] == p.null:
            continue
        between = rungs[max(k - 1, 0)], rungs[min(k + 1, len(rungs) - 1)]
        nearest = minimize_scalar(at, bounds=between, options={"maxiter": thresholds.RUNG_TRIES})
        value, least = (nearest.x, float(nearest.fun)) if nearest.fun < costs[k] else (rungs[k], costs[k])
        theta = {**theta, key: _everywhere(score, key, value)}
    return theta, least


def _everywhere(score: Scorer, key: Key, value: float) -> np.ndarray:
    """Return one value of a parameter for all joints (J,), or for the robot (1,)."""
    wide = len(score.windows.joints) if declared(key).per == "joint" else 1
    return np.full(wide, value)


def _along(score: Scorer, key: Key, others: Theta, windows: np.ndarray, dt: float) -> Callable[[float], float]:
    """Return the cost as a function of one parameter, the others held."""
    return lambda value: cost(score, {**others, key: _everywhere(score, key, value)}, windows, dt)


def within_tolerances(score: Scorer, begin: Theta, keys: Sequence[Key], windows: np.ndarray, dt: float) -> Theta:
    """Return the values within their tolerances that fit best, alike at all joints, one parameter after the other."""
    limits = {key: _limits(score, key) for key in keys}
    theta = {key: value.clip(*limits[key]) for key, value in begin.items() if key in limits}
    least = cost(score, theta, windows, dt)
    for key in [*(k for k in keys if k not in theta), *theta]:
        nearest = minimize_scalar(
            _along(score, key, theta, windows, dt), bounds=limits[key], options={"maxiter": thresholds.RUNG_TRIES}
        )
        if nearest.fun < least:
            theta, least = {**theta, key: _everywhere(score, key, nearest.x)}, float(nearest.fun)
    return theta


def at_one_part(
    score: Scorer, begin: Theta, keys: Sequence[Key], parts: Iterable[frozenset[int]], windows: np.ndarray, dt: float
) -> Theta:
    """Return values within their tolerances of which those of one part's joints are off together, if that fits better.

    All of them at one end of their tolerances come first, since several that are off a little together are what none
    of them shows by itself; of the best part and end each is then fitted.
    """
    theta, least, better = begin, cost(score, begin, windows, dt), frozenset[int]()
    for part in parts:
        for end in (0, 1):
            tried = begin
            for key in keys:
                tried = _with_part(score, tried, key, part, _limits(score, key)[end])
            if (now := cost(score, tried, windows, dt)) < least:
                theta, least, better = tried, now, part
    for key in keys if better else ():
        along = partial(_with_part, score, theta, key, better)
        nearest = minimize_scalar(
            lambda value, along=along: cost(score, along(value), windows, dt),
            bounds=_limits(score, key),
            options={"maxiter": thresholds.RUNG_TRIES},
        )
        if nearest.fun < least:
            theta, least = along(nearest.x), float(nearest.fun)
    return theta


def _limits(score: Scorer, key: Key) -> tuple[float, float]:
    """Return the ends of a parameter's tolerance."""
    p = score.replayer.machine.tolerances.param(key)
    return max(p.low, p.null - p.tolerance), min(p.high, p.null + p.tolerance)


def _with_part(score: Scorer, theta: Theta, key: Key, part: frozenset[int], value: float) -> Theta:
    """Return the values with those of one parameter at the joints of a part replaced."""
    p = score.replayer.machine.tolerances.param(key)
    values = np.broadcast_to(theta.get(key, np.array([p.null])), (len(score.windows.joints),)).copy()
    values[[*part]] = value
    return {**theta, key: values}


def ladder(p: Param) -> list[float]:
    """Return the values of a parameter that are tried first, in order, the null value among them."""
    rungs, far = {p.null}, thresholds.FIRST_RUNG * p.tolerance
    while p.null - far >= p.low or p.null + far <= p.high:
        rungs |= {v for v in (p.null - far, p.null + far) if p.low <= v <= p.high}
        far *= 2.0
    return sorted(rungs)
