"""``suite=report``: time and memory of ``go1exp report`` on a synthetic study of 100 runs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from go1exp.evaluate.quantities import FILE, rows_of, write

RUNS, SEEDS, ROWS, COLUMNS = 100, 5, 5000, 60
"""Runs, runs of each configuration, and rows and columns of each run's metrics."""

EPISODES = 16
GRID = [[x, 0.0, 0.0] for x in (0.0, -1.0, -0.5, 0.5, 1.0, 1.5)] + [[0.0, 0.5, 0.0], [0.0, 0.0, 1.0]]
"""Evaluation of each run: robots of each command (m/s, m/s, rad/s)."""


def run(container: dict[str, Any], on_round: Callable[[int, int], None]) -> dict[str, float]:
    """Report a synthetic study in a separate process; return its time, memory and page size."""
    with tempfile.TemporaryDirectory() as folder:
        study = Path(folder)
        for number in range(RUNS):
            _make_run(study / f"run{number}", container, number)
            on_round(number, RUNS + 1)
        command = [sys.executable, "-m", "go1exp", "report", str(study)]
        start = time.perf_counter()
        child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(child.pid, 0)
        seconds = time.perf_counter() - start
        on_round(RUNS + 1, RUNS + 1)
        if status:
            raise RuntimeError(f"go1exp report ended with status {os.waitstatus_to_exitcode(status)}")
        size = (study / "report" / "report.html").stat().st_size
    busy = usage.ru_utime + usage.ru_stime
    figures = {"report_s": seconds, "report_cpu_s": busy, "report_mb": usage.ru_maxrss / 1024.0}
    return {**figures, "report_page_mb": size / 1e6}


def _make_run(folder: Path, container: dict[str, Any], number: int) -> None:
    """Write a run folder with random metrics and an evaluation that improves with the group, ``number`` // 5."""
    group, seed = divmod(number, SEEDS)
    rng = np.random.default_rng(number)
    folder.mkdir(parents=True)
    reward = {**container["reward"], "gait": {**container["reward"]["gait"], "weight": float(group)}}
    config = yaml.safe_dump({**container, "seed": seed, "reward": reward}, sort_keys=False)
    (folder / "config.yaml").write_text(config)
    (folder / "state.json").write_text(json.dumps({"state": "done", "cause": ""}))
    iteration = np.arange(1, ROWS + 1)
    names = ["rollout/return", "rollout/length", *(f"reward/term_{k}" for k in range(COLUMNS - 4))]
    rise = (1.0 - np.exp(-3.0 * iteration / ROWS))[:, None]
    values = rise * (20.0 + group + rng.normal()) + rng.normal(size=(ROWS, len(names)))
    rate = 5e4 + 1e3 * rng.normal(size=(ROWS, 1))
    for file, columns, table in (("metrics", names, values), ("timing", ["time/steps_per_s"], rate)):
        head, rows = ",".join(["iteration", "steps", *columns]), [iteration, iteration * 24_000, table]
        np.savetxt(folder / f"{file}.csv", np.column_stack(rows), "%.10g", ",", header=head, comments="")
    _evaluate(folder, rng, 0.3 - 0.005 * group + 0.02 * rng.normal())


def _evaluate(folder: Path, rng: np.random.Generator, level: float) -> None:
    """Write an evaluation whose errors and falls grow as friction falls."""
    commands = np.repeat(np.array(GRID), EPISODES, axis=0)
    friction = np.random.default_rng(1).uniform(0.4, 1.1, len(commands))  # the same robots for all runs
    errors = np.abs(level + 0.2 * (1.0 - friction)[:, None] + 0.02 * rng.normal(size=(len(commands), 3)))
    fell = rng.random(len(commands)) < 0.2 * (1.1 - friction)
    moving = np.where(fell, 5.0, 10.0)
    rows = rows_of(commands, EPISODES, errors, fell, moving, {"foot_friction_mean": friction}, {})
    settings = {"episodes": EPISODES, "seconds": 10.0, "noise": True, "randomize": True, "seed": 1}
    write({"settings": settings, "robot": {}, "commands": [{"command": c} for c in GRID], "rows": rows}, folder / FILE)
