"""``suite=train``: speed of training relative to the environment alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from go1exp.evaluate.bench.env import core_subject
from go1exp.evaluate.bench.measure import Subject, rates, ratio
from go1exp.sim.task import TrainConfig
from go1exp.train import trainer


def train_subject(config: TrainConfig) -> Subject:
    """Whole iterations: rollout, advantages, update."""
    ppo = trainer.build(config)
    size = config.ppo.num_envs * config.ppo.steps

    def work() -> int:
        ppo.learn(size, reset_num_timesteps=ppo.iteration == 0)
        return size

    return Subject("training", work)


def run(
    config: TrainConfig, num_envs: int, rounds: int, seconds: float, on_round: Callable[[int, int], None]
) -> dict[str, float]:
    """Measure; return the figures by name."""
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, num_envs=num_envs))
    subjects = {"train": train_subject(config), "env": core_subject(config.task, num_envs)}
    measured = rates(subjects, rounds, seconds, on_round)
    return {
        "train_steps_per_s": float(np.median(measured["train"])),
        "env_steps_per_s": float(np.median(measured["env"])),
        "train_over_env": ratio(measured, "train", "env"),
    }
