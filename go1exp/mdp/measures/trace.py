"""``Trace``: N robots over T steps, the input of every measure; and ``Runs``, the stances and swings in it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from go1exp import robot

NOT_COUNTED = 2
"""State of a foot at a time that does not count; 0 is the air, 1 the ground."""


@dataclass(frozen=True)
class Runs:
    """Maximal stretches of one state in columns of samples, ordered by column and time; all arrays are (R,).

    Attributes:
        column: which column.
        start: its first sample.
        stop: the sample after its last.
        value: the state.
        begins: it begins with a change between air and ground, and not with the record.
        ends: it ends so.
    """

    column: NDArray[np.intp]
    start: NDArray[np.intp]
    stop: NDArray[np.intp]
    value: NDArray[np.int8]
    begins: NDArray[np.bool_]
    ends: NDArray[np.bool_]

    @property
    def length(self) -> NDArray[np.intp]:
        """Samples of each run."""
        return self.stop - self.start

    def where(self, value: int, *, whole: bool) -> Runs:
        """Return those of a state that begin, and if ``whole`` also end, with a change between air and ground."""
        which = (self.value == value) & self.begins & (self.ends | (not whole))
        return Runs(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def find_runs(states: NDArray[np.int8]) -> Runs:
    """Return the runs of ``states`` (columns, samples)."""
    samples = states.shape[1]
    if not states.size:
        none = np.zeros(0, np.intp)
        return Runs(none, none, none, none.astype(np.int8), none.astype(bool), none.astype(bool))
    flat = states.ravel()
    change = np.ones(len(flat), bool)
    change[1:] = flat[1:] != flat[:-1]
    change[::samples] = True
    first = np.flatnonzero(change)
    last = np.append(first[1:], len(flat))
    column, value = first // samples, flat[first]
    counted = value != NOT_COUNTED
    joined = np.zeros(len(first) + 1, bool)  # between a run and the one before it
    joined[1:-1] = (column[1:] == column[:-1]) & counted[1:] & counted[:-1]
    return Runs(column, first - column * samples, last - column * samples, value, joined[:-1], joined[1:])


def settled(states: NDArray[np.int8], least: int) -> NDArray[np.int8]:
    """Return ``states`` (columns, samples) without stretches in the air, then on the ground, of less than ``least``.

    A foot that strikes a stiff ground may leave it again for a sample or two: that ends no stance.
    """
    for value in (0, 1):
        runs = find_runs(states)
        short = (runs.value == value) & runs.begins & runs.ends & (runs.length < least)
        filled = np.where(short, 1 - runs.value, runs.value).astype(np.int8)
        states = np.repeat(filled, runs.length).reshape(states.shape)
    return states


def largest_within(
    values: NDArray[np.float64], column: NDArray[np.intp], start: NDArray[np.intp], stop: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return the largest of ``values`` (columns, samples) in each stretch (E,), from start to before stop."""
    samples = values.shape[1]
    flat = np.append(values.ravel(), -np.inf)  # a stretch may end where the values do
    bounds = np.stack([column * samples + start, column * samples + stop], 1).ravel()
    return np.maximum.reduceat(flat, bounds)[::2] if len(bounds) else np.zeros(0)


Array = NDArray[np.floating]

LEAST_PHASE = 0.01
"""Stances and swings shorter than this are taken for bounces, s: half of a policy step (chosen)."""


class NotMeasured(ValueError):
    """A measure needs a column that its trace does not have; the message names it."""


@dataclass(frozen=True, eq=False)
class Trace:
    """N robots over T steps and S >= T samples of contact, S a multiple of T; a column that was not measured is None.

    Joints and legs are in the order of ``robot.py``. A step is a policy step, a sample a physics step. A value belongs
    to the end of its step unless it says otherwise.
    """

    contact: NDArray[np.bool_]
    """(S, N, 4) the foot bore force."""
    contact_dt: float
    """Time between two samples of ``contact``, s."""
    counts: NDArray[np.bool_]
    """(T, N) steps that count: not while settling, not after a fall."""
    mass: NDArray[np.floating] | None = None
    """(N,) of the robot with its load, kg."""
    command: Array | None = None
    """(T, N, 3) commanded velocity: x, y in m/s, yaw rate in rad/s, body frame."""
    base_lin_vel_b: Array | None = None
    """(T, N, 3) velocity of the trunk in its frame, m/s."""
    projected_gravity_b: Array | None = None
    """(T, N, 3) direction of gravity in the trunk's frame, unit length."""
    base_height: Array | None = None
    """(T, N) height of the trunk's origin over the ground below it, m."""
    joint_vel: Array | None = None
    """(T, N, 12) rad/s."""
    joint_torque: Array | None = None
    """(T, N, 12) N m."""
    joint_target: Array | None = None
    """(T, N, 12) position target in force during the step, rad."""
    positive_power: Array | None = None
    """(T, N) mean over the step of sum_j max(0, tau_j qd_j), W."""
    foot_height: Array | None = None
    """(T, N, 4) largest height of the foot's centre over the ground during the step, m."""
    foot_depth: Array | None = None
    """(T, N, 4) largest depth of the sole in the ground during the step, m; 0 in the air."""
    foot_slip_speed: Array | None = None
    """(T, N, 4) horizontal speed of the sole, the lowest point of the foot's sphere, m/s."""
    foot_force: Array | None = None
    """(T, N, 4) mean magnitude of the ground's force on the foot over the step, N."""
    foot_peak_force: Array | None = None
    """(T, N, 4) largest magnitude of that force during the step, N."""
    foot_touchdown_speed: Array | None = None
    """(T, N, 4) speed of the fastest touchdown during the step just before its contact, m/s; any value without one."""

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ValueError: naming the column that does not fit.
        """
        steps, robots = self.counts.shape
        shapes = {"contact": (len(self.contact), robots, robot.NUM_LEGS), "mass": (robots,)}
        if not steps or len(self.contact) % steps:
            raise ValueError(f"contact: its {len(self.contact)} samples must be a multiple of the {steps} steps")
        for name in columns():
            per = {"joint": (robot.NUM_JOINTS,), "foot": (robot.NUM_LEGS,)}.get(name.split("_")[0], ())
            inner = (3,) if name in ("command", "base_lin_vel_b", "projected_gravity_b") else per
            shapes[name] = (steps, robots, *inner)
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values is not None and values.shape != shape:
                raise ValueError(f"{name}: must be {shape}, and is {values.shape}")

    @property
    def steps(self) -> int:
        """T."""
        return len(self.counts)

    @property
    def robots(self) -> int:
        """N."""
        return self.counts.shape[1]

    @property
    def samples(self) -> int:
        """Samples of contact in a step."""
        return len(self.contact) // self.steps

    @property
    def step_dt(self) -> float:
        """Duration of a step, s."""
        return self.samples * self.contact_dt

    def need(self, column: str) -> Array:
        """Return a column.

        Raises:
            NotMeasured: if this trace does not have it.
        """
        values: Array | None = getattr(self, column)
        if values is None:
            raise NotMeasured(f"needs {column}, which was not measured")
        return values

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """(T, N) steps that count and with a non-zero command; without a command, all that count."""
        if self.command is None:
            return self.counts
        return self.counts & np.any(self.command != 0.0, axis=-1)

    @cached_property
    def touching(self) -> NDArray[np.bool_]:
        """(S, N, 4) ``contact`` without bounces."""
        states = settled(self._by_foot(self.contact), self._least)
        return np.moveaxis(states.reshape(self.robots, robot.NUM_LEGS, -1), -1, 0) == 1

    @cached_property
    def phases(self) -> Runs:
        """Stances (value 1) and swings (0) while ``moving``; column 4 n + l is foot l of robot n, times in samples."""
        return self._runs(self.moving)

    @cached_property
    def stances(self) -> Runs:
        """Whole and cut stances while the robot counts, standing ones included."""
        return self._runs(self.counts)

    def _runs(self, which: NDArray[np.bool_]) -> Runs:
        sampled = np.repeat(which, self.samples, axis=0)[:, :, None]
        return find_runs(self._by_foot(np.where(sampled, self.touching.astype(np.int8), np.int8(NOT_COUNTED))))

    @cached_property
    def pauses(self) -> NDArray[np.intp]:
        """(T, N) steps so far that are not ``moving``: no stride spans one."""
        return np.cumsum(~self.moving, axis=0)

    @property
    def _least(self) -> int:
        return round(LEAST_PHASE / self.contact_dt)

    def _by_foot(self, samples: np.ndarray) -> NDArray[np.int8]:
        """Turn (S, N, 4) into (4 N, S)."""
        return np.ascontiguousarray(np.moveaxis(samples.astype(np.int8), 0, -1)).reshape(-1, len(samples))


def columns() -> list[str]:
    """Return the names of the columns that have a value for each step and may be missing."""
    return [f.name for f in fields(Trace) if f.default is None and f.name != "mass"]


# ---------------------------------------------------------------------- figures over the steps of each robot


def mean_over(values: Array, which: NDArray[np.bool_]) -> Array:
    """Return the mean over the steps of ``which`` (T, N) of ``values`` (T, N, ...); NaN for a robot without any."""
    mask = which.reshape(which.shape + (1,) * (values.ndim - 2))
    count = mask.sum(0)
    total = np.where(mask, values, 0.0).sum(0, dtype=np.float64)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def percentile_over(values: Array, which: NDArray[np.bool_], percent: float) -> Array:
    """Return that percentile (N,) over the steps of ``which`` (T, N) and over all further axes of ``values``."""
    result = np.full(which.shape[1], np.nan)
    for n in np.flatnonzero(which.any(0)):
        result[n] = np.percentile(values[which[:, n], n], percent)
    return result


def percentile_by_robot(values: Array, robots: NDArray[np.intp], count: int, percent: float) -> Array:
    """Return that percentile (count,) of the ``values`` (E,) that belong to each of ``robots`` (E,)."""
    result = np.full(count, np.nan)
    for n in np.unique(robots):
        result[n] = np.percentile(values[robots == n], percent)
    return result


def ratio(numerator: np.ndarray, denominator: np.ndarray) -> Array:
    """Return the quotient, NaN where the denominator is not positive."""
    out = np.full(np.broadcast(numerator, denominator).shape, np.nan)
    return np.divide(numerator, denominator, out=out, where=np.asarray(denominator) > 0)
