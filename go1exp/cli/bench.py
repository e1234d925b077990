"""``go1exp bench``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from go1exp.cli.app import App, spinner

BARS = {
    "env_over_bare": (0.75, "environment over bare mujoco.batch of the same model"),
    "env_over_subproc": (5.0, "environment over SB3's SubprocVecEnv of our Go1Env on all cores"),
    "train_over_env": (0.35, "end-to-end training over environment"),
    "memory_per_env_kb": (100.0, "memory per environment beyond the first, kB (at most)"),
}
"""Figures with a goal: its value and what it is. All are lower limits but the memory."""


def _task(container: dict[str, Any]) -> None:
    from go1exp.cli.settings import BenchSettings, parse

    settings = parse(BenchSettings, container)

    from go1exp.compose import compose
    from go1exp.config import parse_train

    overrides = [f"backend.threads={settings.threads}", *settings.overrides]
    config = parse_train(compose("train", overrides))

    from go1exp.bench import env, train
    from go1exp.bench.measure import machine

    show = spinner(settings.rounds, f"measuring {settings.suite}")
    timing = (settings.num_envs, settings.rounds, settings.seconds, show)
    figures = env.run(config.task, overrides, *timing) if settings.suite == "env" else train.run(config, *timing)
    about = " ".join(settings.overrides) or "defaults"
    print(f"suite={settings.suite} N={settings.num_envs} ({about})\n{machine()}\n")
    for name, value in figures.items():
        goal, meaning = BARS.get(name, (None, name.replace("_per_s", " per second").replace("_", " ")))
        aim = "" if goal is None else f"goal {goal:g}"
        print(f"{value:12,.2f}  {aim:10} {meaning}")
    if settings.out:
        out = Path(settings.out)
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(figures, indent=2) + "\n")
        print(f"\nwritten to {out}")


APP = App("bench", _task)
