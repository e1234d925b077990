"""``python -m go1exp.evaluate.asynchronous RUN``: evaluates and records policies of a running training.

Jobs are lines of JSON on standard input, results are lines of JSON on standard output; see
``go1exp/train/asynchronous.py``, which starts it. It ends with its input.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from go1exp.config.schema.physics import CpuBackend
from go1exp.evaluate.quantities import Row
from go1exp.evaluate.rollout import EvalConfig, evaluate, evaluation_task, grid
from go1exp.train.policy import load_run

FALLEN = 1.0  # least error of a fallen robot, m/s
NICE = 19  # lowest priority: the training comes first


def score(rows: Sequence[Row], seconds: float) -> float:
    """Return the root mean square horizontal error, m/s; of a fallen robot its command, and at least 1 m/s."""
    squares = []
    for row in rows:
        share = min(row["moving_s"] / seconds, 1.0)
        lost = max(math.hypot(row["x"], row["y"]), FALLEN)
        squares.append(share * (row["error_xy"] or 0.0) ** 2 + (1.0 - share) * lost**2)
    return math.sqrt(sum(squares) / len(squares))


def evaluated(run: Path, policy_file: Path, settings: dict[str, Any]) -> dict[str, float]:
    """Return the figures of a policy file of a run: score, errors, share of falls."""
    config, policy, _ = load_run(run, policy_file)
    commands = grid(settings["x"], settings["y"], settings["yaw"], False)
    names = ("episodes", "seconds", "settle_s", "noise", "randomize", "seed")
    engine = CpuBackend(name="cpu", threads=1)
    wanted = EvalConfig(commands, engine=engine, **{name: settings[name] for name in names})
    rows = evaluate(config.task, policy, wanted)["rows"]

    def mean(name: str) -> float:
        known = [row[name] for row in rows if row[name] is not None]
        return sum(known) / len(known) if known else math.nan

    figures = {name: mean(name) for name in ("error_xy", "error_yaw")}
    return {"score": score(rows, wanted.seconds), **figures, "fall_share": mean("fell")}


def record(run: Path, policy_file: Path, settings: dict[str, Any], out: Path) -> None:
    """Write a video of a policy file of a run, on the nominal robot on flat ground (MP4)."""
    from go1exp.evaluate import video
    from go1exp.sim.env.core import Go1Core

    config, policy, _ = load_run(run, policy_file)
    engine = CpuBackend(name="cpu", threads=1)
    shown = EvalConfig((tuple(settings["velocity"]),), 1, settings["seconds"], engine=engine)
    core = Go1Core(evaluation_task(config.task, shown), 1, 1, noise=False)
    core.command.value[:] = core.command.value.new_tensor(settings["velocity"])
    out.parent.mkdir(exist_ok=True)
    video.write_mp4(out, video.record(core, policy, settings["seconds"], fps=25), 25)


def answered(run: Path, job: dict[str, Any]) -> dict[str, Any]:
    """Return the result of a job, or its error message."""
    result = {name: job[name] for name in ("kind", "iteration", "steps", "policy")}
    try:
        if job["kind"] == "evaluate":
            return {**result, "figures": evaluated(run, Path(job["policy"]), job["settings"])}
        record(run, Path(job["policy"]), job["settings"], Path(job["out"]))
        return {**result, "out": job["out"]}
    except Exception as error:  # a failure here shall not end the training
        text = " ".join(f"{type(error).__name__}: {error}".split())
        return {**result, "problem": f"{job['kind']} during the training failed: {text[:200]}"}


def main(arguments: Sequence[str]) -> None:
    """Answer jobs until the input ends."""
    with contextlib.suppress(OSError):
        os.nice(NICE)
    torch.set_num_threads(1)
    answers, sys.stdout = sys.stdout, sys.stderr  # what libraries print is no answer
    for line in sys.stdin:
        print(json.dumps(answered(Path(arguments[0]), json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
