"""Evaluates runs that have no evaluation yet, all alike, on the grid of commands."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from go1exp.evaluate.files import FILE, write
from go1exp.evaluate.policy import load_run
from go1exp.evaluate.rollout import EvalConfig, evaluate, grid
from go1exp.report.evaluations import GRID, names
from go1exp.report.runs import Run
from go1exp.report.settings import Evaluation
from go1exp.schema.registry import bind_list

BEST = "best.pt"
"""The checkpoint that evaluation during training found best, in a run folder."""


def missing(runs: Sequence[Run]) -> list[Run]:
    """Return the runs that have no rows of the grid but have a checkpoint."""
    return [run for run in runs if GRID not in names(run) and any((run.folder / "checkpoints").glob("*.pt"))]


def evaluate_run(run: Path, settings: Evaluation, on_step: Callable[[int, int], None]) -> dict[str, Any]:
    """Evaluate the policy of a run folder as asked for; return the report of ``evaluate``."""
    best = run / BEST
    checkpoint = best if settings.checkpoint == "best" and best.is_file() else None
    config, policy, about = load_run(run, checkpoint)
    commands = grid(settings.x, settings.y, settings.yaw, False)
    unlike = ("commands", "train_ground", "policy_dt", "physics_dt", "trunk_velocity", "engine")
    shared = {f.name: getattr(settings, f.name) for f in dataclasses.fields(EvalConfig) if f.name not in unlike}
    wanted = EvalConfig(commands=commands, train_ground=False, policy_dt=None, **shared)
    measures = bind_list("measure", list(settings.measures), "evaluation.measures")
    return {"policy": about, "robot": {}, **evaluate(config.task, policy, wanted, on_step, measures), "bars": []}


def evaluate_missing(
    runs: Sequence[Run], settings: Evaluation, on_run: Callable[[int, int, str], Callable[[int, int], None]]
) -> list[str]:
    """Evaluate runs one after the other and write what came of them into their folders; return remarks.

    Args:
        runs: what to evaluate.
        settings: how.
        on_run: called with the number of the run, how many there are and its label; returns what shows its progress.
    """
    notes = []
    for number, run in enumerate(runs, 1):
        try:
            report = evaluate_run(run.folder, settings, on_run(number, len(runs), run.label))
        except (OSError, RuntimeError, ValueError) as error:
            notes.append(f"{run.label}: could not be evaluated ({' '.join(str(error).split())[:160]})")
            continue
        write(report, run.folder / FILE)
    return notes
