"""Samples of N simulated robots at the logger's rate, taken from the plant while it is stepped."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from go1exp import robot
from go1exp.sim.effects.base import Measured
from go1exp.sim.env.plant import Plant


class Tape:
    """Observes a plant and keeps one of every ``every`` steps.

    Samples are the readings of the sensors without noise; effects that change readings are included.
    """

    def __init__(self, plant: Plant, every: int, rows: int) -> None:
        """Start to observe: keep ``rows`` samples, one for each ``every`` steps, from the next step on."""
        self._plant, self._every, self._rows, self._step = plant, every, rows, 0
        self._kept: dict[str, np.ndarray] = {}
        self.enabled = torch.ones(len(plant.q), dtype=torch.bool)
        plant.observer = self._listen

    @property
    def full(self) -> bool:
        """Whether all rows have been taken."""
        return self._step >= self._every * self._rows

    def stop(self) -> None:
        """Stop observing."""
        self._plant.observer = None

    def true(self, env: int) -> dict[str, np.ndarray]:
        """Return the samples of one environment by name, ``(rows, ...)``."""
        return {name: values[:, env] for name, values in self._kept.items()}

    def _listen(self, target: Tensor) -> None:
        """Take a sample before a step; ``target`` is in force from this step on."""
        if self._step % self._every == 0 and not self.full:
            row = self._step // self._every
            for name, value in (sample(self._plant, target) | {"torque_enable": self.enabled}).items():
                now = value.cpu().numpy()
                if name not in self._kept:
                    self._kept[name] = np.zeros((self._rows, *now.shape), now.dtype)
                self._kept[name][row] = now
        self._step += 1


def sample(plant: Plant, target: Tensor) -> dict[str, Tensor]:
    """Return the present readings of N robots' sensors without noise, and the truth; (N, ...) each.

    ``target`` (N, J) is in force from now on. Pose and velocity of a free trunk are ``base_...``.
    """
    blocks, readings = plant.backend.sensors, plant.backend.sensordata
    quat = readings[:, blocks.imu_quat]
    measured = plant.effects.measure(
        Measured(plant.q, plant.speed(), gyro=readings[:, blocks.imu_gyro], acc=readings[:, blocks.imu_acc], quat=quat)
    )
    assert measured.gyro is not None
    assert measured.acc is not None
    assert measured.quat is not None
    # Of the four values of a contact sensor the first is the number of contacts, the others are the force.
    contact = readings[:, blocks.foot_contact].unflatten(1, (robot.NUM_LEGS, 4))
    values = {
        "q": measured.joint_pos,
        "qd": measured.joint_vel,
        "q_target": target,
        "tau_est": plant.reported_torque(),
        "gyro": measured.gyro,
        "acc": measured.acc,
        "quat": measured.quat,
        "foot_force": contact[..., 1:].norm(dim=-1),
    }
    qpos, qvel = plant.backend.qpos, plant.backend.qvel
    if qpos.shape[1] != qvel.shape[1]:  # a free trunk, which has a quaternion
        values |= {
            "base_pos": qpos[:, :3],
            "base_quat": qpos[:, 3:7],
            "base_lin_vel": qvel[:, :3],
            "base_ang_vel": qvel[:, 3:6],
        }
    return values
