"""Overrides of the smallest training that leaves a run folder, for tests of what comes after it."""

from __future__ import annotations

SMALL = (
    "ppo.num_envs=4",
    "ppo.steps=4",
    "ppo.minibatches=2",
    "ppo.epochs=1",
    "ppo.hidden=[16,8]",
    "ppo.iterations=2",
    "backend.threads=1",
    "torch_threads=1",
    "logger.tensorboard=false",
)
