"""Errors of joint angles: how large they are, and where and when they arise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import false_discovery_control

from go1exp.gap.data.windows import held
from go1exp.gap.result import AngleErrors, Localisation
from go1exp.gap.score.likelihood import Scorer, log_chi2, weighted_excess


def unexplained(scorer: Scorer, residual: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """Return residuals (V, G, m) of windows without what their initial states explain, (V, G, n, C, K), in noises."""
    if scorer.common.any():
        pairs = zip(scorer.state[windows], residual, strict=True)
        left = np.stack(
            [_without(_together(state, scorer.common), one.ravel()).reshape(one.shape) for state, one in pairs]
        )
    else:
        left = _without(scorer.state[windows].astype(float), residual)
    n, quantities = scorer.windows.t.shape[1], len(scorer.windows.quantities)
    return np.asarray(left.reshape(*left.shape[:2], n, quantities, -1))


def _without(state: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return residuals (..., m) without the likeliest changes of the initial state, whose columns are (..., m, k)."""
    inner = np.swapaxes(state, -1, -2) @ state + np.eye(state.shape[-1])
    cross = np.swapaxes(state, -1, -2) @ residual[..., None]
    return np.asarray(residual - (state @ np.linalg.solve(inner, cross))[..., 0])


def _together(state: np.ndarray, common: np.ndarray) -> np.ndarray:
    """Return the columns (G m, l) of all groups at once from those (G, m, k) of each: what is common is there once."""
    by_group = block_diag(*state[..., ~common].astype(float))
    return np.concatenate([by_group, state[..., common].reshape(len(by_group), -1)], axis=1)


def of_angles(scorer: Scorer, residual: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """Return the root mean square error of each joint's angle in each window (V, J), rad; NaN if it is not compared."""
    w = scorer.windows
    left = unexplained(scorer, residual, windows)[:, :, :, 0]  # V G n K
    square = np.empty((len(windows), len(w.joints)))
    valid = w.valid[windows][:, None, :, None]
    for g, joints in enumerate(scorer.replayer.machine.groups):
        total = (left[:, g : g + 1] ** 2 * valid).sum(axis=(1, 2))
        square[:, list(joints)] = total / np.maximum(w.valid[windows].sum(1), 1)[:, None]
    scale = scorer.scale[windows][:, 0]
    return np.asarray(np.sqrt(square) * np.where(np.isfinite(scale), scale, np.nan))


def within(scorer: Scorer, residual: np.ndarray, windows: np.ndarray, accept: float) -> float:
    """Return the share of the windows (V,) in which no joint is further off than ``accept`` rad beside the noise."""
    allowed = np.hypot(accept, scorer.scale[windows][:, 0])
    return float(np.mean(~(of_angles(scorer, residual, windows) > allowed).any(axis=1)))  # not of what is not compared


def angle_errors(
    scorers: tuple[Scorer, Scorer],
    before: np.ndarray,
    after: np.ndarray,
    windows: np.ndarray,
    episodes: Sequence[str],
    accept: float = 0.0,
) -> AngleErrors:
    """Compare two models by their residuals (V, G, m) on windows (V,), each in units of its scorer.

    ``episodes`` are the names of the recordings; ``accept`` is what the user does not care about, rad; 0 for nothing.
    Medians of windows, so that a few wild ones do not decide.
    """
    scorer, residuals = scorers[0], (before, after)
    pair = np.stack([of_angles(s, r, windows) for s, r in zip(scorers, residuals, strict=True)])  # 2 V J
    whole = np.sqrt(np.nanmean(pair**2, axis=2))
    episode = scorer.windows.episode[windows]
    gone = 1.0 - whole[1] / np.maximum(whole[0], 1e-300)

    def medians(errors: np.ndarray) -> tuple[float, float]:
        known = errors[:, ~np.isnan(errors[0])]
        first, second = np.median(known, axis=1) if known.size else (np.nan, np.nan)
        return float(first), float(second)

    return AngleErrors(
        windows=len(windows),
        median=medians(whole),
        removed=float(np.median(gone)),
        worse=float(np.mean(gone < 0.0)),
        by_joint={name: medians(pair[:, :, j]) for j, name in enumerate(scorer.windows.joints)},
        by_episode={episodes[e]: medians(whole[:, episode == e]) for e in np.unique(episode)},
        within=(within(scorer, before, windows, accept), within(scorers[1], after, windows, accept))
        if accept
        else None,
    )


REGIMES = (
    *("stiction", "reversal", "slow", "fast", "high torque", "after a step", "actuators off"),
    *("early in the episode", "late in the episode", "small angle", "large angle"),
)
ON_FEET = ("stance", "swing", "impact")  # regimes of a standing robot, beside the others
IMPACT_S = 0.03  # time after a foot begins to carry weight that counts as impact, s
AT_REST, SLOW, FAST = 0.1, 1.0, 5.0  # speeds up to which a joint rests or is slow, and from which it is fast, rad/s
TURN_S = 0.02  # time about a change of direction, s
EDGE = 0.05  # jump of a target that counts as an edge, rad; what follows within 60 ms is its answer
HIGH = 0.6  # share of the largest demanded torque from which torque is high

SHUFFLES = 300
FALSE_DISCOVERIES = 0.05


def regimes(scorer: Scorer, windows: np.ndarray) -> np.ndarray:
    """Return which samples are in which regime, (R, V, n, J) bool."""
    w = scorer.windows
    q, qd = w.y[windows, :, 0], w.y[windows, :, 1]
    t = w.t[windows]
    on, edge = np.empty(t.shape, dtype=bool), np.zeros(q.shape, dtype=bool)
    for row, k in enumerate(windows):
        on[row] = held(w.switches[k], t[row])
        when, values = w.edges[k]
        jump = np.abs(np.diff(values, axis=0, prepend=values[:1])) > EDGE
        since = t[row][:, None] - when
        edge[row] = np.einsum("te,ej->tj", ((since >= 0) & (since < 0.06)).astype(int), jump.astype(int)) > 0
    compared = w.compared[windows][:, None]
    demand = np.abs(w.demanded(windows)) * compared
    span = max(int(TURN_S / w.period), 1)
    turn = np.zeros(q.shape, dtype=bool)
    turn[:, span:-span] = qd[:, : -2 * span] * qd[:, 2 * span :] < 0
    speed = np.abs(qd)
    time = np.broadcast_to((w.elapsed[windows][:, None] + t)[..., None], q.shape)
    third = np.quantile(time, [1 / 3, 2 / 3])
    middle = np.median(q, axis=(0, 1))
    away = np.abs(q - middle)
    far = np.quantile(away, 2 / 3, axis=(0, 1))
    masks = [speed < AT_REST, turn, (speed >= AT_REST) & (speed < SLOW), speed >= FAST]
    masks += [demand > HIGH * np.maximum(demand.max((0, 1)), 1e-9), edge, np.broadcast_to(~on[..., None], q.shape)]
    masks += [time < third[0], time > third[1], away < 0.5 * far, away > far]
    loads = w.loads()
    if loads is not None:
        stance = loads[windows]
        touched = stance & ~np.concatenate([stance[:, :1], stance[:, :-1]], axis=1)
        long = max(round(IMPACT_S / w.period), 1)
        impact = np.stack([touched[:, max(k - long, 0) : k + 1].any(1) for k in range(stance.shape[1])], axis=1)
        masks += [stance, ~stance, impact]
    return np.stack(masks) & w.valid[windows][None, ..., None] & compared


def localise(scorer: Scorer, residual: np.ndarray, windows: np.ndarray, rng: np.random.Generator) -> Localisation:
    """Sort the excess of residuals (V, G, m) by joint and regime.

    What the uncertainty of the initial state explains is taken out. A cell is tested by giving the regimes of one
    window to another: whether the excess is larger there than elsewhere in the same joint.
    """
    w, groups = scorer.windows, np.array(scorer.replayer.machine.groups)
    split = unexplained(scorer, residual, windows)
    square = np.empty((len(windows), w.t.shape[1], len(w.joints)))
    for g, joints in enumerate(groups):
        scored = np.isfinite(scorer.scale[windows][:, : w.of_joints, joints]).sum(1)  # V K quantities
        square[:, :, joints] = (split[:, g, :, : w.of_joints] ** 2).sum(axis=2) / np.maximum(scored, 1)[:, None]
    inside = regimes(scorer, windows)
    count = inside.sum((1, 2))
    score = log_chi2(square) * w.valid[windows][..., None]  # a few violent samples must not decide
    samples = inside.sum(2)  # R V J
    of_window = np.divide((square * inside).sum(2), samples, where=samples > 0, out=np.ones(samples.shape))
    excess = weighted_excess(np.moveaxis(of_window, 1, 0), np.moveaxis(samples, 1, 0))
    p = np.full(count.shape, np.nan)
    observed = _means(score, inside, count)
    larger = np.zeros(count.shape)
    for _ in range(SHUFFLES):
        larger += _means(score, inside[:, rng.permutation(len(windows))], count) >= observed
    enough = (count > 20) & (inside.any(2).sum(1) > 2)
    p[enough] = ((1 + larger) / (SHUFFLES + 1))[enough]
    flagged = np.zeros(count.shape, dtype=bool)
    if enough.any():
        flagged[enough] = false_discovery_control(p[enough]) < FALSE_DISCOVERIES
    names = REGIMES if w.loads() is None else (*REGIMES, *ON_FEET)
    return Localisation(w.joints, names, count.T, excess.T, p.T, (flagged & (excess > 0.1)).T)


def _means(score: np.ndarray, inside: np.ndarray, count: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("vnj,rvnj->rj", score, inside) / np.maximum(count, 1))
