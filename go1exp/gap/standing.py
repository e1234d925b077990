"""A Go1 on its feet: its base in the windows' first states, and its IMU beside the encoders.

Legs feel each other through the trunk, so all joints are one group. The base's first attitude and rate come from the
IMU, its height and velocity from the legs that carry weight, and what these leave open is averaged out with the rest of
the first state. Where no two feet carry weight, nothing says how fast the trunk moves: no window begins there.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from go1exp import robot
from go1exp.drive import DriveSetup
from go1exp.effects.base import Measured
from go1exp.env.plant import Plant, drive_setup
from go1exp.gap.base_state import AGREE, SLIDE, TORN, Base, Log, base_state, loaded
from go1exp.gap.machine import HungGo1, Machine
from go1exp.gap.replay import Replayer, Rows
from go1exp.gap.result import GapSettings
from go1exp.gap.windows import Windows, cut, noise_of
from go1exp.physics.legs import Legs
from go1exp.physics.mujoco_cpu import MujocoCpu
from go1exp.physics.scene import build_model
from go1exp.recording import VECTORS, Recording
from go1exp.robot import RobotConfig
from go1exp.tensors.randomness import EnvRandom
from go1exp.tensors.rotation import quat_from_rotvec, quat_multiply, rotate_inverse
from go1exp.terrain import TerrainConfig, build_terrain

NO_SENSORS = 1 << 13
"""MuJoCo's mjDSBL_SENSOR: the IMU's readings follow from the motion of the base, and those of contacts cost time."""

GRAVITY = 9.81
"""m/s2, MuJoCo's own default, which the scene leaves as it is."""

WINDOW_S, BURN_S, STRIDE_S = 0.2, 0.03, 0.3
"""Longest windows, what is replayed before them, and from one to the next, s (chosen: what is not known of the first
state grows so fast over impacts that longer ones tell less)."""

MOST_WINDOWS = 96
"""Windows beyond which more would only cost time."""

BASE_SD = (0.0015, 0.003, 0.003, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02)
"""Standard deviations of the base's first state: height m, roll and pitch rad, velocity m/s, rate rad/s (chosen: some
times what the estimate misses by on simulated squats); that of velocity grows with the disagreement of the feet."""

BASE_PROBE = (5.0e-4, 1.0e-3, 1.0e-3, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01)
"""Changes by which their influence is measured."""

IMU_DELAY_SD = 0.001
"""s (chosen): an IMU's own filter is late by about its period; the simulated logger's by 0.5 to 0.75 ms."""

IMU_BIAS_SD = (0.02, 0.2)
"""Constant errors of gyro, rad/s, and accelerometer, m/s2 (chosen: those of a consumer's IMU after a warm-up)."""

IMU = "imu"
"""Name of the third quantity: gyro x y z, accelerometer x y z, and nothing in the other places of a row."""

TRUNK = "trunk"
"""Name of the quantity of a ``Witness``: attitude w-x-y-z, and velocity in the world."""

AXES = ("imu_gyro_x", "imu_gyro_y", "imu_gyro_z", "imu_acc_x", "imu_acc_y", "imu_acc_z")


@dataclass(frozen=True)
class StandingGo1:
    """A Go1 that stands or moves on flat ground, its trunk free."""

    config: RobotConfig
    joints: tuple[str, ...] = robot.JOINTS
    groups: tuple[tuple[int, ...], ...] = (tuple(range(robot.NUM_JOINTS)),)
    base_probe: tuple[float, ...] = BASE_PROBE

    def build(self, num: int, physics_dt: float, base_quat: Sequence[float], threads: int) -> tuple[Any, DriveSetup]:
        """Return a backend with ``num`` free robots, and their drives; ``base_quat`` says nothing here."""
        model, blocks = build_model(self.config, build_terrain(TerrainConfig(kind="flat")), physics_dt)
        model.opt.disableflags |= NO_SENSORS
        backend = MujocoCpu(model, blocks, num, threads)
        return backend, drive_setup(self.config, physics_dt, backend, EnvRandom(0, num, device=backend.qpos.device))


@dataclass(frozen=True)
class StandingWindows(Windows):
    """Windows of a robot on its feet.

    Attributes:
        base: (W, 13) first state: position m, attitude w-x-y-z, velocity in the world m/s, rate in the trunk rad/s.
        sd_of_base: (W, 9) its standard deviations: height, roll and pitch, velocity, rate.
        contact: (W, n, 4) bool, which feet carry weight.
        held: (W,) bool, windows of a robot whose trunk is held; their bases mean nothing.
        imu_site: (3,) where the IMU sits in the trunk, m.
    """

    base: np.ndarray
    sd_of_base: np.ndarray
    contact: np.ndarray
    held: np.ndarray
    imu_site: np.ndarray

    @property
    def of_joints(self) -> int:
        """Angles and speeds are the joints'; the third quantity is the trunk's."""
        return 2

    def loads(self) -> np.ndarray:
        """Return which joints' legs carry weight (W, n, J) bool."""
        return np.repeat(self.contact, len(self.joints) // self.contact.shape[2], axis=2)

    @property
    def base_sd(self) -> np.ndarray:
        """(W, 9) standard deviations of the base's first state."""
        return self.sd_of_base

    def moved(self, x: np.ndarray) -> StandingWindows:
        """Return windows whose first states are moved by ``x`` (W, 2 J + 9) standard deviations."""
        joints = len(self.joints)
        q, qd, off = x[:, :joints], x[:, joints : 2 * joints], x[:, 2 * joints :] * self.base_sd
        base = torch.as_tensor(self.base)
        found = base_moved(base, torch.as_tensor(off)).numpy()
        return dataclasses.replace(self, q=self.q + q * self.q_sd, qd=self.qd + qd * self.qd_sd, base=found)

    @property
    def channels(self) -> tuple[tuple[str, int, int], ...]:
        """Name, quantity and place of every reading."""
        joints = [(f"{q}_{j}", c, i) for c, q in enumerate(("q", "qd")) for i, j in enumerate(self.joints)]
        return (*joints, *((name, 2, i) for i, name in enumerate(AXES)))

    def by_quantity(self, values: np.ndarray) -> dict[str, float]:
        """Return the median of values (W, C, J) by quantity."""
        parts = {"q": values[:, 0], "qd": values[:, 1], "imu_gyro": values[:, 2, :3], "imu_acc": values[:, 2, 3:6]}
        return {name: float(np.median(part[np.isfinite(part)])) for name, part in parts.items()}

    def plain(self) -> Windows:
        """Return the same windows without what concerns the base."""
        kept = {f.name: getattr(self, f.name) for f in dataclasses.fields(Windows)}
        return Windows(**kept | {"quantities": self.quantities[:2]})

    def unknown(self, y: np.ndarray) -> list[np.ndarray]:
        """Return changes of the readings ``y`` (W, n, C, J) per standard deviation of what the IMU may be off by."""
        late = np.zeros_like(y)
        late[:, :, 2] = IMU_DELAY_SD * np.gradient(y[:, :, 2], self.period, axis=1)
        found = [late]
        for axis in range(6):
            bias = np.zeros_like(y)
            bias[:, :, 2, axis] = IMU_BIAS_SD[axis // 3]
            found.append(bias)
        return found


def base_moved(base: Tensor, off: Tensor) -> Tensor:
    """Return bases (R, 13) moved by ``off`` (R, 9): height, roll and pitch in the trunk, velocity, rate."""
    place, attitude, speed, rate = base.split([3, 4, 3, 3], dim=1)
    height, turn, faster, quicker = off.split([1, 2, 3, 3], dim=1)
    turn = torch.cat([turn, torch.zeros_like(height)], dim=1)
    place = torch.cat([place[:, :2], place[:, 2:] + height], dim=1)
    return torch.cat([place, quat_multiply(attitude, quat_from_rotvec(turn)), speed + faster, rate + quicker], dim=1)


def cut_standing(recordings: Sequence[Recording], settings: GapSettings, config: RobotConfig) -> StandingWindows:
    """Cut recordings of a Go1 into windows; on its feet they begin where at least two of them carry weight.

    Recordings of a held trunk may be among them. Their IMU is not compared: it says nothing that is not known.
    """
    legs = Legs(config)
    logs = {k: Log.of(r) for k, r in enumerate(recordings) if r.meta.base == "floating"}
    known: dict[tuple[int, float], Base] = {}

    def doubt(number: int, at: float) -> float:
        if number not in logs:
            return 0.0
        found = known[number, at] = base_state(legs, logs[number], at)
        return found.slide / SLIDE if found.spread < AGREE and found.slide < TORN else np.inf

    plain = cut(recordings, dataclasses.replace(settings, torque=False), doubt)
    count, width = len(plain), len(plain.joints)
    imu, scale = np.zeros((*plain.t.shape, 1, width)), np.full((count, 1, width), np.inf)
    base, base_sd = np.tile(np.eye(13)[3], (count, 1)), np.tile(BASE_SD, (count, 1))
    contact = np.zeros((*plain.t.shape, robot.NUM_LEGS), dtype=bool)
    sd = np.concatenate([noise_of([log.imu[:, k : k + 3] for log in logs.values()]) for k in (0, 3)])
    bearing = {number: loaded(legs, log) for number, log in logs.items()}
    for k, (number, begin) in enumerate(zip(plain.episode.tolist(), plain.begin.tolist(), strict=True)):
        if number in logs:
            rows = rows_at(logs[number].t, begin + plain.t[k])
            imu[k, :, 0, :6], scale[k, 0, :6] = logs[number].imu[rows], sd
            contact[k] = bearing[number][rows]
            found = known[number, begin]
            base[k], base_sd[k, 3:6] = found.state, np.hypot(base_sd[k, 3:6], 0.5 * found.slide)
    kept = {f.name: getattr(plain, f.name) for f in dataclasses.fields(plain)}
    kept |= {"quantities": (*plain.quantities, IMU), "y": np.concatenate([plain.y, imu], axis=2)}
    kept["scale"] = np.concatenate([plain.scale, scale], axis=1)
    held = np.array([number not in logs for number in plain.episode])
    return StandingWindows(**kept, base=base, sd_of_base=base_sd, contact=contact, held=held, imu_site=legs.imu_site)


def rows_at(t: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Return the rows of a clock ``t`` (T,) at times (n,) that are its own."""
    return np.searchsorted(t, when - 1e-7).clip(0, len(t) - 1)


def on_feet(machine: Machine, recordings: Sequence[Recording]) -> Machine:
    """Return the Go1 on its feet in the place of the hung one if it is in one of the recordings."""
    standing = any(r.meta.base == "floating" for r in recordings)
    return StandingGo1(machine.config) if standing and isinstance(machine, HungGo1) else machine


def missing(recording: Recording) -> list[str]:
    """Return the quantities of the IMU that a recording of a robot on its feet has not."""
    wanted = ("imu_gyro", "imu_acc", "imu_quat") if recording.meta.base == "floating" else ()
    return [name for name in wanted if not all(column in recording.channels for column in VECTORS[name])]


def for_feet(settings: GapSettings, recordings: Sequence[Recording]) -> GapSettings:
    """Return settings with windows that suit contact: shorter where longer are asked for, and not too many."""
    total = sum(float(r.t[-1] - r.t[0]) for r in recordings)
    return dataclasses.replace(
        settings,
        window_s=min(settings.window_s, WINDOW_S),
        burn_s=min(settings.burn_s, BURN_S),
        stride_s=max(min(settings.stride_s, STRIDE_S), total / MOST_WINDOWS),
        torque=False,
    )


class Ears:
    """Keeps the motion of the bases of a batch, and returns what their IMUs would say."""

    def __init__(self, steps: int, rows: int, site: np.ndarray) -> None:
        """Make room for ``steps`` steps of ``rows`` robots; the IMUs sit at ``site`` (3,) in the trunk, m."""
        self._quat, self._speed = torch.empty(steps, rows, 4).double(), torch.empty(steps, rows, 6).double()
        self._site = torch.as_tensor(site)

    def take(self, k: int, plant: Plant) -> None:
        """Note step ``k`` before it is made."""
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
        seen = plant.effects.measure(Measured(plant.q, plant.speed(), gyro=rate, acc=force))
        assert seen.gyro is not None
        assert seen.acc is not None
        return torch.cat([seen.gyro, seen.acc], dim=-1)

    def joined(self, joints: np.ndarray, at: np.ndarray, plant: Plant, dt: float) -> np.ndarray:
        """Put the IMU's readings at times ``at`` (R, n), in steps, beside those of the joints (R, n, 2, J)."""
        imu = self.readings(plant, dt).numpy()
        return beside(joints, imu, at)


class Eyes(Ears):
    """Returns also where the bases look and how fast they move."""

    def joined(self, joints: np.ndarray, at: np.ndarray, plant: Plant, dt: float) -> np.ndarray:
        """Put attitude w-x-y-z and velocity in the world beside the rest."""
        speed = self._speed[..., :3]
        after = torch.cat([speed[1:], 2.0 * speed[-1:] - speed[-2:-1]])
        trunk = torch.cat([self._quat, 0.5 * (speed + after)], dim=-1).numpy()
        return beside(super().joined(joints, at, plant, dt), trunk, at)


def beside(joints: np.ndarray, more: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Put values (K, R, c) of every step, at times ``at`` (R, n) in steps, beside quantities (R, n, C, J)."""
    low = np.clip(np.floor(at + 1e-6).astype(int), 0, len(more) - 2)
    share = np.maximum(at - low, 0.0)[..., None]
    row = np.arange(at.shape[0])[:, None]
    both = np.zeros((*joints.shape[:2], 1, joints.shape[3]))
    both[:, :, 0, : more.shape[2]] = (1.0 - share) * more[low, row] + share * more[low + 1, row]
    return np.concatenate([joints, both], axis=2)


@dataclass
class StandingReplayer(Replayer):
    """Replays windows of a robot on its feet, and those of the same robot hung.

    Attributes:
        hung: replays the latter; made where it is needed.
    """

    hung: Replayer | None = None

    def run(self, rows: Rows, dt: float) -> np.ndarray:
        """Return what sensors would say (R, n, 3, J) at the windows' sample times; nothing where they are not read."""
        held = self._windows.held[rows.window]
        if not held.any():
            return super().run(rows, dt)
        assert isinstance(self.machine, StandingGo1)
        if self.hung is None:
            machine = HungGo1(self.machine.config, groups=self.machine.groups)
            self.hung = Replayer(machine, self.windows, self.quats, self.max_rows, self.threads)
        self.hung.windows = self._windows.plain()
        found = np.zeros((len(held), self.windows.t.shape[1], len(self.windows.quantities), len(self.windows.joints)))
        found[held, :, :2] = self.hung.run(rows.part(np.flatnonzero(held)), dt)
        if not held.all():
            found[~held] = super().run(rows.part(np.flatnonzero(~held)), dt)
        return found

    @property
    def _windows(self) -> StandingWindows:
        assert isinstance(self.windows, StandingWindows)
        return self.windows

    def _state(self, plant: Plant, rows: Rows, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
        """Put a base (its IMU as tilted as it is believed to be) before the joints: qpos (R, 19), qvel (R, 18)."""
        base = torch.as_tensor(self._windows.base[rows.window])
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

    def _ears(self, steps: int, rows: int) -> Ears:
        return Ears(steps, rows, self._windows.imu_site)


class Witness(StandingReplayer):
    """Replays windows of a robot on its feet, and tells torques and the trunk's motion beside what is scored."""

    def _ears(self, steps: int, rows: int) -> Eyes:
        return Eyes(steps, rows, self._windows.imu_site)
