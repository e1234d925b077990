"""The last fit, its intervals, and whether a term is ``certified`` or ``compensating``.

Two errors beside noise enter an interval. A physics step of 1 ms changes readings as much as some parameters do. A
joint that meets its stop does so in one step or in the next, and that jump over a small change is no derivative.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from go1exp.config.schema.registry import members
from go1exp.gap.replay.rows import Key, Probe, Theta
from go1exp.gap.score.likelihood import excess, removed
from go1exp.gap.score.linear import Layout, Table, table, unbiased_grams
from go1exp.gap.search import significance, thresholds, tolerances
from go1exp.gap.search.candidates import at_bounds, on_bound
from go1exp.gap.search.fit import descend
from go1exp.gap.search.state import LastCheck, Search, State
from go1exp.sim.effects.tolerances import sizes


def resampled_values(search: Search) -> tuple[Theta, dict[Key, np.ndarray]]:
    """Fit once more, on all windows but those for the last check, and bootstrap the fit; nothing to do without terms.

    Returns:
        The values, and by fitted parameter of the terms their resampled values (B, J) or (B, 1). A value that is held,
        such as that of a law, has none.
    """
    if not search.state.terms:
        return search.state.theta, {}
    state = search.state.finer()
    fitted = np.sort(np.concatenate([search.splits.train, search.splits.select]))
    linear = state.linear(state.theta, fitted)
    steps = thresholds.LAST_STEPS if state.scorer.finer > 1 else 1
    best = descend(state.scorer, state.model(state.theta), linear, steps, search.dt)
    assert best.chi2 is not None
    assert best.residual is not None
    about = replace(linear, residual=best.residual, theta=best.theta)
    count = max(search.settings.bootstraps, thresholds.FEWEST_BOOTSTRAPS)
    drawn: dict[Key, list[np.ndarray]] = {}
    of_terms = [key for key in state.keys if key[0] in state.terms]
    for values in bootstrapped(state, about, best.chi2, search.rng, count, nominal=True):
        for key in of_terms:
            null = state.tolerances.param(key).null
            law = 1.0 + thresholds.LAW_SD * search.rng.standard_normal(values[key].shape)
            drawn.setdefault(key, []).append(null + (values[key] - null) * law)
    return best.theta, {key: np.stack([np.ravel(v) for v in values]) for key, values in drawn.items()}


def bootstrapped(
    state: State, linear: Table, chi2: np.ndarray, rng: np.random.Generator, count: int, nominal: bool
) -> Iterator[Theta]:
    """Yield values of the model by ``count`` bootstraps of episodes, to first order.

    ``linear`` is of the windows that are resampled, about the values that are; its columns are those about the values
    of ``state``; ``chi2`` (V, G) per value is theirs. With ``nominal`` the nominal values are drawn, too. They are
    themselves uncertain by their tolerances, and motion fixes many of them only relative to each other: that belongs
    into an interval.
    """
    layout, theta = Layout.from_probes(state.machine, linear.probes), linear.theta
    grams = _grams(state, linear) / np.maximum(chi2, 1.0)[..., None, None]
    limits = tolerances.bounds(layout, linear.probes, theta, state.may)
    episode, spread = state.scorer.windows.episode[linear.windows], 1.0 / np.sqrt(limits.weight)
    for _ in range(count):
        matrix, right = layout.total(grams[significance.resampled(episode, rng)])
        moved = spread * rng.standard_normal(layout.size) if nominal else 0.0
        x = tolerances.solve(semidefinite(matrix), right, replace(limits, centre=limits.centre + moved))
        yield tolerances.moved(theta, layout, linear.probes, x, state.machine)


def _grams(state: State, linear: Table) -> np.ndarray:
    """Return the Gram matrices of a linear model; off the ground without what errors of the columns add to them."""
    scorer = state.scorer
    if state.machine.on_ground:  # contact bends what a change does, so two of them differ by more than errors
        return linear.grams(scorer)
    probes = opposite(state, linear.probes)
    other = table(scorer, state.theta, linear.windows, probes, state.dt)
    keys = [p.key for p in probes if isinstance(p.key, tuple)]  # all of them
    tolerance = np.array([state.tolerances.param(key).tolerance for key in keys])
    needed = np.array([effect in state.terms for effect, _ in keys])
    return unbiased_grams(scorer, linear, other, np.where(np.isfinite(tolerance), tolerance, 0.0), needed)


def opposite(state: State, probes: Sequence[Probe]) -> list[Probe]:
    """Return other changes of the same parameters: the other way, or half as far at a bound; shapes keep theirs."""
    turned = []
    for probe in probes:
        assert isinstance(probe.key, tuple)
        p = state.tolerances.param(probe.key)
        back = state.theta.get(probe.key, np.array([p.null])) - probe.delta
        room = (back >= p.low) & (back <= p.high)
        other = np.where(room, -probe.delta, 0.5 * probe.delta)
        turned.append(Probe(probe.key, probe.place, other if math.isfinite(p.tolerance) else probe.delta))
    return turned


def semidefinite(matrix: np.ndarray) -> np.ndarray:
    """Return a symmetric matrix (n, n) without its negative eigenvalues, taken with a diagonal of ones.

    Errors are subtracted on average only, so along unidentifiable directions the matrix can be indefinite.
    """
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
    value, vector = np.linalg.eigh(matrix * inverse[:, None] * inverse)
    positive = (vector * np.maximum(value, 0.0)) @ vector.T
    return np.asarray(positive * scale[:, None] * scale)


def first_on_bound(search: Search, effect: str, theta: Theta, joints: Sequence[str]) -> str:
    """Return which value of a term lies on the bound of its parameter, in words; empty if none does."""
    everyone, known = search.state.scorer.windows.joints, search.state.tolerances
    for key in sizes(effect):
        for bound, at in at_bounds(key, theta, known).items():
            if known.param(key).per != "joint":
                if at.any():
                    return on_bound(key, bound, "", known)
                continue
            for joint in np.array(everyone)[np.broadcast_to(at, len(everyone))]:
                if joint in joints:
                    return on_bound(key, bound, joint, known)
    return ""


def exact_aliases(search: Search, effect: str, joints: Sequence[str]) -> tuple[str, ...]:
    """Return effects whose influence on these data is that of a term, up to a factor, at all joints where it is.

    By the Jacobian of what may move: columns that are parallel. Where a model guesses its gains, all effects that act
    as a change of the gains are one set: only where a torque meets its limit do they differ together.
    """
    state, linear = search.state, search.state.table
    layout = Layout.from_probes(state.machine, linear.probes)
    chi2 = state.scorer.chi2(linear.residual, linear.windows)
    matrix, _ = layout.total(linear.grams(state.scorer) / np.maximum(chi2, 1.0)[..., None, None])
    everyone = state.scorer.windows.joints
    effects = np.array([linear.probes[k].key[0] for k in layout.probe])
    at = np.isin(layout.joint, [-1, *(everyone.index(j) for j in joints)])
    of_gains = {name for name in members("effect") if tolerances.identification(name).of_gains}
    one_set = state.machine.guessed_gains and effect in of_gains
    columns = np.flatnonzero((effects == effect) & at)

    def acts_alike(name: str) -> bool:
        return all(
            spanned(matrix, int(i), np.flatnonzero((effects == name) & (layout.joint == layout.joint[i])))
            for i in columns
        )

    parallel = {name for name in effects if name != effect and acts_alike(name)} if len(columns) else set()
    return tuple(sorted(parallel | (of_gains - {effect} if one_set else set())))


def spanned(matrix: np.ndarray, column: int, others: np.ndarray) -> bool:
    """Return whether columns (K,) span another one, by the normal equations (size, size) of all."""
    power = matrix[column, column]
    if not len(others) or not power > 0.0:
        return False
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix)[others], 1e-300))
    part = matrix[np.ix_(others, others)] * scale[:, None] * scale
    right = matrix[others, column] * scale
    left = power - right @ np.linalg.lstsq(part, right, rcond=1e-9)[0]
    return bool(left < thresholds.PARALLEL * power)


def doubt(search: Search, effect: str, theta: Theta, joints: Sequence[str], adequate: bool, check: LastCheck) -> str:
    """Return why a term is not certified; empty if it is."""
    stable, alone = search.shares.get(effect, 0.0), search.removes(effect)
    rivals = [name for name in search.aliases.get(effect, ()) if name != effect]
    if not check.helps:
        return "the last check does not confirm it"
    if not math.isnan(check.closed) and check.closed < thresholds.HALF:
        return f"on the last check only {max(check.closed, 0.0):.0%} of the excess goes"
    closes = adequate and search.first > search.settings.adequate
    if stable < (min(thresholds.MAJORITY, search.settings.certified) if closes else search.settings.certified):
        return f"it is named again in {stable:.0%} of the resamples only"
    if not joints and any(search.state.tolerances.param(key).per == "joint" for key in sizes(effect)):
        return "it leaves its tolerance at no joint beyond doubt"
    if bound := first_on_bound(search, effect, theta, joints):
        return bound
    if len(joints) == 1 and search.marginal and search.first - excess(search.select_chi2) < search.settings.material:
        return "the tolerances do nearly as well, and at one joint many effects act alike"
    if adequate:
        return ""
    if not alone > thresholds.BESIDE_GAP_SHARE:  # NaN too
        share = "less" if math.isnan(alone) else f"{max(alone, 0.0):.0%}"
        return f"a gap remains, and of what there is without it, it removes only {share}"
    return f"a gap remains, and {' and '.join(rivals)} would do as well" if rivals else ""


def beside_a_gap(search: Search, effect: str) -> float:
    """Return the relative half width that what remains adds to the 95 % intervals of a term's values."""
    goes = search.removes(effect)
    if math.isnan(goes):
        goes = removed(search.first, excess(search.select_chi2))
    return thresholds.HALF_WIDTH * thresholds.BIAS_SD * math.sqrt(min(max(1.0 - goes, 0.0), 1.0))


def widened(
    value: np.ndarray, low: np.ndarray, high: np.ndarray, null: float, share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return intervals (low, high) of values, wider by a share of what each is off null; independent errors add up."""
    bias = share * np.abs(value - null)
    return value - np.hypot(value - low, bias), value + np.hypot(high - value, bias)
