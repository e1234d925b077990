"""Where the model is wrong: joint by joint, regime by regime."""

from __future__ import annotations

import numpy as np
from scipy.stats import false_discovery_control

from go1exp.gap.data.windows import held
from go1exp.gap.result import Localisation
from go1exp.gap.score.angle_errors import unexplained
from go1exp.gap.score.likelihood import Scorer
from go1exp.gap.score.robust import log_chi2, weighted_excess

REGIMES = (
    *("stiction", "reversal", "slow", "fast", "high torque", "after a step", "actuators off"),
    *("early in the episode", "late in the episode", "small angle", "large angle"),
)
ON_FEET = ("stance", "swing", "impact")
"""Regimes of a robot on its feet, beside the others."""

IMPACT_S = 0.03
"""Time after a foot begins to carry weight that counts as impact, s."""

AT_REST, SLOW, FAST = 0.1, 1.0, 5.0
"""Speeds up to which a joint rests or is slow, and from which it is fast, rad/s."""

TURN_S = 0.02
"""Time about a change of direction, s."""

EDGE = 0.05
"""Jump of a target that counts as an edge, rad; what follows within 60 ms is its answer."""

HIGH = 0.6
"""Share of the largest demanded torque from which torque is high."""

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
