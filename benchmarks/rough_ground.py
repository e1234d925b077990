"""Falls of a policy on the ground of training: ``python -m benchmarks.rough_ground run=FOLDER [speed=1.0]``.

As many robots on each level and kind of tile as there are columns of it, the noise and randomisation of training, no
pushes, a commanded ``speed`` m/s forward for ``seconds``; headings are random. A robot that leaves the map counts
as left and not as walked through. A shipped policy is ``run=assets/policies/NAME``. ``ground`` is the run whose terrain
it is, where that is another: policies are compared on one ground.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from go1exp.evaluate.rollout import EvalConfig, evaluation_task
from go1exp.evaluate.statistics.intervals import share_interval
from go1exp.mdp.commands import FixedVelocity
from go1exp.sim.env.core import Go1Core
from go1exp.train.policy import load_run

USAGE = (
    "usage: python -m benchmarks.rough_ground run=FOLDER [ground=FOLDER] [speed=1.0] [robots=200] [seconds=12] [seed=1]"
    " [out=F.json]"
)


def walked(run: Path, ground: Path, speed: float, robots: int, seconds: float, seed: int) -> dict[str, Any]:
    """Return what became of each robot: its level, kind of tile, whether it fell or left, and how far it came, m."""
    config, policy, about = load_run(run)
    task = replace(config.task, terrain=load_run(ground)[0].task.terrain)
    command = (speed, 0.0, 0.0)
    wanted = EvalConfig(
        (command,), robots, seconds, 0.0, noise=True, randomize=True, push=False, train_ground=True,
        policy_dt=None, seed=seed,
    )  # fmt: skip
    core = Go1Core(evaluation_task(task, wanted), robots, seed)
    assert isinstance(core.command, FixedVelocity)
    core.command.value.copy_(torch.tensor(command))
    core.reset()
    levels = core.task.terrain.rows
    core.level.copy_(torch.arange(robots) // core.task.terrain.cols % levels)
    observation = core.reset()
    kinds = [core.terrain.tile_types[int(column)] for column in core.tile_column]
    fell, left, far = (torch.zeros(robots) for _ in range(3))
    for _ in range(round(seconds / core.task.sim.policy_dt)):
        before, level = core.backend.qpos[:, :2].clone(), core.level.clone()
        result = core.step(policy(observation))
        core.check(result)
        observation, walking = result.observation, (fell + left) == 0
        far = torch.where(walking, (before - core.spawn[:, :2]).norm(dim=-1).float(), far)
        fell += walking & result.terminated
        left += walking & result.truncated
        assert torch.equal(level, core.level)
    figures = {"level": core.level, "fell": fell.bool(), "left": left.bool(), "far_m": far}
    return {
        "run": str(run), "ground": str(ground), "checkpoint": about.get("sha256"), "speed": speed, "seconds": seconds,
        "seed": seed,
        "robots": [dict(zip((*figures, "kind"), row, strict=True)) for row in zip(
            *(v.tolist() for v in figures.values()), kinds, strict=True)],
    }  # fmt: skip


def printed(rows: Sequence[dict[str, Any]], levels: int) -> str:
    """Return a table: falls of each kind of tile by level."""
    kinds = sorted({row["kind"] for row in rows})
    lines = [f"{'level':>10} " + " ".join(f"{level:>6}" for level in range(levels)) + "    all   walked, m (median)"]
    for kind in (*kinds, "all"):
        of = [row for row in rows if kind in (row["kind"], "all")]
        by_level = [[row for row in of if row["level"] == level] for level in range(levels)]
        cells = [f"{sum(r['fell'] for r in some):>3}/{len(some):<3}" for some in (*by_level, of)]
        far = sorted(row["far_m"] for row in of)[len(of) // 2]
        lines.append(f"{kind:>10} {' '.join(cells)}  {far:.1f}")
    share = share_interval(sum(row["fell"] for row in rows), len(rows))
    lines.append(f"fell {100 * share.estimate:.1f} % (95 %: {100 * share.low:.1f} to {100 * share.high:.1f} %)")
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> None:
    """Walk, print the table, and write each robot's row to ``out``."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if not {"run"} <= set(given) <= {"run", "ground", "speed", "robots", "seconds", "seed", "out"}:
        raise SystemExit(USAGE)
    report = walked(
        Path(given["run"]), Path(given.get("ground", given["run"])), float(given.get("speed", 1)),
        int(given.get("robots", 200)), float(given.get("seconds", 12)), int(given.get("seed", 1)),
    )  # fmt: skip
    print(printed(report["robots"], 1 + max(row["level"] for row in report["robots"])), flush=True)
    if "out" in given:
        Path(given["out"]).write_text(json.dumps(report), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
