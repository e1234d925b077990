"""The Kalman filter of ``go1exp.estimation`` as the controller's estimator."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from go1exp.deploy.messages import LowState
from go1exp.estimation import FilterConfig, Status, from_json, go1, make_filter, sample
from go1exp.estimation.feet import FootCalibration, LoadByBoth

FASTEST = 10.0
"""Speed above which an estimate has diverged, m/s: the top speed of a Go1's joints gives about 6 m/s."""

BLIND_S = 0.1
"""Longest time for which the filter may refuse all samples, s; after that its last estimate is too old."""

LOADED: dict[str, Any] = {"contact_low": 20.0, "contact_high": 40.0}
"""Force, N, up to which a foot that swings may seem loaded, since its leg is quick; and from which it is."""

TORQUE: dict[str, Any] = {"contact_source": "torque", **LOADED}
"""Contact from the joints' torques, for a robot whose foot sensors are not calibrated (``docs/estimation.md``)."""

BOTH: dict[str, Any] = {"contact_source": "force", **LOADED}
"""Contact from torques and calibrated foot sensors together (``docs/estimation.md``)."""

Fail = Callable[[str, str, float], None]
"""``Safety.fail``: name of the fault, message, the runtime's clock."""


def settings(given: Mapping[str, Any], **changes: Any) -> FilterConfig:
    """Return the filter's settings from a bundle's metadata; a Go1's if it has none; ``changes`` replace some.

    Raises:
        go1exp.schema.registry.ConfigError: if something is missing, unknown or of a wrong value.
    """
    if not given:
        return go1(**changes)
    return from_json(json.dumps(dict(given)), "estimator", changes)


class KalmanEstimator:
    """Velocity of the trunk from every state of the robot.

    Attributes:
        refused: number of samples that the filter left out, by ``Status``.
        restarts: number of times that it initialised the speed again after a gap.
    """

    def __init__(self, config: FilterConfig, fail: Fail, feet: FootCalibration | None = None) -> None:
        """Build the filter; ``fail`` is called when its estimate is no longer valid.

        Args:
            config: its settings.
            fail: ``Safety.fail``.
            feet: of sensors that count instead of saying newtons.

        Raises:
            go1exp.estimation.EstimatorError: if the compiled filter is missing.
        """
        self._filter, self._fail = make_filter(config), fail
        self._both = None if feet is None else LoadByBoth(config, feet)
        self._velocity = np.full(3, np.nan)
        self._since: float | None = None
        self.refused = {Status.LATE.name: 0, Status.INVALID.name: 0}
        self.restarts = 0

    def update(self, state: LowState) -> np.ndarray:
        """Take a new state; return the velocity (3,), m/s, of the trunk's origin in the trunk frame.

        It is NaN before the first valid state. After a refused sample the last estimate stays in force for ``BLIND_S``;
        whether the reading itself is a fault is decided by ``Safety``.
        """
        # The robot's own clock is even; times of arrival have the delays of the network.
        clock = state.t if math.isnan(state.clock) else state.clock
        row = sample(
            clock,
            state.imu_quat,
            state.imu_gyro,
            state.imu_acc,
            state.joint_pos,
            state.joint_vel,
            state.joint_torque,
            self._loads(state),
        )
        status = Status(self._filter.update(row))
        if status.name in self.refused:
            self.refused[status.name] += 1
            self._since = state.t if self._since is None else self._since
            if state.t - self._since > BLIND_S:
                self._fail(
                    "estimator", f"the filter has refused every sample for {BLIND_S:g} s ({status.name})", state.t
                )
            return self._velocity
        self._since = None
        self.restarts += status is Status.RESTARTED
        velocity = np.array(self._filter.velocity_b)
        speed = math.hypot(*velocity)
        if not speed <= FASTEST:  # NaN too
            self._fail("estimator", f"the filter has diverged: it says {speed:g} m/s", state.t)
        self._velocity = velocity
        return velocity

    def _loads(self, state: LowState) -> np.ndarray:
        """Return what the filter takes for the forces under the feet (4,), N."""
        if self._both is None:
            return state.foot_force
        return self._both.loads(state.foot_force, state.joint_pos, state.joint_torque, state.imu_quat)


class NoEstimator:
    """For a policy that does not use the velocity: nothing is estimated."""

    def update(self, state: LowState) -> np.ndarray:
        """Return NaN."""
        return np.full(3, np.nan)
