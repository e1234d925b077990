"""The truth about N robots at the logger's rate, taken from a plant while something drives it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from go1exp import robot
from go1exp.effects.base import Measured
from go1exp.env.plant import Plant


class Tape:
    """Listens to a plant, and keeps every so-manieth of its steps.

    Samples are what the sensors would say without their noise: effects that change readings are in them.
    """

    def __init__(self, plant: Plant, every: int, rows: int) -> None:
        """Start listening: keep ``rows`` samples, one each ``every`` steps, from the next step on."""
        self._plant, self._every, self._rows, self._step = plant, every, rows, 0
        self._kept: dict[str, np.ndarray] = {}
        self.enabled = torch.ones(len(plant.q), dtype=torch.bool)
        plant.observer = self._listen

    @property
    def full(self) -> bool:
        """Whether all rows are there."""
        return self._step >= self._every * self._rows

    def stop(self) -> None:
        """Stop listening."""
        self._plant.observer = None

    def true(self, env: int) -> dict[str, np.ndarray]:
        """Return the samples of one environment by name, ``(rows, ...)``."""
        return {name: values[:, env] for name, values in self._kept.items()}

    def _listen(self, target: Tensor) -> None:
        """Take a sample before a step, with the target that takes force now."""
        if self._step % self._every == 0 and not self.full:
            row = self._step // self._every
            for name, value in (sample(self._plant, target) | {"torque_enable": self.enabled}).items():
                now = value.cpu().numpy()
                if name not in self._kept:
                    self._kept[name] = np.zeros((self._rows, *now.shape), now.dtype)
                self._kept[name][row] = now
        self._step += 1


def sample(plant: Plant, target: Tensor) -> dict[str, Tensor]:
    """Return what the sensors of N robots would say at this moment without their noise, and the truth; (N, ...) each.

    ``target`` (N, J) is the one that takes force now. A free trunk's pose and velocity are ``base_...``.
    """
    blocks, readings = plant.backend.sensors, plant.backend.sensordata
    quat = readings[:, blocks.imu_quat]
    measured = plant.effects.measure(
        Measured(plant.q, plant.speed(), gyro=readings[:, blocks.imu_gyro], acc=readings[:, blocks.imu_acc], quat=quat)
    )
    assert measured.gyro is not None
    assert measured.acc is not None
    assert measured.quat is not None
    contact = readings[:, blocks.foot_contact].unflatten(1, (robot.NUM_LEGS, 4))
    values = {
        "q": measured.joint_pos,
        "qd": measured.joint_vel,
        "q_target": target,
        "tau_est": plant.torque,
        "gyro": measured.gyro,
        "acc": measured.acc,
        "quat": measured.quat,
        "foot_force": contact[..., 1:].norm(dim=-1),
    }
    qpos, qvel = plant.backend.qpos, plant.backend.qvel
    if qpos.shape[1] > robot.NUM_JOINTS:
        values |= {
            "base_pos": qpos[:, :3],
            "base_quat": qpos[:, 3:7],
            "base_lin_vel": qvel[:, :3],
            "base_ang_vel": qvel[:, 3:6],
        }
    return values
