"""What drives robots in evaluation: a trained policy or another controller (bundles: evaluate/protocol/bundles.py)."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from go1exp.config.schema.history import history_columns
from go1exp.deploy.runtime.past import Past
from go1exp.evaluate.controller.batch import Driven
from go1exp.evaluate.controller.types import Controller
from go1exp.evaluate.estimated import TERM, EstimatedVelocity
from go1exp.evaluate.observed import TrunkVelocity, columns
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig
from go1exp.train.policy import Policy


class Pilot(Protocol):
    """Drives the N robots of one environment.

    It is called once a policy step and may have hung itself into the environment's physics steps before that
    (``Plant.observer``, ``backend.step``), as a controller with a rate of its own does.
    """

    def __call__(self, observation: Tensor) -> Tensor:
        """Return the actions (N, 12) of the next policy step for the observations (N, O)."""

    def save(self) -> Any | None:
        """Return a copy of everything that it remembers, or None if that cannot be put back."""

    def load(self, state: Any) -> None:
        """Put back what ``save`` returned."""


class Driver(Protocol):
    """Something that drives robots, before there are any."""

    @property
    def label(self) -> str:
        """Name in reports."""

    @property
    def task(self) -> TaskConfig:
        """The robot, rates and observations that it was made for."""

    @property
    def about(self) -> dict[str, Any]:
        """Plain data on its origin, for reports."""

    @property
    def senses(self) -> bool:
        """Whether it reads the robots' sensors itself, the IMU too, at a rate of its own."""

    def problems(self, trunk_velocity: TrunkVelocity, key: str) -> list[str]:
        """Return why it cannot be played so, each beginning with the ``key`` that asks for it."""

    def begin(self, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> Pilot:
        """Take the robots of an environment, which is to be reset next."""


@dataclass(frozen=True)
class PolicyDriver:
    """A trained policy: observations in, actions out."""

    label: str
    task: TaskConfig
    policy: Policy
    about: dict[str, Any] = field(default_factory=dict)
    senses: ClassVar[bool] = False

    def problems(self, trunk_velocity: TrunkVelocity, key: str) -> list[str]:
        """Return why the policy cannot be played so."""
        if trunk_velocity == "estimated" and columns(self.task, TERM) is None:
            return [f"{key} = 'estimated': the policy of {self.label} does not see {TERM}"]
        return []

    def begin(self, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> Pilot:
        """Take the robots of an environment."""
        return _PolicyPilot(self, core, trunk_velocity, seed)


class _PolicyPilot:
    def __init__(self, driver: PolicyDriver, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> None:
        self._policy, self._core = driver.policy, core
        self._filter = EstimatedVelocity(core, core.noise, seed) if trunk_velocity == "estimated" else None
        # A policy that runs faster than it was trained sees its action, and frames, of one training period ago.
        self._past = Past[tuple[Tensor, Tensor]](driver.task.sim.policy_dt, core.task.sim.policy_dt)
        self._columns = columns(core.task, "previous_action") if self._past.cycles > 1 else None
        self._history = history_columns(core.task.observation)
        self._remembered: tuple[Tensor, Tensor] | None = None

    def __call__(self, observation: Tensor) -> Tensor:
        if self._past.cycles == 1 and self._filter is None:
            return self._policy(observation)
        observation = observation.clone() if self._filter is None else self._filter.put(observation)
        if self._columns is not None:
            observation[:, self._columns] = 0.0 if self._remembered is None else self._remembered[0]
        history, kept = self._history, self._remembered
        observation[:, history.earlier] = observation[:, history.newest] if kept is None else kept[1]
        action = self._policy(observation)
        clip = self._core.task.action.clip
        newest = action.clamp(-clip, clip), observation[:, history.carried]
        first = torch.zeros_like(action), observation[:, history.earlier]
        self._remembered = self._past.after(newest, first if kept is None else kept)
        return action

    def save(self) -> Any | None:
        return None if self._filter else copy.deepcopy((self._past, self._remembered))

    def load(self, state: Any) -> None:
        self._past, self._remembered = copy.deepcopy(state)


@dataclass(frozen=True)
class ControllerDriver:
    """Controllers of their own rate, one for each robot (``go1exp/evaluate/controller``)."""

    label: str
    task: TaskConfig
    make: Callable[[], Controller]
    about: dict[str, Any] = field(default_factory=dict)
    senses: ClassVar[bool] = True

    def problems(self, trunk_velocity: TrunkVelocity, key: str) -> list[str]:
        """Return nothing: a controller takes either velocity."""
        return []

    def begin(self, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> Pilot:
        """Take the robots of an environment."""
        return Driven(core, self.make, noise=core.noise, seed=seed, trunk_velocity=trunk_velocity)


Progress = Callable[[int, int], None]
"""Called with what is done and all that there is to do."""
