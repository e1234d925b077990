"""Overrides of tiny trainings."""

from __future__ import annotations


def small(*overrides: str, **ppo: object) -> tuple[str, ...]:
    """Return the overrides of the smallest training that leaves a run folder.

    ``ppo`` changes its sizes; ``overrides`` are added.
    """
    sizes = {"num_envs": 4, "steps": 4, "minibatches": 2, "epochs": 1, "hidden": "[16,8]", "iterations": 2, **ppo}
    sizes.setdefault("schedule", "fixed")
    machine = ("backend.threads=1", "torch_threads=1", "logger.tensorboard=false")
    return (*(f"ppo.{key}={value}" for key, value in sizes.items()), *machine, *overrides)


SMALL = small()
