"""A study that nobody has trained: run folders as training and evaluation leave them, to measure reports with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from go1exp.evaluate.rows import FILE, rows_of, write

SEEDS, COLUMNS = 5, 60
"""Runs of each configuration, and columns of each one's metrics."""

EPISODES = 16
GRID = [[x, 0.0, 0.0] for x in (0.0, -1.0, -0.5, 0.5, 1.0, 1.5)] + [[0.0, 0.5, 0.0], [0.0, 0.0, 1.0]]
"""The evaluation of each run: so many robots of each command (m/s, m/s, rad/s)."""


def make_run(folder: Path, container: dict[str, Any], number: int, rows: int) -> None:
    """Write a run folder as training and evaluation leave it, with numbers that nobody has trained for.

    Args:
        folder: the run folder.
        container: a training configuration.
        number: of the run; its group is that over five, and better the higher it is; the rest is its seed.
        rows: of its metrics.
    """
    group, seed = divmod(number, SEEDS)
    rng = np.random.default_rng(number)
    folder.mkdir(parents=True)
    reward = {**container["reward"], "gait": {**container["reward"]["gait"], "weight": float(group)}}
    text = yaml.safe_dump({**container, "seed": seed, "reward": reward}, sort_keys=False)
    (folder / "config.yaml").write_text(text)
    (folder / "state.json").write_text(json.dumps({"state": "done", "cause": ""}))
    iteration = np.arange(1, rows + 1)
    steps = iteration * 24_000
    names = ["rollout/return", "rollout/length", *(f"reward/term_{k}" for k in range(COLUMNS - 4))]
    rise = (1.0 - np.exp(-3.0 * iteration / rows))[:, None]
    values = rise * (20.0 + group + rng.normal()) + rng.normal(size=(rows, len(names)))
    table = np.column_stack([iteration, steps, values])
    head = ",".join(["iteration", "steps", *names])
    np.savetxt(folder / "metrics.csv", table, delimiter=",", header=head, comments="", fmt="%.10g")
    timing = np.column_stack([iteration, steps, 5e4 + 1e3 * rng.normal(size=rows)])
    head = "iteration,steps,time/steps_per_s"
    np.savetxt(folder / "timing.csv", timing, delimiter=",", header=head, comments="", fmt="%.10g")
    _evaluate(folder, rng, 0.3 - 0.005 * group + 0.02 * rng.normal())


def _evaluate(folder: Path, rng: np.random.Generator, level: float) -> None:
    """Write an evaluation in which slippery robots follow worse and fall more."""
    commands = np.repeat(np.array(GRID), EPISODES, axis=0)
    friction = np.random.default_rng(1).uniform(0.4, 1.1, len(commands))  # the same robots for all runs
    errors = np.abs(level + 0.2 * (1.0 - friction)[:, None] + 0.02 * rng.normal(size=(len(commands), 3)))
    fell = rng.random(len(commands)) < 0.2 * (1.1 - friction)
    moving = np.where(fell, 5.0, 10.0)
    rows = rows_of(commands, EPISODES, errors, fell, moving, {"foot_friction_mean": friction}, {})
    settings = {"episodes": EPISODES, "duration_s": 10.0, "noise": True, "randomize": True, "seed": 1}
    write({"settings": settings, "robot": {}, "commands": [{"command": c} for c in GRID], "rows": rows}, folder / FILE)
