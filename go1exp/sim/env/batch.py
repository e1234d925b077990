"""The batched environment from overrides, ``go1exp.make``, and checks of a program's arguments."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from typing import Any

from go1exp.config.schema.registry import ConfigError
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.engine import refuse_too_many
from go1exp.sim.task import TaskConfig, parse_train


def make(
    overrides: Sequence[str] = (),
    num_envs: int = 1024,
    seed: int = 0,
    *,
    noise: bool = True,
    spread_starts: bool = False,
) -> Go1Core:
    """Return N robots that step together on torch tensors, as training has them.

    ``reset()`` returns observations (N, O); ``step(actions)`` takes (N, 12) and returns a ``StepResult``; episodes that
    end begin anew by themselves. All tensors are on ``device`` of the result and valid until the next step.

    Args:
        overrides: as after ``go1exp train``; those of the learner and the run are checked and have no effect.
        num_envs: N.
        seed: of everything random.
        noise: add the configured observation noise.
        spread_starts: let first episodes begin at random times, so that not all end together.

    Raises:
        go1exp.config.schema.registry.ConfigError: if an override, a number of robots or a seed is invalid.
    """
    num_envs, seed = whole("num_envs", num_envs, 1), whole("seed", seed, 0)
    task = task_of(overrides)
    refuse_too_many("num_envs", num_envs, task.backend)
    return Go1Core(task, num_envs, seed, noise=noise, spread_starts=spread_starts)


def task_of(overrides: object) -> TaskConfig:
    """Return the task of ``go1exp train`` with overrides; raise ConfigError, as the command line does."""
    from go1exp.config.compose import compose_checked

    return parse_train(compose_checked("train", listed(overrides))).task


def whole(name: str, value: Any, least: int) -> int:
    """Return a whole number of at least ``least``.

    Raises:
        ConfigError: if ``value`` is something else.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = least - 1
    if isinstance(value, bool) or number < least:
        raise ConfigError([f"{name} = {value!r}: must be a whole number, {least} or more"])
    return number


def listed(overrides: Any) -> Sequence[str]:
    """Return overrides as a list.

    Raises:
        ConfigError: if they are one text, or one of them is no text.
    """
    if isinstance(overrides, str):
        raise ConfigError([f"overrides = {overrides!r}: must be a list of texts, such as [{overrides!r}]"])
    given = list(overrides) if isinstance(overrides, Iterable) else [overrides]
    if not isinstance(overrides, Iterable) or not all(isinstance(text, str) for text in given):
        raise ConfigError([f"overrides = {overrides!r}: must be a list of texts, such as ['reward=paper']"])
    return given
