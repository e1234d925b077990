"""What drives the robots of a protocol: a trained policy, that of a bundle, or another controller."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from go1exp.config import TaskConfig
from go1exp.controller.batch import Driven
from go1exp.controller.types import Controller
from go1exp.deploy.bundle import Bundle
from go1exp.deploy.past import PastActions
from go1exp.env.core import Go1Core
from go1exp.evaluate.estimated import TERM, EstimatedVelocity
from go1exp.evaluate.observed import columns
from go1exp.evaluate.policy import Policy
from go1exp.export.trace import readings
from go1exp.protocol.signals import TrunkVelocity
from go1exp.sim_robot.machine import noisy


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
        # A policy that runs faster than it was trained sees its action of one training period ago.
        self._past = PastActions[Tensor](driver.task.sim.policy_dt, core.task.sim.policy_dt)
        self._columns = columns(core.task, "previous_action") if self._past.cycles > 1 else None
        self._past_action: Tensor | None = None

    def __call__(self, observation: Tensor) -> Tensor:
        if self._columns is not None:
            observation = observation.clone()
            observation[:, self._columns] = 0.0 if self._past_action is None else self._past_action
        if self._filter is not None:
            observation = self._filter.put(observation)
        action = self._policy(observation)
        if self._columns is not None:
            self._past_action = self._past.after(
                action.clamp(-self._core.task.action.clip, self._core.task.action.clip)
            )
        return action

    def save(self) -> Any | None:
        return None if self._filter else copy.deepcopy((self._past, self._past_action))

    def load(self, state: Any) -> None:
        self._past, self._past_action = copy.deepcopy(state)


@dataclass(frozen=True)
class BundleDriver:
    """The policy of a bundle as the robot's computer runs it: readings in, by ONNX.

    Its noise is that of the robot's sensors (the simulated robot's of ``go1exp deploy``), not that of training.
    """

    label: str
    task: TaskConfig
    bundle: Bundle
    about: dict[str, Any] = field(default_factory=dict)
    senses: ClassVar[bool] = False

    def problems(self, trunk_velocity: TrunkVelocity, key: str) -> list[str]:
        """Return why the bundle cannot be played so."""
        names = [port.name for port in self.bundle.metadata.inputs]
        if trunk_velocity == "estimated" and "base_lin_vel_b" not in names:
            return [f"{key} = 'estimated': the policy of {self.label} does not see base_lin_vel_b"]
        return []

    def begin(self, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> Pilot:
        """Take the robots of an environment."""
        return _BundlePilot(self, core, trunk_velocity, seed)


NOISY = {"joint_pos": "q", "joint_vel": "qd", "imu_quat": "quat", "imu_gyro": "gyro"}
"""Readings and the names of their noise."""


class _BundlePilot:
    def __init__(self, driver: BundleDriver, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> None:
        self._bundle, self._core = driver.bundle, core
        self._filter = EstimatedVelocity(core, core.noise, seed) if trunk_velocity == "estimated" else None
        self._past = PastActions[np.ndarray](driver.bundle.metadata.policy_dt, core.task.sim.policy_dt)
        self._past_action = np.zeros((core.num_envs, 12), np.float32)
        self._rng = np.random.default_rng([seed, 3])

    def __call__(self, observation: Tensor) -> Tensor:
        now = {name: values.numpy() for name, values in readings(self._core).items()}
        now["previous_action"] = self._past_action
        if self._core.noise:
            zeros = {"acc": np.zeros((len(observation), 3)), "foot_force": np.zeros((len(observation), 4))}
            read = noisy({short: now[name] for name, short in NOISY.items()} | zeros, 1.0, self._rng)
            now |= {name: read[short].astype(np.float32) for name, short in NOISY.items()}
        if self._filter is not None:
            now["base_lin_vel_b"] = self._filter.velocities().astype(np.float32)
        action = self._bundle.policy(now)["action"]
        self._past_action = self._past.after(action)
        return torch.from_numpy(action)

    def save(self) -> Any | None:
        return None if self._filter else copy.deepcopy((self._past, self._past_action, self._rng))

    def load(self, state: Any) -> None:
        self._past, self._past_action, self._rng = copy.deepcopy(state)


@dataclass(frozen=True)
class ControllerDriver:
    """Controllers of their own rate, one for each robot (``go1exp/controller``)."""

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
