"""Put the policy of a run beside the package.

``python -m benchmarks.ship_policy run=RUN name=NAME [before=RUN,RUN] [episodes=31]``

Writes ``assets/policies/NAME``: the run's configuration and origin, its curves (every tenth iteration), a checkpoint
that holds only the policy (without what only training needs), and evaluations on the CPU engine: on flat ground
with noise, with nothing random (``rand=none``), with noise at 100 Hz, on the ground of training with all that training
does to a robot, and under the acceptance criteria (``go1exp/evaluate/criteria.py``): stiff feet, dry friction, delay.
``before`` are the runs that led to ``run`` (``start_from``), the oldest first: their configurations and origins go to
``stage_1`` and so on. Without ``run`` the present policy is evaluated again.
A tree with changes, or a run from one, is refused: the origin of a shipped policy is a commit.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.results import commit
from go1exp.base.paths import data_root
from go1exp.cli import subjects
from go1exp.config.compose import compose
from go1exp.evaluate import table
from go1exp.evaluate.criteria import ROBOT
from go1exp.evaluate.rollout import EvalConfig, delay_margin, evaluate, grid
from go1exp.mdp.measures import every_measure
from go1exp.sim.task import TaskConfig
from go1exp.train import checkpoint, policy
from go1exp.train.policy import Policy, load_run

GRID = {
    "x": (-1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0),
    "y": (-1.0, -0.5, 0.5, 1.0),
    "yaw": (-1.2, -0.6, 0.6, 1.2, 1.8),
}
"""Commands, one axis at a time, m/s and rad/s."""

EVALUATIONS: dict[str, dict[str, Any]] = {
    "flat": {"noise": True},
    "none": {},
    "flat_100_hz": {"noise": True, "policy_dt": 0.01},
    "training_ground": {"noise": True, "randomize": True, "push": True, "train_ground": True},
}
"""Evaluation -> settings that differ from the default."""

CRITERIA_GRID = {
    "x": (0.1, 0.2, 0.3, 0.5, 1.0, 1.5, 2.0, 3.0, -1.0),
    "y": (0.5, -0.5),
    "yaw": (1.0, -0.6, 1.8),
}
"""Commands that the criteria are about, m/s and rad/s."""

COMBINED = (1.0, 0.3, 0.5)
"""One command of all three kinds."""

EVERY = 10
"""Iterations between rows of the shipped curves."""


def shipped(run: Path, to: Path) -> None:
    """Copy the parts of a shipped policy: configuration, origin, curves, the policy's weights."""
    state, path = checkpoint.load_latest(run)
    (to / "checkpoints").mkdir(parents=True, exist_ok=True)
    for old in [*(to / "checkpoints").glob("*"), *to.glob("stage_*/*"), to / policy.START]:
        old.unlink(missing_ok=True)
    kept = {name: state[name] for name in ("format", "policy", "iteration", "num_timesteps")}
    torch.save(kept, to / "checkpoints" / path.name)
    copy_origin(run, to)
    head, *rows = (run / "metrics.csv").read_text().splitlines(keepends=True)
    (to / "metrics.csv").write_text("".join([head, *rows[9::EVERY]]))


def copy_origin(run: Path, to: Path) -> None:
    """Copy the origin of a policy from its run: configuration, versions, what it started from."""
    to.mkdir(exist_ok=True)
    for name in ("config.yaml", "meta.json", policy.START):
        if (run / name).exists():
            shutil.copyfile(run / name, to / name)


def evaluate_criteria(task: TaskConfig, policy: Policy, about: dict[str, Any]) -> dict[str, Any]:
    """Return the report of a policy on ``criteria.ROBOT``: 20 robots a command, 10 s, noise; and its delay margin."""
    other, _ = subjects.split_robot(compose("eval", list(ROBOT)))
    changed = subjects.with_robot(task, other)
    commands = (*grid(CRITERIA_GRID["x"], CRITERIA_GRID["y"], CRITERIA_GRID["yaw"], cross=False), COMBINED)
    config = EvalConfig(commands, 20, 10.0, 2.0, True, True, False, False, None, 1)
    report = {"policy": about, "robot": subjects.robot_as_data(other)}
    report |= evaluate(changed, policy, config, measures=every_measure())
    report["delay_margin"] = delay_margin(changed, policy, config, report["distinct_falls"])
    return report


def refuse_changes(present: str, runs: Sequence[Path]) -> None:
    """Raise SystemExit if the policy's origin is no commit: files differ from it now, or did in one of its runs."""
    if present.endswith("+") or present == "unknown":
        raise SystemExit(f"commit {present}: files differ from it, or it is unknown; commit them first")
    for run in runs:
        if json.loads((run / "meta.json").read_text()).get("git_dirty"):
            raise SystemExit(f"{run}: trained with files that differ from its commit (meta.json: git_dirty)")


def main(arguments: Sequence[str]) -> None:
    """Copy and evaluate."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if not {"name"} <= set(given) <= {"run", "name", "before", "episodes", "only"} or given.get(
        "only", "criteria"
    ) not in (*EVALUATIONS, "criteria"):
        known = "|".join((*EVALUATIONS, "criteria"))
        raise SystemExit(
            f"usage: python -m benchmarks.ship_policy [run=RUN] name=NAME [before=RUN,RUN] [episodes=31] [only={known}]"
        )
    before = [Path(run) for run in given.get("before", "").split(",") if run]
    refuse_changes(commit(), [*before, *map(Path, [given["run"]] if "run" in given else [])])
    to = data_root() / "assets" / "policies" / given["name"]
    if "run" in given:
        shipped(Path(given["run"]), to)
        for number, run in enumerate(before, 1):
            copy_origin(run, to / f"stage_{number}")
    config, policy, about = load_run(to)
    about["file"] = str(Path(about["file"]).relative_to(data_root()))
    usual = {"seconds": 20.0, "settle_s": 2.0, "policy_dt": None, "seed": 1}
    off = dict.fromkeys(("noise", "randomize", "push", "train_ground"), False)
    commands = grid(GRID["x"], GRID["y"], GRID["yaw"], cross=False)
    for name, on in EVALUATIONS.items():
        if name != given.get("only", name):
            continue
        print(f"== {name}", flush=True)
        wanted = EvalConfig(commands, int(given.get("episodes", 31)), **{**usual, **off, **on})
        report = {"policy": about, **evaluate(config.task, policy, wanted, measures=every_measure())}
        write(report, to / f"eval_{name}.json")
    if given.get("only", "criteria") == "criteria":
        print("== criteria", flush=True)
        write(evaluate_criteria(config.task, policy, about), to / "eval_criteria.json")


def write(report: dict[str, Any], file: Path) -> None:
    """Write a report without its rows, and print it."""
    report.pop("rows")
    file.write_text(json.dumps(report, indent=1) + "\n")
    print(table.text(report), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
