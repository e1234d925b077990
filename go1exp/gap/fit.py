"""Bounded Gauss-Newton fits of several models side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from go1exp.gap import box
from go1exp.gap.likelihood import Layout, Scorer, Table, differences
from go1exp.gap.replay import Key, Rows, Theta, variants


@dataclass(frozen=True)
class Model:
    """A model to fit or fitted.

    Attributes:
        name: of the effect that it is about.
        theta: values.
        free: effects that may leave their tolerances.
        keys: parameters whose columns are refreshed in every step; the rest keep those of the common table.
        chi2: (V, G) per value, on the windows of the fit.
        error: standard errors by key, of the linear model with chi2 as it is.
    """

    name: str
    theta: Theta
    free: frozenset[str]
    keys: tuple[Key, ...]
    chi2: np.ndarray | None = None
    error: Theta | None = None


def stacked(parts: Sequence[Rows]) -> Rows:
    """Put rows one below the other; effects that one has not are null there."""
    from go1exp.gap.replay import null

    effects = dict.fromkeys(effect for rows in parts for effect, _ in rows.values)
    keys = {key: value for effect in effects for key, value in null(effect).items()}
    values = {}
    for key, value in keys.items():
        wide = max(rows.values[key].shape[1] for rows in parts if key in rows.values)
        columns = [rows.values.get(key, np.broadcast_to(value, (len(rows.window), wide))) for rows in parts]
        values[key] = np.concatenate(columns)
    moved = [np.concatenate([getattr(rows, name) for rows in parts]) for name in ("q", "qd")]
    return Rows(np.concatenate([rows.window for rows in parts]), values, *moved)


def residuals(scorer: Scorer, thetas: Sequence[Theta], windows: np.ndarray, dt: float) -> np.ndarray:
    """Return the residuals (M, V, G, m) of several models."""
    machine = scorer.replayer.machine
    rows = stacked([variants(machine, theta, windows, []) for theta in thetas])
    found = scorer.residual(rows, dt)
    return found.reshape(len(thetas), len(windows), *found.shape[1:])


def scores(scorer: Scorer, thetas: Sequence[Theta], windows: np.ndarray, dt: float) -> np.ndarray:
    """Return chi2 per value (M, V, G) of several models."""
    found = residuals(scorer, thetas, windows, dt)
    return np.stack([scorer.chi2(one, windows) for one in found])


def fit(scorer: Scorer, models: Sequence[Model], common: Table, iterations: int, dt: float) -> list[Model]:
    """Fit models on the windows of ``common``, whose columns they share but for those of their own ``keys``.

    Minimises the sum of log chi2 over windows and groups, so that a few violent windows do not decide. A step that
    does not help is cut.
    """
    machine, windows = scorer.replayer.machine, common.windows
    best: list[Model] = list(models)
    goal = np.full(len(models), np.inf)
    tries, steps = [m.theta for m in models], [np.empty(0)] * len(models)
    columns: list[tuple[list, Layout]] = [([], Layout.of(machine, []))] * len(models)
    for turn in range(iterations + 1):
        found = residuals(scorer, tries, windows, dt)
        chi2 = [scorer.chi2(one, windows) for one in found]
        values = [np.log(c).sum() for c in chi2]
        better = [k for k in range(len(models)) if values[k] < goal[k] - 1e-3]
        last = turn == iterations
        for k in better:
            goal[k] = values[k]
            best[k] = replace(models[k], theta=tries[k], chi2=chi2[k])
        if better:
            own = _refreshed(scorer, [best[k] for k in better], windows, dt)
            for k, (probes, fresh) in zip(better, own, strict=True):
                kept = [i for i, p in enumerate(common.probes) if p.key not in models[k].keys]
                every = [*(common.probes[i] for i in kept), *probes]
                layout = Layout.of(machine, every)
                whole = np.concatenate([common.columns[..., kept], fresh], axis=-1)
                grams = Table(windows, tuple(every), found[k], whole).grams(scorer)
                weight = 1.0 / np.maximum(chi2[k], 1.0)
                matrix, right = layout.total(grams * weight[..., None, None])
                limits = box.bounds(layout, every, best[k].theta, models[k].free)
                steps[k], columns[k] = box.solve(matrix, right, limits), (every, layout)
                if last or not np.any(steps[k]):
                    continue
            if last:
                pass
        for k in range(len(models)):
            if k not in better:
                steps[k] = 0.35 * steps[k]
            if len(steps[k]):
                tries[k] = box.moved(best[k].theta, columns[k][1], columns[k][0], steps[k], machine)
    return best


def _refreshed(scorer: Scorer, models: Sequence[Model], windows: np.ndarray, dt: float) -> list[tuple[list, np.ndarray]]:
    """Return probes and columns (V, G, m, p) of the models' own keys at their values."""
    machine, replayer = scorer.replayer.machine, scorer.replayer
    lots = [box.probes(machine, m.keys, m.theta) for m in models]
    if not any(lots):
        return [([], differences(scorer, np.repeat(scorer.windows.y[windows][:, None], 1, axis=1), windows, [])) for _ in models]
    parts = [variants(machine, m.theta, windows, probes) for m, probes in zip(models, lots, strict=True)]
    y = replayer.run(stacked(parts), 2.0 * dt)
    found, at = [], 0
    for probes, rows in zip(lots, parts, strict=True):
        mine = y[at : at + len(rows.window)].reshape(len(windows), 1 + len(probes), *y.shape[1:])
        at += len(rows.window)
        found.append((probes, differences(scorer, mine, windows, probes)))
    return found


def errors(scorer: Scorer, model: Model, full: Table) -> Theta:
    """Return standard errors of a model's parameters from the curvature at its fit, noise as large as the misfit."""
    machine = scorer.replayer.machine
    layout = Layout.of(machine, full.probes)
    grams = full.grams(scorer)
    chi2 = grams[..., -1, -1] / scorer.size[full.windows][:, None]
    matrix, _ = layout.total(grams / np.maximum(chi2, 1.0)[..., None, None])
    limits = box.bounds(layout, full.probes, model.theta, model.free)
    spread = np.sqrt(np.diag(np.linalg.inv(matrix + np.diag(limits.weight))))
    found: Theta = {}
    for i in range(layout.size):
        key = full.probes[layout.probe[i]].key
        assert isinstance(key, tuple)
        wide = len(machine.joints) if box.param(key).per == "joint" else 1
        found.setdefault(key, np.zeros(wide))[max(int(layout.joint[i]), 0)] = spread[i]
    return found
