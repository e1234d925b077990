"""The batched environment from overrides, ``go1exp.make``, and checks of a program's arguments."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from typing import Any

from torch import Tensor

from go1exp import robot
from go1exp.base import memory
from go1exp.base.wording import counted
from go1exp.config.schema.physics import WarpBackend
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.engine import device_of, free_on
from go1exp.sim.task import TaskConfig, parse_train

MANY = 20_000
"""Fewer robots fit almost always: their state is not counted, which takes a second."""

ROBOT_BYTES, BESIDES_STATE = 6000, 5000
"""On the CPU: least memory of a robot, and what a robot takes besides its state (measured: 5 to 9 kB)."""

CONTACT_BYTES = 100
"""A contact that MuJoCo Warp has room for: positions, frame, solver parameters, geoms."""

FLOAT_BYTES = 4
DEGREES_OF_FREEDOM = 6 + robot.NUM_JOINTS


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
    refuse_too_many("num_envs", num_envs, task)
    return Go1Core(task, num_envs, seed, noise=noise, spread_starts=spread_starts)


def robot_bytes(task: TaskConfig, robots: int) -> int:
    """Return a lower bound of the memory of one of so many robots, B."""
    if isinstance(task.backend, WarpBackend):
        return FLOAT_BYTES * DEGREES_OF_FREEDOM * task.backend.njmax + CONTACT_BYTES * task.backend.nconmax
    if robots < MANY:
        return ROBOT_BYTES
    core = Go1Core(task, 1)
    core.reset()
    return _size(core.state_dict()) + BESIDES_STATE


def _size(state: object) -> int:
    if isinstance(state, dict):
        return sum(map(_size, state.values()))
    return state.nbytes if isinstance(state, Tensor) else 0


def refuse_too_many(key: str, value: int, task: TaskConfig, each: int = 1) -> None:
    """Refuse robots that for certain do not fit into memory.

    Args:
        key: setting that says how many robots there are.
        value: its value.
        task: what they do.
        each: robots for each of it.

    Raises:
        go1exp.config.schema.registry.ConfigError: naming the setting, and how many would fit.
    """
    available = free_on(device_of(task.backend))
    one = each * robot_bytes(task, value * each)
    if available is not None and value * one > available:
        amounts = f"with {counted(value * each, 'robot')} it {memory.too_much(value * one, available)}"
        raise ConfigError([f"{key} = {value}: {amounts}; {available // one} at most would fit"])


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
