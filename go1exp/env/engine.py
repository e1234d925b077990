"""The physics engine that a configuration names, and the policy step as one piece of work for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from go1exp.backends import BackendConfig, CpuBackend
from go1exp.physics.backend import PhysicsBackend
from go1exp.physics.mujoco_cpu import MujocoCpu
from go1exp.physics.scene import Sensors
from go1exp.types import StepResult

T = TypeVar("T")


def make_backend(config: BackendConfig, model: Any, sensors: Sensors, num_envs: int) -> PhysicsBackend:
    """Build the physics engine that the configuration names.

    Raises:
        go1exp.registry.Expected: if its packages are not installed.
        go1exp.registry.ConfigError: if its device is not there.
    """
    if isinstance(config, CpuBackend):
        return MujocoCpu(model, sensors, num_envs, config.threads)
    from go1exp.physics.mujoco_warp import MujocoWarp  # its packages are an extra

    return MujocoWarp(
        model,
        sensors,
        num_envs,
        device=config.device,
        nconmax=config.nconmax,
        njmax=config.njmax,
    )


class Captures(Protocol):
    """A backend that can record what is done to its device and repeat it at once."""

    def capture(self, work: Callable[[], T]) -> tuple[Callable[[], None], T]:
        """Run ``work`` a few times, record it, and return the replay and what ``work`` returned, live."""


class CapturedStep:
    """A step that is recorded when it is first called, and replayed from then on.

    Args:
        backend: does the recording.
        step: the step.
        action: a tensor of the actions' shape.
        keep: returns everything that the step changes.
        restore: puts that back: the runs before a recording leave no trace.
    """

    def __init__(
        self,
        backend: Captures,
        step: Callable[[Tensor], StepResult],
        action: Tensor,
        keep: Callable[[], dict[str, Any]],
        restore: Callable[[dict[str, Any]], None],
    ) -> None:
        self._backend, self._step, self._keep, self._restore = backend, step, keep, restore
        self._action = torch.zeros_like(action)
        self._replay: Callable[[], None] | None = None
        self._result: StepResult | None = None

    def __call__(self, action: Tensor) -> StepResult:
        """Step; the result's tensors are always the same ones."""
        if self._replay is None:
            state = self._keep()
            self._replay, self._result = self._backend.capture(lambda: self._step(self._action))
            self._restore(state)
        self._action.copy_(action)
        self._replay()
        assert self._result is not None
        return self._result
