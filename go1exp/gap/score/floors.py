"""What no model can get below: noise, the error of the physics step, and what repetitions differ by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import Theta, variants
from go1exp.gap.score.initial_state import settled, stepped
from go1exp.gap.score.likelihood import Scorer, scorer
from go1exp.logs.recording import Recording


def measured(replayer: Replayer, dt: float, coarse: float, clock_s: float) -> tuple[Scorer, dict[str, float]]:
    """Return what scores replays at step ``dt``, s, and the error of that step by quantity.

    Args:
        replayer: of the windows.
        dt: physics step, s.
        coarse: step, s, at which the influence of the initial states of a held robot is measured.
        clock_s: standard deviation of the time between stamps of commands and of readings, s.
    """
    if replayer.machine.on_ground:  # initial states of a free trunk matter so much that they are fitted first
        return settled(replayer, dt, clock_s)

    def at(theta: Theta) -> tuple[Scorer, dict[str, float]]:
        if replayer.machine.base_probe:  # legs in the air: most of that error is as one of the initial speeds
            plain = scorer(replayer, theta, replayer.windows.scale, dt, clock_s)
            rows = variants(replayer.machine, theta, np.arange(len(replayer.windows)), [])
            score, numerical = stepped(plain, rows, dt)
            return replace(score, renewed=lambda values: at(values)[0]), numerical
        scale, numerical = numerical_scale(replayer, dt, theta)
        score = scorer(replayer, theta, scale, coarse, clock_s)
        return replace(score, renewed=lambda values: at(values)[0]), numerical

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
