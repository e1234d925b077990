"""Grades of RoboGauge (Wu et al., arXiv 2602.00678): metrics of 0 to 1, their quality, the level, the score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike

from go1exp import robot
from go1exp.evaluate.protocol.plan import Array, Motion
from go1exp.evaluate.quantities import FINGERPRINT, Row
from go1exp.mdp.measures.trace import mean_over

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.mdp.types import Snapshot

SAMPLE = 0.1  # time between two samples of the metrics, s
POWER, TORQUE = 100.0, 30.0  # root mean squares over joints that score 0: of power, W, and of torque changes, N m
SOFT = 0.4  # share of the range of hips and thighs, about its middle, that costs nothing
LEAST = 1e-9  # of a metric in the geometric mean
PER_LEVEL, OF_QUALITY = 0.09, 0.19  # of the score

METRICS = {
    "lin_vel": (2.0, "1 - error of the trunk's velocity over the largest command"),
    "ang_vel": (2.0, "1 - error of its angular velocity over the largest yaw rate"),
    "dof_limits": (1.0, "1 - way of hips and thighs beyond the middle 40 % of their range, over that range"),
    "dof_power": (1.0, "1 - power of a joint over 100 W"),
    "orientation": (1.0, "1 - sine of the roll angle"),
    "torque_smoothness": (1.0, "1 - change of a joint's torque from sample to sample over 30 N m"),
}
"""Weight and meaning of each metric; over joints it is the root mean square."""

CHANNELS = 3 + 3 + 3 + robot.NUM_JOINTS
"""Numbers of ``channels``."""


def channels(s: Snapshot) -> Tensor:
    """Return what the metrics need (N, 21): both velocities, roll, limits, power, torques."""
    soft, stops = robot.soft_limits(SOFT), robot.JOINT_POS_LIMITS
    legs = [k for k in range(robot.NUM_JOINTS) if k % 3 < 2]  # hips and thighs
    low, high, width = (torch.as_tensor(v[legs]).float() for v in (soft[:, 0], soft[:, 1], np.ptp(stops, axis=1)))
    beyond = torch.maximum(low - s.joint_pos[:, legs], s.joint_pos[:, legs] - high).clamp(min=0.0) / width
    single = [s.projected_gravity_b[:, 1].abs(), _rms(beyond), _rms(s.joint_torque * s.joint_vel)]
    return torch.cat([s.base_lin_vel_b, s.base_ang_vel_b, torch.stack(single, 1), s.joint_torque], 1)


def _rms(values: Tensor) -> Tensor:
    return values.square().mean(-1).sqrt()


def metrics(sampled: Array, command: Array, largest: Sequence[float]) -> Array:
    """Return the metrics (S, N, 6), in the order of ``METRICS``.

    Args:
        sampled: ``channels`` (S, N, 21) at the times of the samples.
        command: commanded x, y, yaw rate (S, N, 3) there.
        largest: largest of each.
    """
    wanted = np.zeros((*command.shape[:2], 6))
    wanted[..., [0, 1, 5]] = command
    missed = sampled[..., :6] - wanted
    turns = np.diff(sampled[..., 9:], axis=0, prepend=sampled[:1, :, 9:])
    costs = (
        np.linalg.norm(missed[..., :3], axis=-1) / np.hypot(largest[0], largest[1]),
        np.linalg.norm(missed[..., 3:], axis=-1) / largest[2],
        sampled[..., 7],
        sampled[..., 8] / POWER,
        sampled[..., 6],
        np.sqrt((turns**2).mean(-1)) / TORQUE,
    )
    return np.asarray(np.clip(1.0 - np.stack(costs, -1), 0.0, 1.0))


def quality(graded: ArrayLike) -> Array:
    """Return the weighted geometric mean (...) of metrics (..., 6)."""
    weights = np.array([weight for weight, _ in METRICS.values()])
    return np.asarray(np.exp(np.log(np.maximum(graded, LEAST)) @ weights / weights.sum()))


def worse_half(each: ArrayLike) -> float:
    """Return the mean of the lower half of some values, rounded down to at least one."""
    ordered = np.sort(np.ravel(each))
    return float(ordered[: max(1, len(ordered) // 2)].mean())


def highest_level(shares: Sequence[float], enough: float) -> int:
    """Return the highest level, 1 for the first of the ``shares`` that passed it, that a bisection finds; 0 for none.

    It supposes that what is passed is passed on all lower levels, too, as the published search does.
    """
    low, high = 0, len(shares)
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if shares[middle - 1] >= enough else (low, middle - 1)
    return low


def score(level: int, worst: float) -> float:
    """Return the score of a level and of the quality there: 1 for ten levels and a quality of 1."""
    return PER_LEVEL * (level - 1) + OF_QUALITY * worst if level else 0.0


@dataclass(frozen=True)
class Subtask:
    """A command and what follows it."""

    group: str  # samples of one group are ordered together
    command: tuple[float, float, float]  # x m/s, y m/s, yaw rad/s
    until: float  # s
    then: float  # factor of the command from then on
    length: float  # s


class Graded:
    """Metrics and quality of a batch, sampled ten times a second after settling."""

    def __init__(self, motion: Motion, largest: Sequence[float], settle_s: float) -> None:
        assert motion.figures is not None
        every, first = max(1, round(SAMPLE / motion.dt)), round(settle_s / motion.dt)
        at = slice(first + every - 1, None, every)
        self._motion, self._t = motion, motion.t[at] - settle_s
        self._alive = motion.alive[at]
        self._metrics = metrics(motion.figures[at], motion.command[at], largest)
        self._quality = np.where(self._alive, quality(self._metrics), 0.0)

    def row(self, parts: Sequence[tuple[int, Subtask]]) -> Row:
        """Return the row of one robot from its sub-tasks, each with the robot of the batch that did it, in order."""
        qualities: dict[str, list[Array]] = {}
        counts = np.zeros_like(self._alive)
        for i, part in parts:
            during = self._t <= part.length + 1e-6
            qualities.setdefault(part.group, []).append(self._quality[during, i])
            counts[:, i] = self._alive[:, i] & during
        pooled = [np.concatenate(each) for each in qualities.values()]
        robots = [i for i, _ in parts]
        graded = mean_over(self._metrics[:, robots].reshape(-1, 1, len(METRICS)), counts[:, robots].reshape(-1, 1))[0]
        row: Row = {"quality": float(np.mean([each.mean() for each in pooled]))}
        row["quality_worst"] = float(np.mean([worse_half(each) for each in pooled]))
        row |= {name: float(v) if np.isfinite(v) else None for name, v in zip(METRICS, graded, strict=True)}
        return row | self._life(robots)

    def _life(self, robots: Sequence[int]) -> Row:
        """Return falls and times of the sub-tasks one after the other, until the first that ended early."""
        fell, left = self._motion.fell[robots], self._motion.left_map[robots]
        ended = np.flatnonzero(fell | left)
        until = int(ended[0]) + 1 if len(ended) else len(robots)
        moving, marks = self._motion.moving_s[robots][:until], self._motion.fingerprint[robots]
        life = {"fell": bool(fell[:until].any()), "left_map": bool(left[:until].any())}
        return life | {"moving_s": round(float(moving.sum()), 4), FINGERPRINT: float(marks.sum())}
