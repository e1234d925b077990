"""How far the angles are off, in rad: what a user asks for first, beside chi2."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from go1exp.gap.result import AngleErrors
from go1exp.gap.score.likelihood import Scorer


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
