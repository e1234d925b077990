"""The trunk's velocity as the robot knows it: estimated from its sensors by the Kalman filter."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.estimation import Filters
from go1exp.deploy.sim_robot.machine import noisy
from go1exp.evaluate.observed import columns
from go1exp.logs.record.tape import sample
from go1exp.sim.env.core import Go1Core

TERM = "base_linear_velocity"


class EstimatedVelocity:
    """One filter for each robot of an environment, updated with its sensors in every physics step."""

    def __init__(self, core: Go1Core, noise: bool, seed: int) -> None:
        """Observe the plant of ``core``, which must have been built with ``imu=True``, from its next step on.

        Args:
            core: the environment.
            noise: give the sensors the noise of the paper's Table II, and accelerometer and feet that of a logger.
            seed: seed of the noise.

        Raises:
            ConfigError: if the policy does not observe the velocity.
            go1exp.deploy.estimation.EstimatorError: if the filter is not built.
        """
        velocity_columns = columns(core.task, TERM)
        if velocity_columns is None:
            raise ConfigError([f"trunk_velocity = 'estimated': the policy does not see {TERM}"])
        self._columns = velocity_columns
        self._filters = Filters(core.num_envs)
        self._plant, self._dt, self._steps = core.plant, core.task.sim.physics_dt, 0
        self._noise, self._rng = float(noise), np.random.default_rng([seed, 2])
        core.plant.observer = self._listen

    def put(self, observation: Tensor) -> Tensor:
        """Return the observation (N, O) with the estimated velocity in place of the true one."""
        changed = observation.clone()
        changed[:, self._columns] = torch.as_tensor(self.velocities(), dtype=observation.dtype)
        return changed

    def velocities(self) -> NDArray[np.float64]:
        """Return the estimated velocities of the trunks in their own frames (N, 3), m/s; zero until a filter runs."""
        return self._filters.velocities

    def _listen(self, target: Tensor) -> None:
        """Update every filter with a sample, before a step."""
        true = {name: values.cpu().numpy() for name, values in sample(self._plant, target).items()}
        self._filters.update(self._steps * self._dt, noisy(true, self._noise, self._rng))
        self._steps += 1
