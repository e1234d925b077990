"""What moves robots in evaluation: a trained policy, the policy of a bundle, or another controller."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from go1exp.config.schema.history import frame_width, history_columns, width
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.estimation import Filters
from go1exp.deploy.export.build import readings
from go1exp.deploy.runtime.bundle import Bundle
from go1exp.deploy.runtime.policy import Past, PolicyMemory
from go1exp.deploy.sim_robot.machine import noisy
from go1exp.evaluate.controller.batch import Driven
from go1exp.evaluate.controller.types import Controller, TrunkVelocity
from go1exp.logs.record.simulate import sample
from go1exp.mdp.derived import limited
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig
from go1exp.train.policy import Policy


class RunningAgent(Protocol):
    """An agent that moves the N robots of one environment.

    It is called once a policy step and may also act in the physics steps (``Plant.observer``, ``backend.step``), as a
    controller with a rate of its own does.
    """

    def __call__(self, observation: Tensor) -> Tensor:
        """Return the actions (N, 12) of the next policy step for the observations (N, O)."""

    def save(self) -> Any | None:
        """Return a copy of the memory, or None if it cannot be restored."""

    def load(self, state: Any) -> None:
        """Restore what ``save`` returned."""


@dataclass(frozen=True)
class Agent:
    """What moves robots in an evaluation, before there are any."""

    label: str  # name in reports
    task: TaskConfig  # the robot, rates and observations that it was made for
    about: Mapping[str, object] = field(default_factory=dict, kw_only=True)  # plain data on its origin, for reports
    senses: ClassVar[bool] = False  # whether it reads the robots' sensors itself, the IMU too, at a rate of its own

    def problems(self, trunk_velocity: TrunkVelocity, key: str) -> list[str]:
        """Return why it cannot be played so, each message beginning with the ``key`` of the setting."""
        if trunk_velocity == "exact" or (name := self.unseen()) is None:
            return []
        return [f"{key} = 'estimated': the policy of {self.label} does not see {name}"]

    def unseen(self) -> str | None:
        """Return the name of the trunk's velocity if the agent observes velocities without it; else None."""
        return None

    def begin(self, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> RunningAgent:
        """Take the robots of an environment, which is to be reset next."""
        raise NotImplementedError


TERM = "base_linear_velocity"


def columns(task: TaskConfig, term: str) -> slice | None:
    """Return the columns of a term's newest values in the observation; None if the policy does not observe it."""
    start = 0
    for t in task.observation:
        if t.entry.name == term:
            return slice(start, start + frame_width(t))
        start += width(t)
    return None


class VelocityFilters:
    """One Kalman filter for each robot of an environment, updated with its sensors in every physics step."""

    def __init__(self, core: Go1Core, noise: bool, seed: int) -> None:
        """Observe the plant of ``core``, built with ``imu=True``; raise EstimatorError if the filter is not built.

        ``noise`` adds the noise of the paper's Table II, and a logger's to accelerometer and feet, drawn by ``seed``.
        """
        self._filters, self._columns = Filters(core.num_envs), columns(core.task, TERM)
        self._plant, self._dt, self._steps = core.plant, core.task.sim.physics_dt, 0
        self._noise, self._rng = float(noise), np.random.default_rng([seed, 2])
        self._observer, core.plant.observer = core.plant.observer, self._update

    def velocities(self) -> NDArray[np.float64]:
        """Return the estimated velocities of the trunks in their own frames (N, 3), m/s; zero until a filter runs."""
        return self._filters.velocities

    def put(self, observation: Tensor) -> Tensor:
        """Return the observation (N, O) with the estimated velocity in place of the true one."""
        changed = observation.clone()
        changed[:, self._columns] = torch.as_tensor(self.velocities(), dtype=observation.dtype)
        return changed

    def restart(self, env: int) -> None:
        """Initialise one robot's filter with its next sample."""
        self._filters.restart(env)

    def _update(self, target: Tensor) -> None:
        if self._observer is not None:
            self._observer(target)
        true = {name: values.cpu().numpy() for name, values in sample(self._plant, target).items()}
        self._filters.update(self._steps * self._dt, noisy(true, self._noise, self._rng))
        self._steps += 1


def estimator(core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> VelocityFilters | None:
    """Return the filters of a policy that observes the estimated velocity, else None; raise ConfigError without one."""
    if trunk_velocity == "exact":
        return None
    if columns(core.task, TERM) is None:
        raise ConfigError([f"trunk_velocity = 'estimated': the policy does not see {TERM}"])
    return VelocityFilters(core, core.noise, seed)


@dataclass(frozen=True)
class PolicyAgent(Agent):
    """A trained policy: observations in, actions out."""

    policy: Policy

    def unseen(self) -> str | None:
        """Return the term of the trunk's velocity if the policy does not observe it."""
        return TERM if columns(self.task, TERM) is None else None

    def begin(self, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> RunningAgent:
        """Take the robots of an environment."""
        return _RunningPolicy(self, core, trunk_velocity, seed)


class _RunningPolicy:
    def __init__(self, agent: PolicyAgent, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> None:
        self._policy, self._limits = agent.policy, agent.task.action.limits
        self._filter = estimator(core, trunk_velocity, seed)
        # A policy that runs faster than it was trained: its mean action and its frames of a training period (``Past``).
        periods = agent.task.sim.policy_dt, core.task.sim.policy_dt
        self._actions, self._frames = Past[Tensor](*periods), Past[Tensor](*periods)
        self._columns = columns(core.task, "previous_action") if self._actions.cycles > 1 else None
        self._history = history_columns(core.task.observation)
        self._earlier: Tensor | None = None

    def __call__(self, observation: Tensor) -> Tensor:
        if self._actions.cycles == 1 and self._filter is None:
            return self._policy(observation)
        observation = observation.clone() if self._filter is None else self._filter.put(observation)
        if self._columns is not None:
            observation[:, self._columns] = self._actions.mean()
        history = self._history
        observation[:, history.earlier] = observation[:, history.newest] if self._earlier is None else self._earlier
        action = self._policy(observation)
        if self._actions.cycles > 1:  # else the environment limits it
            nothing = torch.zeros_like(action)
            lowest, highest = (self._actions.extreme(rule, nothing) for rule in (torch.minimum, torch.maximum))
            action = limited(action, lowest, *self._limits, highest)
            self._actions.add(action)
        self._frames.add(observation[:, history.carried])
        self._earlier = self._frames.earlier(observation[:, history.earlier])
        return action

    def save(self) -> tuple[Past[Tensor], Past[Tensor], Tensor | None] | None:
        return None if self._filter else copy.deepcopy((self._actions, self._frames, self._earlier))

    def load(self, state: tuple[Past[Tensor], Past[Tensor], Tensor | None]) -> None:
        self._actions, self._frames, self._earlier = copy.deepcopy(state)


@dataclass(frozen=True)
class BundleAgent(Agent):
    """The policy of a bundle as the robot's computer runs it, by ONNX; noise is that of the robot's sensors."""

    bundle: Bundle

    def unseen(self) -> str | None:
        """Return the name of the trunk's velocity if it is no input of the bundle."""
        name = "base_lin_vel_b"
        return None if any(port.name == name for port in self.bundle.metadata.inputs) else name

    def begin(self, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> RunningAgent:
        """Take the robots of an environment."""
        return _RunningBundle(self, core, trunk_velocity, seed)


NOISY = {"joint_pos": "q", "joint_vel": "qd", "imu_quat": "quat", "imu_gyro": "gyro"}
"""Readings and the names of their noise."""


class _RunningBundle:
    def __init__(self, agent: BundleAgent, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> None:
        self._bundle, self._core = agent.bundle, core
        self._filter = estimator(core, trunk_velocity, seed)
        self._memory = PolicyMemory(agent.bundle.metadata, core.task.sim.policy_dt, core.num_envs)
        self._rng = np.random.default_rng([seed, 3])

    def __call__(self, observation: Tensor) -> Tensor:
        now = {name: values.numpy() for name, values in readings(self._core).items()}
        if self._core.noise:
            zeros = {"acc": np.zeros((len(observation), 3)), "foot_force": np.zeros((len(observation), 4))}
            read = noisy({short: now[name] for name, short in NOISY.items()} | zeros, 1.0, self._rng)
            now |= {name: read[short].astype(np.float32) for name, short in NOISY.items()}
        if self._filter is not None:
            now["base_lin_vel_b"] = self._filter.velocities().astype(np.float32)
        return torch.from_numpy(self._memory(self._bundle.policy, now)["action"])

    def save(self) -> tuple[PolicyMemory, np.random.Generator] | None:
        return None if self._filter else copy.deepcopy((self._memory, self._rng))

    def load(self, state: tuple[PolicyMemory, np.random.Generator]) -> None:
        self._memory, self._rng = copy.deepcopy(state)


@dataclass(frozen=True)
class ControllerAgent(Agent):
    """Controllers of their own rate, one for each robot (``go1exp/evaluate/controller``)."""

    make: Callable[[], Controller]
    senses: ClassVar[bool] = True

    def begin(self, core: Go1Core, trunk_velocity: TrunkVelocity, seed: int) -> RunningAgent:
        """Take the robots of an environment."""
        return Driven(core, self.make, noise=core.noise, seed=seed, trunk_velocity=trunk_velocity)


Progress = Callable[[int, int], None]  # called with what is done and all that there is to do
