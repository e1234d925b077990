"""Bounded Gauss-Newton fits of several models side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from go1exp.gap.replay.rows import Key, Machine, Probe, Rows, Theta, null, variants
from go1exp.gap.score.likelihood import Scorer, log_chi2
from go1exp.gap.score.linear import Layout, Table, corrected, differences
from go1exp.gap.search import thresholds, tolerances
from go1exp.sim.effects.tolerances import Tolerances


@dataclass(frozen=True)
class Model:
    """A model to fit or fitted."""

    name: str  # of the effect that it is about
    theta: Theta  # values
    may: tolerances.Freedom  # what may leave its tolerance
    # parameters whose columns are refreshed in every step; the rest keep those of the common table
    keys: tuple[Key, ...]
    chi2: np.ndarray | None = None  # (V, G) per value, on the windows of the fit
    residual: np.ndarray | None = None  # (V, G, m) there, in units of the noise


def stacked(parts: Sequence[Rows], known: Tolerances) -> Rows:
    """Put rows of a robot with these tolerances one below the other; effects that one has not are null there."""
    effects = dict.fromkeys(effect for rows in parts for effect, _ in rows.values)
    keys = {key: value for effect in effects for key, value in null(effect, known).items()}
    values = {}
    for key, value in keys.items():
        wide = max(rows.values[key].shape[1] for rows in parts if key in rows.values)
        columns = [rows.values.get(key, np.broadcast_to(value, (len(rows.window), wide))) for rows in parts]
        values[key] = np.concatenate(columns)
    moved = [np.concatenate([getattr(rows, name) for rows in parts]) for name in ("q", "qd", "base", "mount")]
    return Rows(np.concatenate([rows.window for rows in parts]), values, *moved)


def residuals(scorer: Scorer, thetas: Sequence[Theta], windows: np.ndarray, dt: float) -> np.ndarray:
    """Return the residuals (M, V, G, m) of several models."""
    machine = scorer.replayer.machine
    rows = stacked([variants(machine, theta, windows, []) for theta in thetas], machine.tolerances)
    flat = scorer.residual(rows, dt)
    return flat.reshape(len(thetas), len(windows), *flat.shape[1:])


def scores(scorer: Scorer, thetas: Sequence[Theta], windows: np.ndarray, dt: float) -> np.ndarray:
    """Return chi2 per value (M, V, G) of several models."""
    by_model = residuals(scorer, thetas, windows, dt)
    return np.stack([scorer.chi2(one, windows) for one in by_model])


def fit(scorer: Scorer, models: Sequence[Model], common: Table, iterations: int, dt: float) -> list[Model]:
    """Fit models on the windows of ``common``, whose columns they share but for those of their own ``keys``.

    Minimises the sum of log chi2 over windows and groups, so that a few violent windows do not decide. Every group of
    joints takes the length of step that suits it. Models that gain less than ``HOPELESS`` of the best one's gain after
    their first step are given up.
    """
    windows = common.windows
    first = common.residual[None] if len(models) == 1 and models[0].theta is common.theta else None
    tried = residuals(scorer, [m.theta for m in models], windows, dt) if first is None else first
    best = [_scored(scorer, m, r, windows) for m, r in zip(models, tried, strict=True)]
    origin = log_chi2(scorer.chi2(common.residual, windows)).sum()
    alive = list(range(len(models)))
    for turn in range(iterations):
        if not alive:
            break
        moves = _moves(scorer, [best[k] for k in alive], common, dt)
        tries = [
            _moved(scorer, best[k], move, length)
            for k, move in zip(alive, moves, strict=True)
            for length in thresholds.STEP_LENGTHS
        ]
        tried = residuals(scorer, tries, windows, dt)
        for n, k in enumerate(alive):
            lengths = slice(n * len(thresholds.STEP_LENGTHS), (n + 1) * len(thresholds.STEP_LENGTHS))
            best[k] = _longest(scorer, best[k], moves[n], tries[lengths], tried[lengths], windows)
        if turn == 0 and len(models) > 1:
            gain = {k: origin - misfit(best[k]) for k in alive}
            alive = [k for k in alive if gain[k] > 0.0 and gain[k] >= thresholds.HOPELESS * max(gain.values())]
    return best


def descend(scorer: Scorer, model: Model, linear: Table, steps: int, dt: float) -> Model:
    """Fit one model by columns that learn from each step (Broyden's method), as long as steps gain something."""
    layout, known = Layout.from_probes(scorer.replayer.machine, linear.probes), model.may.tolerances
    reached = float(log_chi2(scorer.chi2(linear.residual, linear.windows)).mean())
    for turn in range(steps):
        (model,) = fit(scorer, [replace(model, theta=linear.theta)], linear, 1, dt)
        last, reached = reached, float(log_chi2(_chi2(model)).mean())
        if turn == steps - 1 or (turn and last - reached < thresholds.BROYDEN_GAIN):
            break
        before, unit = tolerances.unknowns(layout, linear.probes, linear.theta, known)
        after, _ = tolerances.unknowns(layout, linear.probes, model.theta, known)
        assert model.residual is not None
        linear = replace(corrected(linear, layout, after - before, unit, model.residual), theta=model.theta)
    return model


def misfit(model: Model) -> float:
    """Return what a fit makes small: the sum of log chi2 over windows and groups."""
    return float(log_chi2(_chi2(model)).sum())


Move = tuple[list[Probe], Layout, np.ndarray, tolerances.Bounds]
"""Columns, whose unknowns they are, by how much those move, and their limits and priors."""


def _chi2(model: Model) -> np.ndarray:
    assert model.chi2 is not None
    return model.chi2


def _scored(scorer: Scorer, model: Model, residual: np.ndarray, windows: np.ndarray) -> Model:
    return replace(model, residual=residual, chi2=scorer.chi2(residual, windows))


def _moves(scorer: Scorer, models: Sequence[Model], common: Table, dt: float) -> list[Move]:
    windows, machine = common.windows, scorer.replayer.machine
    steps = []
    for model, (probes, fresh) in zip(models, _refreshed(scorer, models, windows, dt), strict=True):
        kept = [i for i, p in enumerate(common.probes) if p.key not in model.keys]
        every = [*(common.probes[i] for i in kept), *probes]
        layout = Layout.from_probes(machine, every)
        assert model.residual is not None
        columns = common.columns if len(kept) == len(common.probes) else common.columns[..., kept]
        whole = np.concatenate([columns, fresh], axis=-1) if probes else columns
        linear = replace(common, probes=tuple(every), residual=model.residual, columns=whole, theta=model.theta)
        grams = linear.grams(scorer)
        weight = 1.0 / np.maximum(_chi2(model), 1.0)
        matrix, right = layout.total(grams * weight[..., None, None])
        limits = tolerances.bounds(layout, every, model.theta, model.may)
        steps.append((every, layout, tolerances.solve(matrix, right, limits), limits))
    return steps


def _moved(scorer: Scorer, model: Model, move: Move, length: float | np.ndarray) -> Theta:
    columns, layout, x, _ = move
    return tolerances.moved(model.theta, layout, columns, x * length, scorer.replayer.machine)


def _prior(machine: Machine, move: Move, length: float) -> np.ndarray:
    """Return what the priors say against a move so far, by group of joints (G,); what all share costs each its part."""
    _, layout, x, limits = move
    cost = limits.weight * (length * x - limits.centre) ** 2
    shared = cost[layout.joint < 0].sum() / len(machine.groups)
    return np.array([cost[np.isin(layout.joint, joints)].sum() for joints in machine.groups]) + shared


def _longest(
    scorer: Scorer, model: Model, move: Move, tries: Sequence[Theta], tried: np.ndarray, windows: np.ndarray
) -> Model:
    """Return the model moved so far that each group of joints does best; what all share goes where most like it."""
    machine, layout = scorer.replayer.machine, move[1]
    chi2 = np.stack([_chi2(model), *(scorer.chi2(r, windows) for r in tried)])  # L V G
    lengths = np.array([0.0, *thresholds.STEP_LENGTHS])
    value = (scorer.size[windows][:, None] * log_chi2(chi2)).sum(axis=1)  # L G
    value += np.stack([_prior(machine, move, length) for length in lengths])
    which = value.argmin(axis=0)
    shared = int(value.sum(axis=1).argmin())
    lengths_of_joints = np.full(len(machine.joints), lengths[shared])
    for g, joints in enumerate(machine.groups):
        lengths_of_joints[list(joints)] = lengths[which[g]]
    theta = _moved(
        scorer, model, move, np.where(layout.joint < 0, lengths[shared], lengths_of_joints[layout.joint.clip(0)])
    )
    assert model.residual is not None
    stacked_residuals = np.concatenate([model.residual[None], tried])
    groups = np.arange(len(machine.groups))
    residual = np.moveaxis(stacked_residuals[which, :, groups], 0, 1)
    return replace(model, theta=theta, residual=residual, chi2=np.moveaxis(chi2[which, :, groups], 0, 1))


def _refreshed(
    scorer: Scorer, models: Sequence[Model], windows: np.ndarray, dt: float
) -> list[tuple[list, np.ndarray]]:
    """Return probes and columns (V, G, m, p) of the models' own keys at their values."""
    machine, replayer = scorer.replayer.machine, scorer.replayer
    lots = [tolerances.probes(machine, m.keys, m.theta) for m in models]
    if not any(lots):
        return [([], np.empty(0)) for _ in models]
    parts = [variants(machine, m.theta, windows, probes) for m, probes in zip(models, lots, strict=True)]
    y = replayer.run(stacked(parts, machine.tolerances), 2.0 * dt)
    refreshed, at = [], 0
    for probes, rows in zip(lots, parts, strict=True):
        replayed = y[at : at + len(rows.window)].reshape(len(windows), 1 + len(probes), *y.shape[1:])
        at += len(rows.window)
        refreshed.append((probes, differences(scorer, replayed, windows, probes)))
    return refreshed
