"""``go1exp eval``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from go1exp.cli.app import App, spinner


def _task(container: dict[str, Any]) -> None:
    from go1exp.cli.settings import EvalSettings, parse

    settings = parse(EvalSettings, container)
    run = Path(settings.run)

    from go1exp.config import parse_train
    from go1exp.evaluate import table
    from go1exp.evaluate.policy import load_policy
    from go1exp.evaluate.rollout import EvalConfig, evaluate, grid
    from go1exp.train import run_folder

    trained = parse_train(run_folder.read_config(run))
    policy, about = load_policy(run, trained.ppo, Path(settings.checkpoint) if settings.checkpoint else None)
    config = EvalConfig(
        commands=grid(settings.grid.x, settings.grid.y, settings.grid.yaw, settings.grid.cross),
        episodes=settings.episodes,
        duration_s=settings.duration_s,
        settle_s=settings.settle_s,
        noise=settings.noise,
        rand=settings.rand,
        push=settings.push,
        terrain=settings.terrain,
        policy_dt=settings.policy_dt,
        seed=settings.seed,
    )
    report = {"policy": about, **evaluate(trained.task, policy, config, spinner(1, "evaluating"))}
    out = Path(settings.out) if settings.out else run / "eval.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(report, indent=2) + "\n")
    print(table.text(report))
    print(f"\nwritten to {out}")


APP = App("eval", _task)
