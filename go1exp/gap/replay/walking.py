"""Replays of a robot that walks or stands: the whole robot with its trunk, or legs in their swing phases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, cast

import numpy as np
import torch
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.rotation import quat_multiply, rotate, rotate_inverse
from go1exp.gap.data.standing import StandingWindows, base_moved
from go1exp.gap.data.swings import SwingWindows
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import Key, Machine, Rows
from go1exp.robot import GRAVITY
from go1exp.sim.effects.base import Measured
from go1exp.sim.env.plant import Plant


class ImuRecorder:
    """Keeps the trunks' motion; returns what their IMUs would measure, with ``trunk`` also attitudes and velocities."""

    def __init__(self, steps: int, rows: int, site: np.ndarray, trunk: bool) -> None:
        """Make room for ``steps`` steps of ``rows`` robots; the IMUs sit at ``site`` (3,) in the trunk, m."""
        self._quat, self._speed = torch.empty(steps, rows, 4).double(), torch.empty(steps, rows, 6).double()
        self._site, self._trunk = torch.as_tensor(site), trunk

    def record(self, k: int, plant: Plant) -> None:
        """Keep the state before step ``k``."""
        self._quat[k], self._speed[k] = plant.backend.qpos[:, 3:7], plant.backend.qvel[:, :6]

    def readings(self, plant: Plant, dt: float) -> Tensor:
        """Return gyro and accelerometer (K, R, 6) at the instants of the angles: speeds lie half a step off those."""
        after = self._next_speed()
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
        y = beside(joints, self.readings(plant, dt).numpy(), at)
        if not self._trunk:
            return y
        velocity = 0.5 * (self._speed + self._next_speed())[..., :3]  # in the world
        return beside(y, torch.cat([self._quat, velocity], dim=-1).numpy(), at)

    def _next_speed(self) -> Tensor:
        """Return the speeds (K, R, 6) a step later; the last one by a line through the two before."""
        return torch.cat([self._speed[1:], 2.0 * self._speed[-1:] - self._speed[-2:-1]])


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
    """Replays windows of a standing robot; those of the same robot ``held`` are replayed by ``suspended``."""

    windows: StandingWindows
    held: Machine = field(kw_only=True)
    suspended: Replayer | None = None
    tells_trunk: ClassVar[bool] = False  # whether the trunk's motion is returned beside what is scored

    def run(self, rows: Rows, dt: float) -> np.ndarray:
        """Return what sensors would measure (R, n, 3, J) at the windows' sample times; 0 where nothing is compared."""
        held = self.windows.held[rows.window]
        if not held.any():
            return super().run(rows, dt)
        if self.suspended is None:
            self.suspended = Replayer(self.held, self.windows, self.quats, self.max_rows, self.threads)
        self.suspended.windows = self.windows.plain()
        y = np.zeros((len(held), self.windows.t.shape[1], len(self.windows.quantities), len(self.windows.joints)))
        y[held, :, :2] = self.suspended.run(rows.part(np.flatnonzero(held)), dt)
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
        return ImuRecorder(steps, rows, self.windows.imu_site, self.tells_trunk)


class TrunkReplayer(StandingReplayer):
    """Replays windows of a standing robot, and returns torques and the trunk's motion beside what is scored."""

    tells_trunk = True


HEAVY = 1.0e6
"""Mass, kg, and moments of inertia, kg m2, of the trunk: legs of some kilograms move it by a hundred-thousandth of
what moves them."""


MOVED = ("q", "qd", "base")  # fields of rows that move an initial state, or what the IMU says


@dataclass
class SwingReplayer(Replayer):
    """Replays windows of legs in swing."""

    windows: SwingWindows

    def run(self, rows: Rows, dt: float) -> np.ndarray:
        """Return sensors' values (R, n, C, J) at sample times; rows that differ at different legs are run as one."""
        packed, slot = packed_by_leg(rows, len(self.windows.joints))
        y, joints = super().run(packed, dt), _of_legs(len(self.windows.joints))
        return np.concatenate([y[at][..., leg] for leg, at in zip(joints, slot, strict=True)], axis=-1)

    def _state(self, plant: Plant, rows: Rows, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Put a trunk that is level and does not turn before the joints: ``_begin`` sets its rate."""
        level = torch.zeros(len(q), 7, dtype=q.dtype)
        level[:, 3] = 1.0
        return torch.cat([level, q], dim=1), torch.cat([torch.zeros(len(q), 6, dtype=q.dtype), qd], dim=1)

    def _begin(self, plant: Plant, rows: Rows, past: Tensor, dt: float) -> None:
        """Put the robots into their windows' initial states; the trunk turns as the IMU says."""
        super()._begin(plant, rows, past, dt)
        start = torch.as_tensor(self._motion(plant, rows, dt, 1)[0])
        plant.backend.qvel[:, 3:6] = start[:, 6:] - 0.5 * dt * start[:, 3:6]  # the engine's speeds are half a step old

    def _carrier(self, plant: Plant, rows: Rows, dt: float, steps: int) -> Callable[[int], None]:
        """Return what pushes the trunks before each step so that they move as the IMU says."""
        motion = torch.as_tensor(self._motion(plant, rows, dt, steps))
        applied, qpos = plant.backend.applied(), plant.backend.qpos

        def push(k: int) -> None:
            applied[:, :3] = HEAVY * rotate(qpos[:, 3:7], motion[k, :, :3])
            applied[:, 3:6] = HEAVY * motion[k, :, 3:6]

        return push

    def _motion(self, plant: Plant, rows: Rows, dt: float, steps: int) -> np.ndarray:
        """Return force, angular acceleration and rate (K, R, 9) of the trunks at every step, as the rows' IMUs sit."""
        at, index = np.arange(steps) * dt, rows.window
        used, place = np.unique(index, return_inverse=True)
        values = np.stack([_between(at, *self.windows.carried[k]) for k in used], axis=1)[:, place]
        if rows.base is not None:
            off, late = rows.base[:, :6], rows.base[:, 6:]
            if late.any():
                values = np.stack([_between(at + late[r, 0], *self.windows.carried[k]) for r, k in enumerate(index)], 1)
            values = values.copy()
            values[..., :3] -= off[:, :3]
            values[..., 6:] -= off[:, 3:]
        return np.asarray(_turned_back(plant, values))


def _of_legs(joints: int) -> np.ndarray:
    """Return the numbers of the joints of each leg (4, 3)."""
    return np.arange(joints).reshape(robot.NUM_LEGS, -1)


def packed_by_leg(rows: Rows, joints: int) -> tuple[Rows, np.ndarray]:
    """Return fewer rows that hold all that each leg does in ``rows``, and in which of them (4, R) it does so."""
    count = len(rows.window)
    moved = {name: np.zeros((count, 0)) if v is None else v for name, v in vars(rows).items() if name in MOVED}
    wide: dict[Key | str, np.ndarray] = {name: v for name, v in moved.items() if name != "base"}
    wide |= {key: v for key, v in rows.values.items()}
    of_joints = {key: v for key, v in wide.items() if v.shape[1] == joints}
    shared = [rows.window[:, None], moved["base"], *(v for v in wide.values() if v.shape[1] != joints)]
    kind = _numbered(np.concatenate(shared, axis=1))
    slot = np.empty((robot.NUM_LEGS, count), dtype=int)
    for leg, columns in enumerate(_of_legs(joints)):
        what = _numbered(np.concatenate([kind[:, None], *(v[:, columns] for v in of_joints.values())], axis=1))
        first = np.unique(what, return_index=True)[1]
        place = np.arange(len(first)) - np.searchsorted(kind[first], kind[first])  # sorted by kind, then by the rest
        slot[leg] = kind * count + place[what]
    used, back = np.unique(slot, return_inverse=True)
    back = back.reshape(slot.shape)
    sample = np.empty(len(used), dtype=int)
    for leg in range(robot.NUM_LEGS):
        sample[back[leg]] = np.arange(count)
    packed = rows.part(sample)
    for leg, columns in enumerate(_of_legs(joints)):
        of_leg = np.full(len(used), -1)
        of_leg[back[leg]] = np.arange(count)
        known = of_leg >= 0
        for key in of_joints:
            values = packed.values[key] if isinstance(key, tuple) else getattr(packed, key)
            values[np.ix_(known, columns)] = of_joints[key][np.ix_(of_leg[known], columns)]
    return packed, back


def _numbered(values: np.ndarray) -> np.ndarray:
    """Return the number (R,) of each row of values (R, c) among those that differ, sorted."""
    return np.unique(values, axis=0, return_inverse=True)[1].ravel()


def _between(at: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (K, c) at times ``at`` (K,) by lines between those (n, c) at ``t`` (n,)."""
    return np.stack([np.interp(at, t, column) for column in values.T], axis=1)


def _turned_back(plant: Plant, motion: np.ndarray) -> np.ndarray:
    """Return motions (K, R, 9) by IMUs that may sit tilted in the axes of their trunks."""
    tilt = []
    for axis in np.eye(3):
        along = torch.as_tensor(np.tile(axis, (motion.shape[1], 1)))
        sensed = plant.effects.measure(Measured(plant.q, plant.speed(), acc=along)).acc
        assert sensed is not None
        tilt.append(sensed.numpy())
    turn = np.stack(tilt, axis=1)  # R, axis of the trunk, axis of the IMU
    parts = [np.einsum("kri,rji->krj", motion[..., a : a + 3], turn) for a in (0, 3, 6)]
    return np.concatenate(parts, axis=-1)
