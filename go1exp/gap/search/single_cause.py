"""One effect of the whole robot against a hundred tolerances, for a robot that stands.

On the ground the tolerances of twelve joints together imitate an effect on the trunk up to several times its own
tolerance. So an effect with a few numbers, of the trunk or shared by all joints, is fitted alone first, all else at its
nominal value. It is the explanation if it removes nearly all of the error and no other effect does as well. An effect
of the joints must also do better than tolerances that all joints share, and stay shared where each joint is fitted by
itself, within the standard errors of the estimates.

Such effects are compared by profile likelihood: every value is scored by initial states that suit it. States that suit
the nominal model hide a part of what is missing: a payload of 2 kg on a walk comes out as 1 kg. So for every value the
windows begin at the states that sensors measure, and are then moved to suit that value alone. Where feet stick,
derivatives say little, so values on a ladder are tried, then values between the best rungs.

In all functions ``windows`` (V,) are the numbers of those that count, ``dt`` is the physics step, s, and ``score`` or
``first`` is what :func:`unmoved` returns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar

from go1exp.config.schema.registry import members
from go1exp.gap.replay.rows import Key, Theta, variants
from go1exp.gap.score.initial_state import FARTHEST, solved
from go1exp.gap.score.likelihood import Scorer, excess, gram, log_chi2, removed, scorer
from go1exp.gap.score.linear import table
from go1exp.gap.search import reduction, significance, thresholds, tolerances
from go1exp.gap.search.certainty import bootstrapped
from go1exp.gap.search.fit import Model, fit, scores
from go1exp.gap.search.state import Search, State
from go1exp.sim.effects.base import Param
from go1exp.sim.effects.tolerances import declared, effect_class, sizes


def unmoved(score: Scorer, dt: float) -> Scorer:
    """Return a scorer with the same floors whose initial states are those that sensors tell."""
    assert score.expected is not None
    replayer = dataclasses.replace(score.replayer, windows=score.expected)
    return scorer(replayer, {}, score.scale, dt, score.clock_s)


def profile_chi2(score: Scorer, theta: Theta, windows: np.ndarray, dt: float) -> np.ndarray:
    """Return chi2 per value (V, 1), initial states moved to suit the model; that counts as much as readings do."""
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


def profile_cost(score: Scorer, theta: Theta, windows: np.ndarray, dt: float) -> float:
    """Return what fits make small, the mean log :func:`profile_chi2` (arguments as there)."""
    return float(log_chi2(profile_chi2(score, theta, windows, dt)).mean())


def fitted_alike(
    score: Scorer, keys: Sequence[Key], windows: np.ndarray, dt: float, nominal: float | None = None
) -> tuple[Theta, float]:
    """Return the best values of an effect, one number a parameter, one after the other, and their cost."""
    theta: Theta = {}
    least = profile_cost(score, {}, windows, dt) if nominal is None else nominal
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
        theta = _with(score, theta, key, value)
    return theta, least


def _with(score: Scorer, theta: Theta, key: Key, value: float) -> Theta:
    """Return the values with one of a parameter alike at all joints (J,), or for the robot (1,)."""
    wide = len(score.windows.joints) if declared(key).per == "joint" else 1
    return {**theta, key: np.full(wide, value)}


def _along(score: Scorer, key: Key, others: Theta, windows: np.ndarray, dt: float) -> Callable[[float], float]:
    return lambda value: profile_cost(score, _with(score, others, key, value), windows, dt)


def within_tolerances(score: Scorer, begin: Theta, keys: Sequence[Key], windows: np.ndarray, dt: float) -> Theta:
    """Return the values within their tolerances that fit best, alike at all joints, one parameter after the other."""
    limits = {key: _limits(score, key) for key in keys}
    theta = {key: value.clip(*limits[key]) for key, value in begin.items() if key in limits}
    least = profile_cost(score, theta, windows, dt)
    for key in [*(k for k in keys if k not in theta), *theta]:
        nearest = minimize_scalar(
            _along(score, key, theta, windows, dt), bounds=limits[key], options={"maxiter": thresholds.RUNG_TRIES}
        )
        if nearest.fun < least:
            theta, least = _with(score, theta, key, nearest.x), float(nearest.fun)
    return theta


def at_one_part(
    score: Scorer, begin: Theta, keys: Sequence[Key], parts: Iterable[frozenset[int]], windows: np.ndarray, dt: float
) -> Theta:
    """Return values within their tolerances of which those of one part's joints are off together, if that fits better.

    All of them at one end of their tolerances come first, since several that are off a little together are what none
    of them shows by itself; of the best part and end each is then fitted.
    """
    theta, least, better = begin, profile_cost(score, begin, windows, dt), frozenset[int]()
    for part in parts:
        for end in (0, 1):
            tried = begin
            for key in keys:
                tried = _with_part(score, tried, key, part, _limits(score, key)[end])
            if (now := profile_cost(score, tried, windows, dt)) < least:
                theta, least, better = tried, now, part
    for key in keys if better else ():
        along = partial(_with_part, score, theta, key, better)
        nearest = minimize_scalar(
            lambda value, along=along: profile_cost(score, along(value), windows, dt),
            bounds=_limits(score, key),
            options={"maxiter": thresholds.RUNG_TRIES},
        )
        if nearest.fun < least:
            theta, least = along(nearest.x), float(nearest.fun)
    return theta


def _limits(score: Scorer, key: Key) -> tuple[float, float]:
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


# ---------------------------------------------------------------------- one cause alone


def differ(values: np.ndarray, drawn: np.ndarray, tolerance: float) -> bool:
    """Return whether some values (J,) differ by more than a tolerance beyond doubt; ``drawn`` (B, J) are resamples.

    If none of them truly does, two estimates differ by at most the tolerance and the difference of their errors. So the
    largest of all pairs, each in its own standard errors, is compared with the largest that errors alone make.
    """
    one, other = np.triu_indices(len(values), 1)
    beyond = np.abs(values[one] - values[other]) - tolerance
    if not (beyond > 0.0).any():
        return False
    errors = drawn - drawn.mean(axis=0)
    apart = np.abs(errors[:, one] - errors[:, other])
    scale = np.sqrt((apart**2).mean(axis=0)) + 1e-9 * tolerance
    return bool((beyond / scale).max() > np.quantile((apart / scale).max(axis=1), 1.0 - thresholds.SHARED_LEVEL))


def may_be(model: Model, state: State) -> bool:
    """Return whether each parameter of a cause may be the same at all joints, to one tolerance."""
    known = model.may.tolerances
    parameters = [key for key in model.keys if key in model.theta and model.theta[key].size > 1]
    if all(np.ptp(model.theta[key]) <= known.param(key).tolerance for key in parameters):
        return True
    state = replace(state, terms=(model.name,), theta=model.theta)
    windows, probes = state.splits.train, tolerances.probes(state.machine, model.keys, model.theta)
    linear = table(state.scorer, model.theta, windows, probes, state.dt)
    chi2, rng = state.scorer.chi2(linear.residual, windows), np.random.default_rng(state.settings.seed)
    draws = list(bootstrapped(state, linear, chi2, rng, thresholds.SHARED_DRAWS, nominal=False))
    return not any(
        differ(model.theta[key], np.stack([draw[key] for draw in draws]), known.param(key).tolerance)
        for key in parameters
    )


def stretched(scorer: Scorer, model: Model, windows: np.ndarray, dt: float) -> Model:
    """Return a model with all that it departs from the null made as much larger or smaller as fits best."""
    if not model.theta:
        return model
    for _ in range(2):
        tries = []
        for factor in thresholds.STRETCHES:
            theta = {}
            for key, value in model.theta.items():
                p = model.may.tolerances.param(key)
                theta[key] = (p.null + factor * (value - p.null)).clip(p.low, p.high)
            tries.append(theta)
        chi2 = scores(scorer, tries, windows, dt)
        k = int(log_chi2(chi2).mean(axis=(1, 2)).argmin())
        model = replace(model, theta=tries[k], chi2=chi2[k])
        if k == 0:
            break
    return model


def refitted(scorer: Scorer, model: Model, windows: np.ndarray, dt: float) -> Model:
    """Return a model fitted from where it is, by initial states that suit it."""
    empty = table(scorer, {}, windows, [], dt)
    (fitted,) = fit(scorer, [model], empty, thresholds.CAUSE_STEPS, dt)
    return stretched(scorer, fitted, windows, dt)


@dataclass(frozen=True)
class Sought:
    """What comes of looking for one cause by initial states of its own."""

    best: Model | None  # the clearest cause, or None
    # values within tolerances that do most of what the best cause does, alike at all joints but for the drives of one
    # part; empty where nothing had to be asked of them
    within: Theta


def clearest(first: Scorer, state: State) -> Sought:
    """Return the effect of the whole robot, or alike at all joints, that does best by initial states of its own.

    Returns:
        No cause unless, on windows that no fit has seen, it does clearly better than all others and nothing at all; one
        of the joints also better than joints that are all off alike within their tolerances.
    """
    train, select, dt = state.splits.train, state.splits.select, state.dt
    none = profile_cost(first, {}, train, dt)
    of_trunk = [n for n in tolerances.nominal(first.replayer.machine) if tolerances.identification(n).needs_ground]
    of_joints = [effect for effect in members("effect") if tolerances.identification(effect).uniform]
    fits = {effect: fitted_alike(first, sizes(effect), train, dt, none) for effect in (*of_trunk, *of_joints)}
    name = min(fits, key=lambda effect: fits[effect][1])
    best = fits.pop(name)[0]
    if not best:
        return Sought(None, {})
    chi2 = profile_chi2(first, best, select, dt)

    def loses(rival: Theta) -> bool:
        other = profile_chi2(first, rival, select, dt)
        return bool(significance.gains(chi2, other[None]).mean() < -thresholds.SAME_GAIN)

    clear = loses({}) and all(loses(rival) for rival, _ in fits.values() if rival)
    of_trunk_alone = clear and name in of_trunk
    within = {} if of_trunk_alone else _off_alike(first, best, train, dt)
    if of_trunk_alone or (clear and loses(within)):
        return Sought(Model(name, best, state.may.also(name), sizes(name)), within)
    return Sought(None, within)


def _off_alike(first: Scorer, best: Theta, windows: np.ndarray, dt: float) -> Theta:
    """Return what does most of what ``best`` does within tolerances: it, drives and legs, at all joints or a part's."""
    known = members("effect")
    effects = [
        name
        for name in tolerances.nominal(first.replayer.machine)
        if tolerances.identification(name).weighs_on_legs or known[name].traits.get("gains")
    ]
    keys = list(dict.fromkeys([*(key for name in effects for key in sizes(name)), *best]))
    everywhere = within_tolerances(first, best, keys, windows, dt)
    of_drives = [key for name in effects if not effect_class(name).fields for key in sizes(name)]
    joints = first.windows.joints
    return at_one_part(first, everywhere, of_drives, reduction.parts(joints), windows, dt)


Test = Callable[[Search, Sequence[Model], State, np.ndarray, np.ndarray], tuple[Search, Model | None, Model | None]]
"""Tests fitted candidates on held-out windows (``stepwise.held_out_test``)."""


def cause(search: Search, test: Test) -> tuple[Search, Sought]:
    """Return the effect of the whole robot, or alike at all joints, that explains nearly everything by itself, if any.

    Effects are compared by initial states of their own, and the best is fitted again at states that suit it.

    Returns:
        The search, whose evidence has the best effect if it was tested, and that effect.
    """
    state = search.state
    train, select, dt, settings = state.splits.train, state.splits.select, state.dt, state.settings
    plain, now = (scores(state.scorer, [{}], part, dt)[0] for part in (train, select))
    if excess(now) < settings.material:
        return search, Sought(None, {})
    search.progress("looking for one cause alone", 0.08)
    first = unmoved(state.scorer, dt)
    sought = clearest(first, state)
    if sought.best is None:
        return search, sought
    search, best = _confirmed(sought.best, search, test, plain, now)
    if best is not None:
        return search, Sought(best, {})
    return search, Sought(None, sought.within or _off_alike(first, sought.best.theta, train, dt))


def _confirmed(
    best: Model, search: Search, test: Test, plain: np.ndarray, now: np.ndarray
) -> tuple[Search, Model | None]:
    """Return the clearest cause fitted joint by joint at states that suit it, if it still is the one cause."""
    state = search.state
    if state.settings.effects and best.name not in state.settings.effects:
        return search, None
    for _ in range(thresholds.CAUSE_TURNS):
        state = replace(state, theta=best.theta).updated()
        best = refitted(state.scorer, best, state.splits.train, state.dt)
    if not may_be(best, state):
        return search, None
    share = removed(excess(now), excess(state.held_out(best.theta)))
    search, accepted, _ = test(search, [best], state, plain, now)
    return search, best if accepted is not None and share >= thresholds.NEARLY_ALL else None
