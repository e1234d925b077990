"""Initial states of a standing robot: moved to where they fit best, with noise for what a line does not describe.

An initial state enters the score as a linear, Gaussian unknown (``likelihood.py``). On the ground that holds only near
the state: a foot touches down or slides earlier or later. So the states are first moved to where each window fits best.
Two errors remain: what the line still misses within the uncertainty of the state, and what a smaller physics step
changes that no initial state could. Both count as noise of the window. So a window in which small causes have large
effects counts little, and claims no gap.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import Rows, Theta, variants
from go1exp.gap.score.likelihood import Scorer, grouped, log_chi2, scorer
from go1exp.logs.recording import Recording

ROUNDS = 6  # times that states are moved at most; most have settled after two
LENGTHS = (1.0, 0.4)  # shares of a step to the best state that are tried
FARTHEST = 4.0  # longest step of a coordinate, in standard deviations
GAIN = 0.05  # fall of a window's log chi2 in a round below which it needs no more rounds
DRAWS = 4  # states drawn from what remains uncertain


def solved(state: np.ndarray, residual: np.ndarray, off: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the likeliest unknowns (W, k), sd, the first ``off`` (W, l) away, and roots (W, k, k) of covariance."""
    wide = state.astype(float)
    inner = np.swapaxes(wide, -1, -2) @ wide + np.eye(wide.shape[-1])
    right = (np.swapaxes(wide, -1, -2) @ residual[..., None].astype(float))[..., 0]
    if off is not None:
        right[:, : off.shape[1]] -= off
    x = np.linalg.solve(inner, right[..., None])[..., 0]
    return x, np.swapaxes(np.linalg.inv(np.linalg.cholesky(inner)), -1, -2)


def _with(score: Scorer, windows: Windows) -> Scorer:
    """Return the scorer on other initial states of the same windows; the batches of simulations are kept."""
    return dataclasses.replace(score, replayer=dataclasses.replace(score.replayer, windows=windows))


def rescaled(score: Scorer, factor: np.ndarray) -> Scorer:
    """Return the scorer with ``factor`` (W, C, J) times the noise."""
    factor = np.where(np.isfinite(factor), factor, 1.0)
    long = np.broadcast_to(factor[:, None], (len(factor), score.windows.t.shape[1], *factor.shape[1:]))
    state = score.state / grouped(score.replayer.machine, long)[..., None]
    return dataclasses.replace(score, scale=score.scale * factor, state=state.astype(np.float32))


def _mean_square(score: Scorer, residual: np.ndarray) -> np.ndarray:
    """Return the mean square over time (W, C, J) of residuals (W, m)."""
    w = score.windows
    back = residual.reshape(len(w), w.t.shape[1], len(w.quantities), len(w.joints))
    return np.asarray(np.sum(back**2, axis=1) / w.valid.sum(1)[:, None, None])


def converged(
    replayer: Replayer, dt: float, clock_s: float, theta: Theta | None = None
) -> tuple[Scorer, dict[str, float]]:
    """Move the windows' initial states to where the model with values ``theta`` (none: nominal) fits best.

    Returns:
        The scorer of those windows, which does the same for other values, and the error of the step by quantity.
    """
    theta = theta or {}
    everything = np.arange(len(replayer.windows))
    rows = variants(replayer.machine, theta, everything, [])
    fine = np.abs(replayer.run(rows, 0.5 * dt) - replayer.run(rows, dt))
    rough = np.hypot(replayer.windows.scale, 2.0 * np.sqrt(np.mean(fine**2, axis=1)))
    score = _fitted(scorer(replayer, theta, rough, dt, clock_s), rows, theta, dt)
    score = rescaled(score, score.windows.scale / np.where(np.isfinite(rough), rough, 1.0))
    score, numerical = stepped(score, rows, dt)
    score = _bent(score, rows, dt)
    score = dataclasses.replace(score, expected=replayer.windows)
    return dataclasses.replace(score, updated=lambda values: converged(replayer, dt, clock_s, values)[0]), numerical


def _fitted(score: Scorer, rows: Rows, theta: Theta, dt: float) -> Scorer:
    """Return the scorer on initial states at which each window fits best, in a few Gauss-Newton steps."""
    everything, machine = np.arange(len(score.windows)), score.replayer.machine
    coordinates = 2 * len(machine.joints) + len(machine.base_probe)
    active, off = everything, np.zeros((len(everything), coordinates))  # off: from the estimates
    for _ in range(ROUNDS):
        part = rows.part(active)
        residual = score.residual(part, dt)
        before = score.chi2(residual, active)[:, 0] + np.sum(off[active] ** 2, axis=1) / score.size[active]
        x, _ = solved(score.state[active, 0], residual[:, 0], off[active])
        step = np.zeros((len(everything), coordinates))
        step[active] = x[:, :coordinates].clip(-FARTHEST, FARTHEST)
        windows, length, best = score.windows, np.zeros(len(everything)), before
        for tried in LENGTHS:
            trial = _with(score, windows.moved(tried * step))
            chi2 = trial.chi2(trial.residual(part, dt), active)[:, 0]
            chi2 += np.sum((off + tried * step)[active] ** 2, axis=1) / score.size[active]
            length[active] = np.where(chi2 < best, tried, length[active])
            best = np.minimum(chi2, best)
        score = _with(score, windows.moved(length[:, None] * step))
        off += length[:, None] * step
        moved = active[length[active] > 0]
        if len(moved):
            fresh = scorer(score.replayer, theta, score.scale, dt, score.clock_s, moved)
            score.state[moved] = fresh.state
        active = active[log_chi2(before) - log_chi2(best) > GAIN]
        if not len(active):
            break
    return score


def stepped(score: Scorer, rows: Rows, dt: float) -> tuple[Scorer, dict[str, float]]:
    """Add to the noise twice what half the step changes and no initial state could; return also that, by quantity."""
    everything, windows = np.arange(len(score.windows)), score.windows
    change = score.replayer.run(rows, dt) - score.replayer.run(rows, 0.5 * dt)
    whole = score.unit(change, everything)[:, 0]
    x, _ = solved(score.state[:, 0], whole)
    left = whole - (score.state[:, 0] @ x[..., None].astype(np.float32))[..., 0]
    error = 2.0 * np.sqrt(np.mean(change**2, axis=1))
    return rescaled(score, np.sqrt(1.0 + 4.0 * _mean_square(score, left))), windows.by_quantity(error)


def _bent(score: Scorer, plain: Rows, dt: float) -> Scorer:
    """Add to the noise what the line misses, over initial states drawn from what the data leave uncertain."""
    replayer, windows = score.replayer, score.windows
    joints, coordinates = len(windows.joints), 2 * len(windows.joints) + windows.base_sd.shape[1]
    everything = np.arange(len(windows))
    nominal = replayer.run(plain, dt)
    _, root = solved(score.state[:, 0], np.zeros((len(windows), score.state.shape[2])))
    sd = np.concatenate([windows.q_sd, windows.qd_sd, windows.base_sd], axis=1)
    rng, square = np.random.default_rng(0), np.zeros_like(score.scale)
    for _ in range(DRAWS):
        x = (root @ rng.standard_normal((len(windows), root.shape[1], 1)))[..., 0]
        x[:, coordinates:] = 0.0
        off = x[:, :coordinates] * sd
        drawn = Rows(everything, plain.values, off[:, :joints], off[:, joints : 2 * joints], off[:, 2 * joints :])
        change = score.unit(replayer.run(drawn, dt) - nominal, everything)[:, 0]
        square += _mean_square(score, change - (score.state[:, 0] @ x[..., None].astype(np.float32))[..., 0])
    return rescaled(score, np.sqrt(1.0 + square / DRAWS))


def measured(replayer: Replayer, dt: float, coarse: float, clock_s: float) -> tuple[Scorer, dict[str, float]]:
    """Return what scores replays at step ``dt``, s, and the error of that step by quantity.

    The influence of the initial states of a held robot is measured at the step ``coarse``, s. ``clock_s`` is the
    standard deviation of the time between stamps of commands and of readings, s.
    """
    if replayer.machine.on_ground:  # initial states of a free trunk matter so much that they are fitted first
        return converged(replayer, dt, clock_s)

    def at(theta: Theta) -> tuple[Scorer, dict[str, float]]:
        if replayer.machine.base_probe:  # legs in the air: most of that error is as one of the initial speeds
            plain = scorer(replayer, theta, replayer.windows.scale, dt, clock_s)
            rows = variants(replayer.machine, theta, np.arange(len(replayer.windows)), [])
            score, numerical = stepped(plain, rows, dt)
            return replace(score, updated=lambda values: at(values)[0]), numerical
        scale, numerical = numerical_scale(replayer, dt, theta)
        score = scorer(replayer, theta, scale, coarse, clock_s)
        return replace(score, updated=lambda values: at(values)[0]), numerical

    return at({})


def numerical_scale(replayer: Replayer, dt: float, theta: Theta | None = None) -> tuple[np.ndarray, dict[str, float]]:
    """Return the noise (W, C, J) with the error of the physics step in it, and that error by quantity.

    The error is that of each window, since one with an impact has a hundred times that of one without, and of the model
    with the values ``theta``, since one with dry friction has ten times that of one without. It is taken as twice the
    change that half the step makes: the engine's error falls in proportion to its step.
    """
    w = replayer.windows
    rows = variants(replayer.machine, theta or {}, np.arange(len(w)), [])
    coarse, fine = (replayer.run(rows, step) for step in (dt, 0.5 * dt))
    weight = w.valid[..., None, None] / np.maximum(w.valid.sum(1), 1)[:, None, None, None]
    error = 2.0 * np.sqrt(np.sum((coarse - fine) ** 2 * weight, axis=1))  # W C J
    return np.hypot(w.scale, error), w.by_quantity(error)


def repeatability(recordings: Sequence[Recording]) -> dict[str, float] | None:
    """Return how much repeated episodes differ, over sqrt(2), root mean square by quantity; None without any."""
    by_name = {r.meta.episode: r for r in recordings}
    pairs = [(r, by_name[r.meta.repeat_of]) for r in recordings if r.meta.repeat_of in by_name]
    if not pairs:
        return None
    rms = {}
    for name in ("q", "qd"):
        square = []
        for a, b in pairs:
            rows = min(len(a.t), len(b.t))
            square.append(np.mean((a.joint(name)[:rows] - b.joint(name)[:rows]) ** 2))
        rms[name] = float(np.sqrt(np.mean(square) / 2.0))
    return rms
