"""Windows of a robot on the ground, with the state and the readings of its trunk."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.rotation import quat_from_rotvec, quat_multiply
from go1exp.gap.data.cutting import FIT_S, cut, even_clock, noise_of
from go1exp.gap.data.windows import Windows
from go1exp.gap.result import GapSettings
from go1exp.logs.recording import VECTORS, Recording
from go1exp.robot.config import RobotConfig
from go1exp.sim.physics.dynamics import Legs

LOADED = 10.0
"""Force from which a foot carries weight, N: a third of what each bears at rest, twice what is
estimated for a foot in the air."""

AGREE = 0.004  # feet that carry weight and disagree by more about the height of the base, m, are not all on the ground

TORN = 0.3
"""Disagreement about its velocity beyond which nothing is known of it, m/s: a foot is just touching down or leaving."""

SLIDE = 0.05
"""Feet that carry weight and disagree by this about the velocity of the base, m/s, put an estimate in doubt as a misfit
of one standard deviation does: one of them slides, or has just touched down."""

SINK = 3.0e-5  # how far a foot sinks into the ground, m/N (measured in the model at rest)


@dataclass(frozen=True)
class Log:
    """What an estimate of the base needs of a recording, its rows on an even clock."""

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    torque: np.ndarray
    imu: np.ndarray
    attitude: Rotation

    @staticmethod
    def from_recording(recording: Recording) -> Log:
        """Read it; the torque is what the drives should make of target, angle and speed."""
        q, qd = recording.joint("q"), recording.joint("qd")
        kp, kd = np.asarray(recording.meta.kp, dtype=float), np.asarray(recording.meta.kd, dtype=float)
        torque = kp * (recording.joint("q_target") - q) - kd * qd
        on = recording.channels.get("torque_enable", np.ones(len(q), dtype=bool)).astype(bool)
        imu = recording.block(*VECTORS["imu_gyro"], *VECTORS["imu_acc"])
        attitude = Rotation.from_quat(recording.block(*VECTORS["imu_quat"]), scalar_first=True)
        return Log(even_clock(recording), q, qd, torque * on[:, None], imu, attitude)


@dataclass(frozen=True)
class Base:
    """An estimate of the base."""

    state: np.ndarray  # (13,) as in ``StandingWindows``
    loaded: np.ndarray  # (4,) which feet carry weight
    spread: float  # how far those disagree about the base's height, m; infinite with fewer than two
    slide: float  # how far they disagree about its velocity, m/s


def loaded(legs: Legs, log: Log) -> np.ndarray:
    """Return which feet carry weight (T, 4) bool, at every row of a recording."""
    bearing = np.empty((len(log.t), robot.NUM_LEGS), dtype=bool)
    up = log.attitude.as_matrix()[:, 2]
    for k in range(len(log.t)):
        _, moves = legs.feet(log.q[k], up[k])
        bearing[k] = legs.forces(moves, log.torque[k]) @ up[k] > LOADED
    return bearing


def base_state(legs: Legs, log: Log, at: float) -> Base:
    """Estimate the base at a time of a recording, s.

    Attitude and rate are the IMU's, smoothed over 14 ms to each side. The force on a foot is what balances the torque
    of its leg. Feet that carry weight are on the ground, and stay where they touch it.
    """
    near = np.flatnonzero(np.abs(log.t - at) <= FIT_S)
    x = log.t[near] - at
    design = np.stack([np.ones_like(x), x], axis=1)

    def now(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.lstsq(design, values[near], rcond=None)[0][0])

    middle = log.attitude[int(near[len(near) // 2])]
    turns = (middle.inv() * log.attitude[near]).as_rotvec()
    attitude = middle * Rotation.from_rotvec(np.linalg.lstsq(design, turns, rcond=None)[0][0])
    rotation, rate = attitude.as_matrix(), now(log.imu[:, :3])
    q, qd, torque = now(log.q), now(log.qd), now(log.torque)
    points, moves = legs.feet(q, rotation[2])
    forces = legs.forces(moves, torque) @ rotation.T
    bearing = forces[:, 2] > LOADED
    heights = -(points @ rotation.T)[:, 2] - SINK * forces[:, 2]
    speeds = -(np.stack([moves[k] @ qd for k in range(4)]) + np.cross(rate, points)) @ rotation.T
    spread = float(np.ptp(heights[bearing])) if bearing.sum() > 1 else np.inf
    slide = float(np.ptp(speeds[bearing], axis=0).max()) if bearing.sum() > 1 else np.inf
    weight = np.maximum(forces[:, 2], 0.0) * bearing + 1e-9
    height, speed = np.average(heights, weights=weight), np.average(speeds, axis=0, weights=weight)
    state = np.concatenate([[0.0, 0.0, height], attitude.as_quat(scalar_first=True), speed, rate])
    return Base(state, bearing, spread, slide)


WINDOW_S, BURN_S, STRIDE_S = 0.2, 0.03, 0.3
"""Longest windows, what is replayed before them, and from one to the next, s (chosen: what is not known of the
initial state grows so fast over impacts that longer ones tell less)."""

MOST_WINDOWS = 96  # windows beyond which more would only cost time

BASE_SD = (0.0015, 0.003, 0.003, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02)
"""Standard deviations of the base's initial state: height m, roll and pitch rad, velocity m/s, rate rad/s (chosen: some
times what the estimate misses by on simulated squats); that of velocity grows with the disagreement of the feet."""

IMU_DELAY_SD = 0.001
"""s (chosen): an IMU's own filter is late by about its period; the simulated logger's by 0.5 to 0.75 ms."""

IMU_BIAS_SD = (0.02, 0.2)
"""Constant errors of gyro, rad/s, and accelerometer, m/s2 (chosen: those of a consumer's IMU after a warm-up)."""

IMU = "imu"  # name of the third quantity: gyro x y z, accelerometer x y z, and nothing in the other places of a row
TRUNK = "trunk"  # name of a fourth quantity, which is never compared: attitude w-x-y-z, and velocity in the world

AXES = ("imu_gyro_x", "imu_gyro_y", "imu_gyro_z", "imu_acc_x", "imu_acc_y", "imu_acc_z")


@dataclass(frozen=True)
class StandingWindows(Windows):
    """Windows of a standing robot."""

    # (W, 13) initial state: position m, attitude w-x-y-z, velocity in the world m/s, rate in the trunk rad/s
    base: np.ndarray
    sd_of_base: np.ndarray  # (W, 9) its standard deviations: height, roll and pitch, velocity, rate
    contact: np.ndarray  # (W, n, 4) bool, which feet carry weight
    held: np.ndarray  # (W,) bool, windows of a robot whose trunk is held; their bases mean nothing
    imu_site: np.ndarray  # (3,) where the IMU sits in the trunk, m

    @property
    def of_joints(self) -> int:
        """Angles and speeds are the joints'; the third quantity is the trunk's."""
        return 2

    def loads(self) -> np.ndarray:
        """Return which joints' legs carry weight (W, n, J) bool."""
        return np.repeat(self.contact, len(self.joints) // self.contact.shape[2], axis=2)

    @property
    def base_sd(self) -> np.ndarray:
        """(W, 9) standard deviations of the base's initial state."""
        return self.sd_of_base

    def moved(self, x: np.ndarray) -> StandingWindows:
        """Return windows whose initial states are moved by ``x`` (W, 2 J + 9) standard deviations."""
        joints = len(self.joints)
        q, qd, off = x[:, :joints], x[:, joints : 2 * joints], x[:, 2 * joints :] * self.base_sd
        base = torch.as_tensor(self.base)
        other = base_moved(base, torch.as_tensor(off)).numpy()
        return dataclasses.replace(self, q=self.q + q * self.q_sd, qd=self.qd + qd * self.qd_sd, base=other)

    @property
    def observable(self) -> tuple[str, ...]:
        """Quantities that a simulation can tell, whether they are compared or not."""
        return (*super().observable, IMU, TRUNK)

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
        changes = [late]
        for axis in range(6):
            bias = np.zeros_like(y)
            bias[:, :, 2, axis] = IMU_BIAS_SD[axis // 3]
            changes.append(bias)
        return changes


def base_moved(base: Tensor, off: Tensor) -> Tensor:
    """Return bases (R, 13) moved by ``off`` (R, 9): height, roll and pitch in the trunk, velocity, rate."""
    place, attitude, speed, rate = base.split([3, 4, 3, 3], dim=1)
    height, turn, faster, quicker = off.split([1, 2, 3, 3], dim=1)
    turn = torch.cat([turn, torch.zeros_like(height)], dim=1)
    place = torch.cat([place[:, :2], place[:, 2:] + height], dim=1)
    return torch.cat([place, quat_multiply(attitude, quat_from_rotvec(turn)), speed + faster, rate + quicker], dim=1)


def cut_standing(recordings: Sequence[Recording], settings: GapSettings, config: RobotConfig) -> StandingWindows:
    """Cut recordings of a Go1 into windows; those of a standing one begin where at least two feet carry weight.

    Recordings of a held trunk may be among them. Their IMU is not compared: it says nothing that is not known.
    """
    legs = Legs(config)
    logs = {k: Log.from_recording(r) for k, r in enumerate(recordings) if r.meta.base == "floating"}
    bases: dict[tuple[int, float], Base] = {}

    def doubt(number: int, at: float) -> float:
        if number not in logs:
            return 0.0
        base = bases[number, at] = base_state(legs, logs[number], at)
        return base.slide / SLIDE if base.spread < AGREE and base.slide < TORN else np.inf

    plain = cut(recordings, dataclasses.replace(settings, torque=False), doubt)
    return _with_trunk(plain, legs, logs, bases)


def _with_trunk(
    plain: Windows, legs: Legs, logs: Mapping[int, Log], bases: Mapping[tuple[int, float], Base]
) -> StandingWindows:
    """Add to windows what concerns the trunk: its initial state, its IMU, and which feet carry weight."""
    count, width = len(plain), len(plain.joints)
    imu, scale = np.zeros((*plain.t.shape, 1, width)), np.full((count, 1, width), np.inf)
    state, base_sd = np.tile(np.eye(13)[3], (count, 1)), np.tile(BASE_SD, (count, 1))
    contact = np.zeros((*plain.t.shape, robot.NUM_LEGS), dtype=bool)
    sd = np.concatenate([noise_of([log.imu[:, k : k + 3] for log in logs.values()]) for k in (0, 3)])
    bearing = {number: loaded(legs, log) for number, log in logs.items()}
    for k, (number, begin) in enumerate(zip(plain.episode.tolist(), plain.begin.tolist(), strict=True)):
        if number in logs:
            rows = rows_at(logs[number].t, begin + plain.t[k])
            imu[k, :, 0, :6], scale[k, 0, :6] = logs[number].imu[rows], sd
            contact[k] = bearing[number][rows]
            base = bases[number, begin]
            state[k], base_sd[k, 3:6] = base.state, np.hypot(base_sd[k, 3:6], 0.5 * base.slide)
    kept = vars(plain) | {"quantities": (*plain.quantities, IMU), "y": np.concatenate([plain.y, imu], axis=2)}
    kept["scale"] = np.concatenate([plain.scale, scale], axis=1)
    held = np.array([number not in logs for number in plain.episode])
    return StandingWindows(**kept, base=state, sd_of_base=base_sd, contact=contact, held=held, imu_site=legs.imu_site)


def rows_at(t: np.ndarray, when: np.ndarray) -> np.ndarray:
    """Return the rows of a clock ``t`` (T,) at times (n,) that are its own."""
    return np.searchsorted(t, when - 1e-7).clip(0, len(t) - 1)


def missing(recording: Recording) -> list[str]:
    """Return the quantities of the IMU that a recording of a standing robot has not."""
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
