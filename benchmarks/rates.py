"""A policy at other rates than that of training: ``python -m benchmarks.rates policy=NAME [episodes=8] [out=F.json]``.

The paper ran its policy at 50 and 100 Hz and preferred 100 (section III-A). On flat ground with the noise of Table II,
at 50, 100, 200 and 400 Hz, with the trunk's true velocity (and the noise of training on it) and with the filter's.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.ship_policy import GRID
from go1exp.base.paths import data_root
from go1exp.evaluate.rollout import EvalConfig, evaluate, grid
from go1exp.train.policy import load_run

PHYSICS_DT = {50: 0.002, 100: 0.002, 200: 0.00125, 400: 0.00125}
"""Rate of the policy, Hz -> step of the physics, s: the longest up to 2 ms that fits."""

MODEST = (1.5, 1.5, 1.2)
"""Largest commands that count for tracking, m/s and rad/s."""


def modest(row: dict[str, Any]) -> bool:
    """Return whether the command of a report's row is within ``MODEST``."""
    return all(abs(value) <= most for value, most in zip(row["command"], MODEST, strict=True))


def pooled(rows: Sequence[dict[str, Any]], axes: Sequence[str]) -> float:
    """Return the RMSE of the vector of ``axes`` over rows of equal weight."""
    squares = [sum(row["rmse"][axis] ** 2 for axis in axes) for row in rows if row["rmse"]]
    return float((sum(squares) / len(squares)) ** 0.5)


def speed(rows: Sequence[dict[str, Any]], command: tuple[float, float, float], axis: str) -> float:
    """Return the mean velocity along ``axis`` under ``command``."""
    return float(next(row["mean"][axis] for row in rows if tuple(row["command"]) == command))


def main(arguments: Sequence[str]) -> None:
    """Evaluate and print a row for each rate and kind of velocity."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if not {"policy"} <= set(given) <= {"policy", "episodes", "out"}:
        raise SystemExit("usage: python -m benchmarks.rates policy=NAME [episodes=8] [out=FILE.json]")
    config, policy, about = load_run(data_root() / "assets" / "policies" / given["policy"])
    commands = grid(GRID["x"], GRID["y"], GRID["yaw"], cross=False)
    off: Any = dict.fromkeys(("randomize", "push", "train_ground"), False)
    reports = []
    print("rate  velocity   cmd. 2.0 m/s  cmd. 1.8 rad/s  RMSE xy  RMSE yaw  falls", flush=True)
    for velocity in ("exact", "estimated"):
        for rate, physics_dt in PHYSICS_DT.items():
            wanted = EvalConfig(
                commands, int(given.get("episodes", 8)), 20.0, 2.0, noise=True, policy_dt=1 / rate, seed=1,
                physics_dt=physics_dt, trunk_velocity=velocity, **off,
            )  # fmt: skip
            report = evaluate(config.task, policy, wanted)
            reports.append(report | {"rate": rate, "policy": given["policy"], "sha256": about.get("sha256")})
            rows = report["commands"]
            few = [row for row in rows if modest(row)]
            fast, turn = speed(rows, (2.0, 0.0, 0.0), "x"), speed(rows, (0.0, 0.0, 1.8), "yaw")
            print(
                f"{rate:4d}  {velocity:9s}  {fast:12.2f}  {turn:14.2f}  {pooled(few, 'xy'):7.3f}  "
                f"{pooled(few, ('yaw',)):8.3f}  {report['falls']}/{report['episodes']}",
                flush=True,
            )
            if out := given.get("out"):
                Path(out).write_text(json.dumps(reports, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
