"""``suite=train``: speed of training relative to the environment alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from go1exp.evaluate.bench.env import core_subject
from go1exp.evaluate.bench.measure import Subject, rates, ratio
from go1exp.sim.task import TrainConfig
from go1exp.train import trainer
from go1exp.train.ppo import AdaptivePPO


def learning(ppo: AdaptivePPO, config: TrainConfig, label: str, finish: Callable[[], None] = lambda: None) -> Subject:
    """Whole iterations: rollout, advantages, update; ``finish`` waits for the device."""
    size = config.ppo.num_envs * config.ppo.steps

    def work() -> int:
        ppo.learn(size, reset_num_timesteps=ppo.iteration == 0)
        finish()
        return size

    return Subject(label, work)


def run(
    config: TrainConfig, num_envs: int, rounds: int, seconds: float, on_round: Callable[[int, int], None]
) -> dict[str, float]:
    """Measure; return the figures by name."""
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, num_envs=num_envs))
    subjects = {
        "train": learning(trainer.build(config), config, "training"),
        "env": core_subject(config.task, num_envs),
    }
    measured = rates(subjects, rounds, seconds, on_round)
    return {
        "train_steps_per_s": float(np.median(measured["train"])),
        "env_steps_per_s": float(np.median(measured["env"])),
        "train_over_env": ratio(measured, "train", "env"),
    }
