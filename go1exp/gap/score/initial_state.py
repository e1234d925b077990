"""First states of robots whose motion hangs on them: moved to where they fit best, and how far a line describes them.

A first state enters the score as a linear, Gaussian unknown (``likelihood.py``). On the ground that holds near the
state only: a foot touches down or slides earlier or later. So the states are first moved to where each window fits
best. What the line still misses, over what remains uncertain, and what the step of the engine changes beyond what a
first state could, count as noise of the window: one in which small causes have large effects loses its say, and claims
no gap.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from go1exp.gap.data.standing import StandingWindows
from go1exp.gap.replay.rows import Rows, Theta, variants
from go1exp.gap.replay.standing import StandingReplayer
from go1exp.gap.score.likelihood import Scorer, scorer

ROUNDS = 6
"""Times that states are moved at most; most have settled after two."""

LENGTHS = (1.0, 0.4)
"""Shares of a step to the best state that are tried."""

FARTHEST = 4.0
"""Longest step of a coordinate, in standard deviations."""

GAIN = 0.05
"""Fall of a window's log chi2 in a round below which it needs no more rounds."""

DRAWS = 4
"""States drawn from what remains uncertain."""


def solved(state: np.ndarray, residual: np.ndarray, off: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the likeliest unknowns (W, k), in standard deviations, and the roots (W, k, k) of their covariance.

    With ``off`` (W, l), the first l of them are by so much away from what was expected.
    """
    wide = state.astype(float)
    inner = np.swapaxes(wide, -1, -2) @ wide + np.eye(wide.shape[-1])
    right = (np.swapaxes(wide, -1, -2) @ residual[..., None].astype(float))[..., 0]
    if off is not None:
        right[:, : off.shape[1]] -= off
    x = np.linalg.solve(inner, right[..., None])[..., 0]
    return x, np.swapaxes(np.linalg.inv(np.linalg.cholesky(inner)), -1, -2)


def _with(score: Scorer, windows: StandingWindows) -> Scorer:
    """Return the scorer on other first states of the same windows; the batches of simulations are kept."""
    return dataclasses.replace(score, replayer=dataclasses.replace(score.replayer, windows=windows))


def _rescaled(score: Scorer, factor: np.ndarray) -> Scorer:
    """Return the scorer with ``factor`` (W, C, J) times the noise."""
    factor = np.where(np.isfinite(factor), factor, 1.0)
    long = np.broadcast_to(factor[:, None], (len(factor), score.windows.t.shape[1], *factor.shape[1:]))
    state = score.state / long.reshape(len(factor), 1, -1, 1)
    return dataclasses.replace(score, scale=score.scale * factor, state=state.astype(np.float32))


def _mean_square(score: Scorer, residual: np.ndarray) -> np.ndarray:
    """Return the mean square over time (W, C, J) of residuals (W, m)."""
    w = score.windows
    back = residual.reshape(len(w), w.t.shape[1], len(w.quantities), len(w.joints))
    return np.asarray(np.sum(back**2, axis=1) / w.valid.sum(1)[:, None, None])


def settled(
    replayer: StandingReplayer, dt: float, clock_s: float, theta: Theta | None = None
) -> tuple[Scorer, dict[str, float]]:
    """Move the windows' first states to where they fit best.

    Args:
        replayer: of a robot on its feet.
        dt: physics step, s.
        clock_s: as for ``likelihood.scorer``.
        theta: values of the model that they are to fit; the nominal one if None.

    Returns:
        The scorer of those windows, which does the same for other values, and the error of the step by quantity.
    """
    theta = theta or {}
    machine, everything = replayer.machine, np.arange(len(replayer.windows))
    own = 2 * len(machine.joints) + len(machine.base_probe)
    rows = variants(machine, theta, everything, [])
    fine = np.abs(replayer.run(rows, 0.5 * dt) - replayer.run(rows, dt))
    first = np.hypot(replayer.windows.scale, 2.0 * np.sqrt(np.mean(fine**2, axis=1)))
    score = scorer(replayer, theta, first, dt, clock_s)
    going, off = everything, np.zeros((len(everything), own))  # off: from the estimates, which still count
    for _ in range(ROUNDS):
        part = rows.part(going)
        residual = score.residual(part, dt)
        before = score.chi2(residual, going)[:, 0] + np.sum(off[going] ** 2, axis=1) / score.size[going]
        x, _ = solved(score.state[going, 0], residual[:, 0], off[going])
        step = np.zeros((len(everything), own))
        step[going] = x[:, :own].clip(-FARTHEST, FARTHEST)
        windows, length, best = score.windows, np.zeros(len(everything)), before
        assert isinstance(windows, StandingWindows)
        for tried in LENGTHS:
            trial = _with(score, windows.moved(tried * step))
            found = trial.chi2(trial.residual(part, dt), going)[:, 0]
            found += np.sum((off + tried * step)[going] ** 2, axis=1) / score.size[going]
            length[going] = np.where(found < best, tried, length[going])
            best = np.minimum(found, best)
        score = _with(score, windows.moved(length[:, None] * step))
        off += length[:, None] * step
        moved = going[length[going] > 0]
        if len(moved):
            fresh = scorer(score.replayer, theta, first, dt, clock_s, moved)
            score.state[moved] = fresh.state
        going = going[np.log(before) - np.log(best) > GAIN]
        if not len(going):
            break
    score = _rescaled(score, score.windows.scale / np.where(np.isfinite(first), first, 1.0))
    score, numerical = _stepped(score, rows, dt)
    score = _bent(score, rows, dt)
    score = dataclasses.replace(score, expected=replayer.windows)
    return dataclasses.replace(score, renewed=lambda values: settled(replayer, dt, clock_s, values)[0]), numerical


def _stepped(score: Scorer, rows: Rows, dt: float) -> tuple[Scorer, dict[str, float]]:
    """Add to the noise twice what half the step changes and no first state could; return also that, by quantity."""
    everything, windows = np.arange(len(score.windows)), score.windows
    change = score.replayer.run(rows, dt) - score.replayer.run(rows, 0.5 * dt)
    whole = score.unit(change, everything)[:, 0]
    x, _ = solved(score.state[:, 0], whole)
    left = whole - (score.state[:, 0] @ x[..., None].astype(np.float32))[..., 0]
    error = 2.0 * np.sqrt(np.mean(change**2, axis=1))
    return _rescaled(score, np.sqrt(1.0 + 4.0 * _mean_square(score, left))), windows.by_quantity(error)


def _bent(score: Scorer, plain: Rows, dt: float) -> Scorer:
    """Add to the noise what the line misses, over first states drawn from what the data leave uncertain."""
    replayer, windows = score.replayer, score.windows
    joints, own = len(windows.joints), 2 * len(windows.joints) + windows.base_sd.shape[1]
    everything = np.arange(len(windows))
    here = replayer.run(plain, dt)
    _, root = solved(score.state[:, 0], np.zeros(score.state.shape[::2][:1] + score.state.shape[2:3]))
    sd = np.concatenate([windows.q_sd, windows.qd_sd, windows.base_sd], axis=1)
    rng, square = np.random.default_rng(0), np.zeros_like(score.scale)
    for _ in range(DRAWS):
        x = (root @ rng.standard_normal((len(windows), root.shape[1], 1)))[..., 0]
        x[:, own:] = 0.0
        off = x[:, :own] * sd
        there = Rows(everything, plain.values, off[:, :joints], off[:, joints : 2 * joints], off[:, 2 * joints :])
        change = score.unit(replayer.run(there, dt) - here, everything)[:, 0]
        square += _mean_square(score, change - (score.state[:, 0] @ x[..., None].astype(np.float32))[..., 0])
    return _rescaled(score, np.sqrt(1.0 + square / DRAWS))
