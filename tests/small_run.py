"""Tiny trainings, and what is made of one."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from filelock import FileLock

from go1exp.config.compose import compose
from go1exp.sim.task import parse_train
from go1exp.train import run_folder, trainer
from go1exp.train.ppo import AdaptivePPO

PLAIN = {"actuator": "pd", "contact": "soft"}


def plain(*overrides: str) -> tuple[str, ...]:
    """Add actuators without latency and soft ground to the overrides of a task, unless they choose others."""
    chosen = {override.partition("=")[0] for override in overrides}
    if "experiment" in chosen:
        return overrides
    return (*overrides, *(f"{key}={value}" for key, value in PLAIN.items() if key not in chosen))


def small(*overrides: str, **ppo: object) -> tuple[str, ...]:
    """Return the overrides of the smallest training that leaves a run folder.

    ``ppo`` changes its sizes; ``overrides`` are added.
    """
    sizes = {"num_envs": 4, "steps": 4, "minibatches": 2, "epochs": 1, "hidden": "[16,8]", "iterations": 2, **ppo}
    sizes.setdefault("schedule", "fixed")
    threads = () if "backend=warp" in overrides else ("backend.threads=1",)
    machine = (*threads, "torch_threads=1", "logger.tensorboard=false")
    return plain(*(f"ppo.{key}={value}" for key, value in sizes.items()), *machine, *overrides)


SMALL = small()


def train(run: Path, overrides: Sequence[str] = SMALL) -> AdaptivePPO:
    """Do in this process what ``go1exp train`` does in its own; return the learner."""
    container = compose("train", overrides)
    config = parse_train(container)
    run_folder.write(run, container)
    return trainer.train(config, container, run)


def trained(run: Path, *overrides: str) -> Path:
    """Make a run folder of the smallest training with some overrides; return it."""
    train(run, (*SMALL, *overrides))
    return run


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a file or folder that all processes of this test session share; the first makes it."""
    base = factory.getbasetemp()
    path = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with FileLock(f"{path}.lock"):
        if not path.exists():
            make(unfinished := path.with_name(f"unfinished_{name}"))
            unfinished.rename(path)
    return path
