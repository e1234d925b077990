"""Controllers of the robots of an environment, each by its robot's sensors."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.rotation import rotate_inverse
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.estimation import Filters
from go1exp.deploy.sim_robot.machine import noisy
from go1exp.evaluate.controller.types import Controller, Sensed, TrunkVelocity
from go1exp.logs.record.simulate import sample
from go1exp.robot.messages import LowCmd
from go1exp.sim.env.core import Go1Core

VELOCITY_NOISE = 0.02  # half-width of the noise of the paper's Table II on the trunk's exact velocity, m/s


class Driven:
    """N controllers in place of a policy: built once, they act in every ``core.step``.

    Once every controller period, each robot's sensors are read, its controller is called, and its command is applied:
    targets, feed-forward torques and gains. An actuator without gains gets targets and torques alone.

    It is called like a policy, between steps: then it resets the controllers of robots whose episode begins. The
    actions that it returns are not used. Further restarts are up to the caller: ``restart``.
    """

    def __init__(
        self,
        core: Go1Core,
        make: Callable[[], Controller],
        *,
        noise: bool,
        seed: int,
        trunk_velocity: TrunkVelocity = "exact",
    ) -> None:
        """Control the robots of ``core``, built with ``imu=True``, by their commands (``core.command.value``).

        ``make`` makes one robot's controller. ``noise`` adds the sensor noise of the paper's Table II, and a logger's
        to the feet, drawn by ``seed``. Raise ConfigError if the controller's period is no multiple of the physics step,
        and EstimatorError if ``trunk_velocity`` is to be estimated and the filter is not built.
        """
        self._core, self._plant, n = core, core.plant, core.num_envs
        self.controllers: list[Controller] = [make() for _ in range(n)]
        self._dt = core.task.sim.physics_dt
        self._every = _whole(self.controllers[0].period, self._dt)
        self._noise, self._rng = float(noise), np.random.default_rng([seed, 3])
        self._estimates = trunk_velocity == "estimated"
        self._filters = Filters(n if self._estimates else 0)
        self._has_gains = hasattr(self._plant.actuator, "kp")
        self._target, self._forward = (torch.zeros_like(self._plant.q) for _ in range(2))
        self._kp, self._kd = (torch.zeros_like(self._plant.q) for _ in range(2))
        self._steps, self._feeds = 0, False
        core.driver = self._step

    def __call__(self, observation: Tensor) -> Tensor:
        """Reset the controllers of robots whose episode begins; return zeros (N, 12), which are not used."""
        self.restart(self._core.steps == 0)
        return torch.zeros(len(observation), robot.NUM_JOINTS)

    def restart(self, mask: Tensor) -> None:
        """Reset the controllers of the robots of ``mask`` (N,) bool."""
        for i in np.flatnonzero(mask.numpy()):
            self.controllers[i].reset()
            if self._estimates:
                self._filters.restart(int(i))

    def save(self) -> Any | None:
        """Return a copy of the state; None if a controller or the filter cannot be restored."""
        each = [one.save() for one in self.controllers if hasattr(one, "save")]
        if self._estimates or len(each) < len(self.controllers):
            return None
        tensors = [tensor.clone() for tensor in self._tensors()]
        return each, tensors, self._steps, self._feeds, copy.deepcopy(self._rng)

    def load(self, state: Any) -> None:
        """Restore what ``save`` returned, after the environment was restored."""
        each, tensors, self._steps, self._feeds, rng = state
        self._rng = copy.deepcopy(rng)
        for one, of_controller in zip(self.controllers, each, strict=True):
            assert hasattr(one, "load")
            one.load(of_controller)
        for tensor, value in zip(self._tensors(), tensors, strict=True):
            tensor.copy_(value)
        if self._has_gains:
            self._plant.set_gains(self._kp, self._kd)

    def _tensors(self) -> tuple[Tensor, ...]:
        """Present commands, and the last readings, which the engine writes in its next step only."""
        return self._target, self._forward, self._kp, self._kd, self._core.backend.sensordata

    def _step(self) -> None:
        sensed = self._sense()
        if self._steps % self._every == 0:
            commands = self._core.command.value.double().tolist()
            each = zip(self.controllers, commands, sensed, strict=True)
            self._apply([one.step((x, y, yaw), of_robot) for one, (x, y, yaw), of_robot in each])
        self._steps += 1
        self._plant.step(self._target, self._forward if self._feeds else None)
        self._core.target.copy_(self._target)

    def _apply(self, commands: Sequence[LowCmd]) -> None:
        rows = [(self._target, [one.joint_target for one in commands])]
        self._feeds = commands[0].feedforward is not None  # all are of one kind
        if self._feeds:
            rows.append((self._forward, [one.feedforward for one in commands]))  # type: ignore[misc]
        if self._has_gains:
            rows += [(self._kp, [one.kp for one in commands]), (self._kd, [one.kd for one in commands])]
        for tensor, values in rows:
            tensor.copy_(torch.as_tensor(np.stack(values)))
        if self._has_gains:
            self._plant.set_gains(self._kp, self._kd)

    def _sense(self) -> list[Sensed]:
        true = {name: values.cpu().double().numpy() for name, values in sample(self._plant, self._target).items()}
        readings = noisy(true, self._noise, self._rng)
        if self._estimates:
            self._filters.update(self._steps * self._dt, readings)
            velocities = self._filters.velocities
        else:
            quat, speed = (torch.as_tensor(true[name]) for name in ("base_quat", "base_lin_vel"))
            even = self._rng.uniform(-1.0, 1.0, speed.shape) * self._noise * VELOCITY_NOISE
            velocities = rotate_inverse(quat, speed).numpy() + even
        names = ("q", "qd", "quat", "gyro")
        rows = zip(*(readings[name] for name in names), velocities, readings["foot_force"], strict=True)
        return [Sensed(*row) for row in rows]


def _whole(period: float, dt: float) -> int:
    """Return the number of physics steps of ``dt`` s in a period."""
    ratio = period / dt
    if ratio < 1.0 - 1e-9 or not math.isclose(ratio, round(ratio), rel_tol=1e-6):
        raise ConfigError([f"controller.period = {period:g}: must be a multiple of the physics step, {dt:g} s"])
    return round(ratio)
