"""Whether the values of a cause may be the same at all joints, as far as a recording tells each of them.

A low battery weakens all drives alike. What is wrong in another way takes other values at each joint: a payload, called
heavier links, makes them 1.13 to 1.88 times as heavy. So values that are fitted joint by joint must agree within one
tolerance. But each is uncertain, and the largest and the least of twelve are those that noise took farthest: offsets of
9 mrad at all joints of a walking robot came out as 6.9 to 11.1 mrad. So a difference counts by how much it exceeds the
tolerance in its own standard errors, and is compared with the largest of all that resamples of the windows differ by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from go1exp.gap.score.linear import table
from go1exp.gap.search import thresholds, tolerances
from go1exp.gap.search.fit import Model
from go1exp.gap.search.last_fit import bootstrapped
from go1exp.gap.search.state import State


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
    """Return whether each parameter of a cause may be the same at all joints, to one tolerance.

    Args:
        model: fitted joint by joint.
        state: whose initial states suit it.
    """
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
