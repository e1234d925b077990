"""Replay of a robot on its feet: its trunk in the windows' initial states, and its IMU beside the encoders.

The trunk's initial attitude and rate come from the IMU, its height and velocity from the legs that carry weight. What
these leave open is averaged out with the rest of the initial state (``score/initial_state.py``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import cast

import numpy as np
import torch
from torch import Tensor

from go1exp.base.tensors.rotation import quat_multiply, rotate_inverse
from go1exp.gap.data.standing import StandingWindows, base_moved
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.machine import Machine
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import Rows
from go1exp.robot import GRAVITY
from go1exp.sim.effects.base import Measured
from go1exp.sim.env.plant import Plant


class ImuRecorder:
    """Keeps the motion of the trunks of a batch, and returns what their IMUs would measure."""

    def __init__(self, steps: int, rows: int, site: np.ndarray) -> None:
        """Make room for ``steps`` steps of ``rows`` robots; the IMUs sit at ``site`` (3,) in the trunk, m."""
        self._quat, self._speed = torch.empty(steps, rows, 4).double(), torch.empty(steps, rows, 6).double()
        self._site = torch.as_tensor(site)

    def record(self, k: int, plant: Plant) -> None:
        """Keep the state before step ``k``."""
        self._quat[k], self._speed[k] = plant.backend.qpos[:, 3:7], plant.backend.qvel[:, :6]

    def readings(self, plant: Plant, dt: float) -> Tensor:
        """Return gyro and accelerometer (K, R, 6) at the instants of the angles: speeds lie half a step off those."""
        after = torch.cat([self._speed[1:], 2.0 * self._speed[-1:] - self._speed[-2:-1]])
        middle, change = 0.5 * (self._speed + after), (after - self._speed) / dt
        rate, turn = middle[..., 3:], change[..., 3:]
        up = torch.zeros_like(rate)
        up[..., 2] = GRAVITY
        site = self._site.expand_as(rate)
        force = rotate_inverse(self._quat.flatten(0, 1), (change[..., :3] + up).flatten(0, 1)).view_as(up)
        force = force + torch.linalg.cross(turn, site) + torch.linalg.cross(rate, torch.linalg.cross(rate, site))
        sensed = plant.effects.measure(Measured(plant.q, plant.speed(), gyro=rate, acc=force))
        assert sensed.gyro is not None
        assert sensed.acc is not None
        return torch.cat([sensed.gyro, sensed.acc], dim=-1)

    def joined(self, joints: np.ndarray, at: np.ndarray, plant: Plant, dt: float) -> np.ndarray:
        """Put the IMU's readings at times ``at`` (R, n), in steps, beside those of the joints (R, n, 2, J)."""
        imu = self.readings(plant, dt).numpy()
        return beside(joints, imu, at)


class TrunkRecorder(ImuRecorder):
    """Returns also the attitudes and velocities of the trunks."""

    def joined(self, joints: np.ndarray, at: np.ndarray, plant: Plant, dt: float) -> np.ndarray:
        """Put attitude w-x-y-z and velocity in the world beside the rest."""
        speed = self._speed[..., :3]
        after = torch.cat([speed[1:], 2.0 * speed[-1:] - speed[-2:-1]])
        trunk = torch.cat([self._quat, 0.5 * (speed + after)], dim=-1).numpy()
        return beside(super().joined(joints, at, plant, dt), trunk, at)


def beside(joints: np.ndarray, series: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Put values (K, R, c) of every step, at times ``at`` (R, n) in steps, beside quantities (R, n, C, J)."""
    low = np.clip(np.floor(at + 1e-6).astype(int), 0, len(series) - 2)
    share = np.maximum(at - low, 0.0)[..., None]
    row = np.arange(at.shape[0])[:, None]
    both = np.zeros((*joints.shape[:2], 1, joints.shape[3]))
    both[:, :, 0, : series.shape[2]] = (1.0 - share) * series[low, row] + share * series[low + 1, row]
    return np.concatenate([joints, both], axis=2)


@dataclass
class StandingReplayer(Replayer):
    """Replays windows of a robot on its feet, and those of the same robot hung.

    Attributes:
        held: the same robot with its trunk held.
        hung: replays its windows; made where there are some.
    """

    windows: StandingWindows
    held: Machine = field(kw_only=True)
    hung: Replayer | None = None

    def run(self, rows: Rows, dt: float) -> np.ndarray:
        """Return what sensors would measure (R, n, 3, J) at the windows' sample times; 0 where nothing is compared."""
        held = self.windows.held[rows.window]
        if not held.any():
            return super().run(rows, dt)
        if self.hung is None:
            self.hung = Replayer(self.held, self.windows, self.quats, self.max_rows, self.threads)
        self.hung.windows = self.windows.plain()
        y = np.zeros((len(held), self.windows.t.shape[1], len(self.windows.quantities), len(self.windows.joints)))
        y[held, :, :2] = self.hung.run(rows.part(np.flatnonzero(held)), dt)
        if not held.all():
            y[~held] = super().run(rows.part(np.flatnonzero(~held)), dt)
        return y

    def observing(self, windows: Windows) -> TrunkReplayer:
        """Return a replayer of the same windows that tells all that a simulation can tell."""
        standing = cast(StandingWindows, windows)  # of the same robot
        return TrunkReplayer(self.machine, standing, self.quats, self.max_rows, self.threads, held=self.held)

    def _state(self, plant: Plant, rows: Rows, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Put a base (its IMU as tilted as it is believed to be) before the joints: qpos (R, 19), qvel (R, 18)."""
        base = torch.as_tensor(self.windows.base[rows.window])
        if rows.base is not None:
            base = base_moved(base, torch.as_tensor(rows.base))
        place, attitude, speed, rate = base.split([3, 4, 3, 3], dim=1)
        level = torch.zeros_like(attitude)
        level[:, 0] = 1.0
        tilt = plant.effects.measure(Measured(q, qd, quat=level)).quat
        assert tilt is not None
        back = tilt * torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=tilt.dtype)
        attitude = quat_multiply(attitude, back)
        rate = rotate_inverse(back, rate)
        return torch.cat([place, attitude, q], dim=1), torch.cat([speed, rate, qd], dim=1)

    def _recorder(self, steps: int, rows: int) -> ImuRecorder:
        return ImuRecorder(steps, rows, self.windows.imu_site)


class TrunkReplayer(StandingReplayer):
    """Replays windows of a robot on its feet, and tells torques and the trunk's motion beside what is scored."""

    def _recorder(self, steps: int, rows: int) -> TrunkRecorder:
        return TrunkRecorder(steps, rows, self.windows.imu_site)
