"""The Kalman filter of ``go1exp.deploy.estimation`` as the controller's estimator."""

from __future__ import annotations

import heapq
import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from go1exp.deploy.estimation import GRAVITY, FilterConfig, Status, from_json, go1, make_filter, readings, sample
from go1exp.deploy.estimation.feet import LEGS, FootCalibration, forces_by_torque, kinematics, mixed, vertical
from go1exp.deploy.runtime.controller import Estimator
from go1exp.robot.go1_fields import PERIOD
from go1exp.robot.messages import OVERTAKEN_S, LowState

FASTEST = 10.0
"""Speed above which an estimate has diverged, m/s: the joint velocity limits give about 6 m/s."""

BLIND_S = 0.1
"""Longest time for which the filter may leave out all samples, s."""

LONGEST_AHEAD = 0.01
"""Longest extrapolation by one reading of the accelerometer, s."""

LOADED = {"contact_low": 20.0, "contact_high": 40.0}
"""Apparent force of a swinging foot by the leg's inertia, N, and force from which a foot is loaded."""

TORQUE: dict[str, str | float] = {"contact_source": "torque", **LOADED}
"""Contact from the joints' torques, for a robot whose foot sensors are not calibrated (``docs/estimation.md``)."""

BOTH: dict[str, str | float] = {"contact_source": "force", **LOADED}
"""Contact from torques and calibrated foot sensors together (``docs/estimation.md``)."""

Fail = Callable[[str, str, float], None]
"""``Safety.fail``: name of the fault, message, the runtime's clock."""


def settings(given: Mapping[str, Any], **changes: Any) -> FilterConfig:
    """Return the filter's settings from a bundle's metadata; a Go1's if it has none; ``changes`` replace some.

    Raises:
        go1exp.config.schema.registry.ConfigError: if something is missing, unknown or of a wrong value.
    """
    if not given:
        return go1(**changes)
    return from_json(json.dumps(dict(given)), "estimator", changes)


class KalmanEstimator(Estimator):
    """Velocity of the trunk from every state of the robot.

    The filter takes states in the order of measurement. It waits for an overtaken one, ``OVERTAKEN_S`` at most.
    Meanwhile, and up to the requested instant, the velocity is extrapolated by the IMU alone.

    Attributes:
        refused: number of samples that the filter left out, by ``Status``.
        restarts: number of restarts after a gap.
    """

    def __init__(self, config: FilterConfig, fail: Fail, feet: FootCalibration | None = None) -> None:
        """Build the filter; ``fail`` is called when its estimate is no longer valid.

        Args:
            config: its settings.
            fail: ``Safety.fail``.
            feet: calibration of raw foot sensors.

        Raises:
            go1exp.deploy.estimation.EstimatorError: if the compiled filter is missing.
            go1exp.deploy.estimation.feet.CalibrationError: if the calibration has no scales.
        """
        self._filter, self._fail = make_filter(config), fail
        self._feet, self._legs = feet, kinematics(config)
        if feet is not None:
            feet.forces(np.zeros(LEGS))  # raises without scales
        self._velocity = np.full(3, np.nan)
        self._row: np.ndarray | None = None  # the sample of that velocity
        self._waiting: list[tuple[float, int, LowState, np.ndarray]] = []  # a heap of what waits: clock, count, sample
        self._taken_until, self._count = math.nan, 0
        self._since: float | None = None
        self.refused = {Status.LATE.name: 0, Status.INVALID.name: 0}
        self.restarts = 0

    def update(self, state: LowState) -> np.ndarray:
        """Add a state; return the velocity (3,), m/s, of the trunk's origin in the trunk frame at the newest state.

        NaN before the first valid state. The last estimate remains valid for ``BLIND_S`` without a valid sample;
        invalid readings are a fault by ``Safety``.
        """
        if math.isnan(state.clock):  # its order is unknown
            self._take(state, self._sample(state, state.t))
            return self.ahead(0.0)
        if 0.0 < self._taken_until - state.clock <= OVERTAKEN_S:  # too late
            self.refused[Status.LATE.name] += 1
            return self.ahead(0.0)
        # Intervals of the robot's clock have no network delays.
        row = self._sample(state, state.clock)
        if not self._waiting and self._is_due(state.clock, state.clock):  # as nearly always
            self._taken_until = state.clock
            self._take(state, row)
            return self._velocity
        self._count += 1
        heapq.heappush(self._waiting, (state.clock, self._count, state, row))
        newest = max(clock for clock, *_ in self._waiting)
        while self._waiting and self._is_due(self._waiting[0][0], newest):
            self._taken_until, _, first, its_row = heapq.heappop(self._waiting)
            self._take(first, its_row)
        return self.ahead(0.0)

    def _is_due(self, clock: float, newest: float) -> bool:
        """Return whether the oldest waiting state is due: no earlier one can arrive any more."""
        gap = clock - self._taken_until  # NaN at first
        return not 1.5 * PERIOD < gap <= OVERTAKEN_S or newest - clock >= OVERTAKEN_S - 1e-9

    def ahead(self, age: float) -> np.ndarray:
        """Return the velocity (3,), m/s, of the trunk's origin in its frame, ``age`` s after the newest state.

        The filter's estimate, integrated by specific force and angular velocity of the waiting states, then by
        those of the newest one for ``age``, at most ``LONGEST_AHEAD``; NaN counts as 0. The IMU's offset is neglected.
        """
        velocity, row = self._velocity, self._row
        if row is None or not (self._waiting or age > 0.0):
            return velocity
        for *_, later in sorted(self._waiting, key=lambda one: one[:2]):
            half = 0.5 * (later[readings.T] - row[readings.T])
            velocity = velocity + half * (acceleration(row, velocity) + acceleration(later, velocity))
            row = later
        if age > 0.0:
            velocity = velocity + min(age, LONGEST_AHEAD) * acceleration(row, velocity)
        return velocity if np.isfinite(velocity).all() else self._velocity

    def _sample(self, state: LowState, clock: float) -> np.ndarray:
        forces = state.foot_force
        if self._feet is not None:
            by_torque = forces_by_torque(state.joint_pos, state.joint_torque, vertical(state.imu_quat), self._legs)
            forces = mixed(self._feet, forces, by_torque)
        return sample(
            clock,
            state.imu_quat,
            state.imu_gyro,
            state.imu_acc,
            state.joint_pos,
            state.joint_vel,
            state.joint_torque,
            forces,
        )

    def _take(self, state: LowState, row: np.ndarray) -> None:
        """Update the filter, and report a fault if its estimate is invalid."""
        status = Status(self._filter.update(row))
        if status.name in self.refused:
            self.refused[status.name] += 1
            self._since = state.t if self._since is None else self._since
            if state.t - self._since > BLIND_S:
                self._fail(
                    "estimator", f"the filter has left out every sample for {BLIND_S:g} s ({status.name})", state.t
                )
            return
        self._since = None
        self.restarts += status is Status.RESTARTED
        velocity = np.array(self._filter.velocity_b)
        speed = math.hypot(*velocity)
        if not speed <= FASTEST:  # NaN too
            self._fail("estimator", f"the filter has diverged: {speed:g} m/s", state.t)
        self._velocity, self._row = velocity, row


def acceleration(row: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the derivative (3,), m/s2, of a velocity (3,), m/s, in the trunk's frame.

    v' = f - R'(0, 0, 9.81) - w x v, with specific force f, attitude R and angular velocity w of a sample ``row`` (51,).
    """
    w, x, y, z = row[readings.QUAT].tolist()
    a, b, c = row[readings.GYRO].tolist()
    fx, fy, fz = row[readings.ACC].tolist()
    u, v, up = velocity.tolist()
    return np.array(
        (
            fx - 2.0 * GRAVITY * (x * z - w * y) - (b * up - c * v),
            fy - 2.0 * GRAVITY * (y * z + w * x) - (c * u - a * up),
            fz - GRAVITY * (1.0 - 2.0 * (x * x + y * y)) - (a * v - b * u),
        )
    )
