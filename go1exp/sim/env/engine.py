"""The physics engine that a configuration names, the policy step as one captured graph, and restarts of episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from go1exp.base import memory
from go1exp.base.tensors.randomness import EnvRandom
from go1exp.config.schema.physics import BackendConfig, PhysxBackend, WarpBackend
from go1exp.mdp.types import StepResult
from go1exp.sim.physics.backend import PhysicsBackend
from go1exp.sim.physics.mujoco_cpu import MujocoCpu
from go1exp.sim.physics.scene import Sensors

T = TypeVar("T")


def make_backend(config: BackendConfig, model: Any, sensors: Sensors, num_envs: int) -> PhysicsBackend:
    """Build the physics engine that the configuration names.

    Raises:
        go1exp.config.schema.registry.Expected: if its packages are not installed.
        go1exp.config.schema.registry.ConfigError: if its device is not there.
    """
    if isinstance(config, WarpBackend):
        from go1exp.sim.physics.mujoco_warp import MujocoWarp  # its packages are an extra

        limits = {"nconmax": config.nconmax, "njmax": config.njmax}
        return MujocoWarp(model, sensors, num_envs, device=config.device, **limits)
    if isinstance(config, PhysxBackend):
        from go1exp.sim.physics.physx import PhysxCpu  # its package is an extra

        return PhysxCpu(model, sensors, num_envs, config)
    return MujocoCpu(model, sensors, num_envs, config.threads)


def device_of(config: BackendConfig) -> torch.device:
    """Return the device on which an engine's robots are."""
    return torch.device(config.device if isinstance(config, WarpBackend) else "cpu")


def free_on(device: torch.device) -> int | None:
    """Return the free memory of a device, B; None where it is unknown."""
    if device.type != "cuda":
        return memory.free()
    return int(torch.cuda.mem_get_info(device)[0]) if torch.cuda.is_available() else None


class Steps(Protocol):
    """An environment whose step may be part of a graph."""

    backend: Any
    """With ``capture``, as ``MujocoWarp`` has it."""

    def step_by_call(self, action: Tensor) -> StepResult:
        """Step."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything that steps change."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put it back."""


def captured(env: Steps, work: Callable[[], T]) -> tuple[Callable[[], None], T]:
    """Record ``work``, which steps ``env`` call by call, as one graph; the runs before that leave no trace in ``env``.

    Returns:
        the replay, and what ``work`` returned, written anew by each replay.
    """
    state = env.state_dict()
    recorded: tuple[Callable[[], None], T] = env.backend.capture(work)
    env.load_state_dict(state)
    return recorded


class CapturedStep:
    """The step of an environment as one graph."""

    def __init__(self, env: Steps, action: Tensor) -> None:
        """Record it for actions (N, A) like this one."""
        self._action = torch.zeros_like(action)
        self._replay, self._result = captured(env, lambda: env.step_by_call(self._action))

    def __call__(self, action: Tensor) -> StepResult:
        """Step; the result's tensors are always the same ones."""
        self._action.copy_(action)
        self._replay()
        return self._result


class Restarts:
    """Calls a restart of the rows of a mask; where looking at the mask is free and it is empty, only counters move.

    A restart draws the same number of random numbers whatever the mask, so that a robot's do not depend on the others
    of its batch. For a few robots on a CPU an empty restart would cost a quarter of the step; on a GPU looking would
    cost more.
    """

    def __init__(self, restart: Callable[[Tensor], None], randoms: Sequence[EnvRandom]) -> None:
        """Wrap ``restart``, which draws from ``randoms`` only."""
        self._restart, self._randoms = restart, list(dict.fromkeys(randoms))
        self._draws: list[dict[str, int]] | None = None

    def __call__(self, mask: Tensor) -> None:
        """Restart the rows of ``mask`` (N,) bool."""
        if mask.is_cuda:
            self._restart(mask)
        elif self._draws is None or mask.any():
            before = [random.counters() for random in self._randoms]
            self._restart(mask)
            after = [random.counters() for random in self._randoms]
            self._draws = [
                {name: count - old.get(name, 0) for name, count in new.items() if count != old.get(name, 0)}
                for old, new in zip(before, after, strict=True)
            ]
        else:
            for random, draws in zip(self._randoms, self._draws, strict=True):
                random.leave_out(draws)
