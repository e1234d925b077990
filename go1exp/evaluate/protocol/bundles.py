"""The policy of a bundle as what drives the robots of a protocol."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from go1exp.deploy.export.trace import readings
from go1exp.deploy.runtime.bundle import Bundle
from go1exp.deploy.runtime.past import PolicyMemory
from go1exp.deploy.sim_robot.machine import noisy
from go1exp.evaluate.drivers import Pilot
from go1exp.evaluate.estimated import EstimatedVelocity
from go1exp.evaluate.observed import TrunkVelocity
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig


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
        self._memory = PolicyMemory(driver.bundle.metadata, core.task.sim.policy_dt, core.num_envs)
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

    def save(self) -> Any | None:
        return None if self._filter else copy.deepcopy((self._memory, self._rng))

    def load(self, state: Any) -> None:
        self._memory, self._rng = copy.deepcopy(state)
