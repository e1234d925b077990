"""One effect of the whole robot against a hundred tolerances, for a robot that stands.

On the ground the tolerances of twelve joints together imitate an effect on the trunk up to several times its own
tolerance. So an effect with a few numbers, of the trunk or shared by all joints, is fitted alone first, all else at its
nominal value. It is the explanation if it removes nearly all of the error and no other effect does as well. An effect
of the joints must also do better than tolerances that all joints share, and stay shared where each joint is fitted by
itself, within the standard errors of the estimates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from go1exp.config.schema.registry import members
from go1exp.gap.replay.rows import Theta
from go1exp.gap.score.likelihood import Scorer, excess, log_chi2, removed
from go1exp.gap.score.linear import table
from go1exp.gap.search import profile_likelihood, reduction, significance, thresholds, tolerances
from go1exp.gap.search.certainty import bootstrapped
from go1exp.gap.search.fit import Model, fit, scores
from go1exp.gap.search.state import Search, State
from go1exp.sim.effects.tolerances import effect_class, sizes


def differ(values: np.ndarray, drawn: np.ndarray, tolerance: float) -> bool:
    """Return whether some of the values differ by more than a tolerance beyond doubt.

    If none of them truly does, two estimates differ by at most the tolerance and the difference of their errors. So the
    largest of all pairs, each in its own standard errors, is compared with the largest that errors alone make.

    Args:
        values: (J,) estimates.
        drawn: (B, J) the same by resamples.
        tolerance: by which they may truly differ.
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
    """What comes of looking for one cause by initial states of its own.

    Attributes:
        best: the clearest cause, or None.
        within: values within tolerances that do most of what the best cause does, alike at all joints but for the
            drives of one part; empty where nothing had to be asked of them.
    """

    best: Model | None
    within: Theta


def clearest(begun: Scorer, state: State) -> Sought:
    """Return the effect of the whole robot, or alike at all joints, that does best by initial states of its own.

    Returns:
        No cause unless, on windows that no fit has seen, it does clearly better than all others and nothing at all; one
        of the joints also better than joints that are all off alike within their tolerances.
    """
    train, select, dt = state.splits.train, state.splits.select, state.dt
    none = profile_likelihood.cost(begun, {}, train, dt)
    of_trunk = [n for n in tolerances.nominal(begun.replayer.machine) if tolerances.identification(n).needs_ground]
    of_joints = [effect for effect in members("effect") if tolerances.identification(effect).uniform]
    fits = {
        effect: profile_likelihood.fitted(begun, sizes(effect), train, dt, none) for effect in (*of_trunk, *of_joints)
    }
    name = min(fits, key=lambda effect: fits[effect][1])
    best = fits.pop(name)[0]
    if not best:
        return Sought(None, {})
    chi2 = profile_likelihood.chi2(begun, best, select, dt)

    def loses(rival: Theta) -> bool:
        other = profile_likelihood.chi2(begun, rival, select, dt)
        return bool(significance.gains(chi2, other[None]).mean() < -thresholds.SAME_GAIN)

    clear = loses({}) and all(loses(rival) for rival, _ in fits.values() if rival)
    of_trunk_alone = clear and name in of_trunk
    within = {} if of_trunk_alone else _off_alike(begun, best, train, dt)
    if of_trunk_alone or (clear and loses(within)):
        return Sought(Model(name, best, state.may.also(name), sizes(name)), within)
    return Sought(None, within)


def _off_alike(begun: Scorer, best: Theta, windows: np.ndarray, dt: float) -> Theta:
    """Return what does most of what ``best`` does within tolerances: it, drives and legs, off alike.

    Alike at all joints, and then the actuators of one part.
    """
    known = members("effect")
    effects = [
        name
        for name in tolerances.nominal(begun.replayer.machine)
        if tolerances.identification(name).weighs_on_legs or known[name].traits.get("gains")
    ]
    keys = list(dict.fromkeys([*(key for name in effects for key in sizes(name)), *best]))
    everywhere = profile_likelihood.within_tolerances(begun, best, keys, windows, dt)
    of_drives = [key for name in effects if not effect_class(name).fields for key in sizes(name)]
    joints = begun.windows.joints
    return profile_likelihood.at_one_part(begun, everywhere, of_drives, reduction.parts(joints), windows, dt)


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
    begun = profile_likelihood.begun(state.scorer, dt)
    sought = clearest(begun, state)
    if sought.best is None:
        return search, sought
    search, best = _confirmed(sought.best, search, test, plain, now)
    if best is not None:
        return search, Sought(best, {})
    return search, Sought(None, sought.within or _off_alike(begun, sought.best.theta, train, dt))


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
