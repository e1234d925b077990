"""The trunk's velocity as the robot would estimate it, whether its controller reads it or not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from go1exp.deploy.estimation import Filters
from go1exp.deploy.sim_robot.machine import noisy
from go1exp.logs.record.tape import sample
from go1exp.sim.env.core import Go1Core


class Estimate:
    """The Kalman filter on the sensors of one robot, beside whatever else observes its plant."""

    def __init__(self, core: Go1Core, seed: int) -> None:
        """Observe the plant of ``core``, which must have been built with ``imu=True``, from its next step on.

        Raises:
            go1exp.deploy.estimation.EstimatorError: if the filter is not built.
        """
        self._filters = Filters(1)
        self._plant, self._dt, self._steps = core.plant, core.task.sim.physics_dt, 0
        self._noise, self._rng = float(core.noise), np.random.default_rng([seed, 2])
        self._before, core.plant.observer = core.plant.observer, self._listen

    def velocity(self) -> NDArray[np.float64]:
        """Return the velocity (3,) of the trunk in its own frame, m/s; zero until the filter runs."""
        return np.asarray(self._filters.velocities[0], dtype=np.float64)

    def restart(self) -> None:
        """Begin anew: the robot was put elsewhere."""
        self._filters.restart(0)

    def _listen(self, target: Tensor) -> None:
        if self._before is not None:
            self._before(target)
        true = {name: values.numpy() for name, values in sample(self._plant, target).items()}
        self._filters.update(self._steps * self._dt, noisy(true, self._noise, self._rng))
        self._steps += 1
