"""Loads of the feet: calibration of raw sensors, and the forces that balance the joint torques."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from go1exp import robot
from go1exp.base.errors import Expected
from go1exp.deploy.estimation import FilterConfig, compiled_legs

LEGS = robot.NUM_LEGS
SINGULAR = 1e-6
"""Smallest determinant of a leg's Jacobian, m3/rad3: a straighter leg's torques do not give the force along it."""

HELD, LIGHT, STANDING = -30.0, 10.0, 60.0
"""Sums of the feet's vertical forces by torques, N: unloaded between the first two, standing above the third
(chosen: a Go1 weighs 125 N, joint friction adds up to 2 N a foot, and held legs that hang in the air take 3 N each)."""


class CalibrationError(Expected):
    """A calibration cannot be read or made."""


@dataclass(frozen=True)
class FootCalibration:
    """Zeros and scales of four foot sensors.

    Attributes:
        zero: (4,) counts without load.
        scale: (4,) counts per newton; None before the robot has stood.
    """

    zero: tuple[float, float, float, float]
    scale: tuple[float, float, float, float] | None = None

    def forces(self, counts: np.ndarray) -> np.ndarray:
        """Return forces (4,), N, for counts (4,); raise CalibrationError without scales."""
        if self.scale is None:
            raise CalibrationError("the feet's calibration has no scales: check=true while the robot stands makes them")
        return (np.asarray(counts, float) - self.zero) / self.scale

    def write(self, path: Path) -> None:
        """Write JSON."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def read(cls, path: Path) -> FootCalibration:
        """Read what ``write`` wrote; raise CalibrationError if it is no calibration; the message names file and key."""
        try:
            content = json.loads(Path(path).read_text())
            if not isinstance(content, dict) or not {"zero", "scale"} <= set(content):
                raise ValueError("must be a mapping with the keys zero and scale; check=true makes one")
            zero, scale = content["zero"], content["scale"]
            numbers = [*zero, *(scale or [1.0] * LEGS)]
            if len(zero) != LEGS or len(numbers) != 2 * LEGS or not np.isfinite(numbers).all():
                raise ValueError("needs four finite numbers in zero, and in scale or null there")
            if scale and min(scale) <= 0.0:
                raise ValueError(f"scale = {scale}: must be greater than 0")
            return cls(tuple(map(float, zero)), tuple(map(float, scale)) if scale else None)  # type: ignore[arg-type]
        except (ValueError, KeyError, TypeError) as error:
            raise CalibrationError(f"{path}: is no calibration of foot sensors: {error}") from None


def mixed(calibration: FootCalibration, counts: np.ndarray, by_torque: np.ndarray) -> np.ndarray:
    """Return loads (4,), N: the mean of calibrated sensors' counts (4,) and of the forces (4,), N, by torques.

    The torques contain the inertia of a swinging leg, the sensors an error of calibration: their errors differ in time.
    """
    return 0.5 * (calibration.forces(counts) + by_torque)


def vertical(quat: np.ndarray) -> np.ndarray:
    """Return the vertical (3,) in the trunk's frame, of an attitude w-x-y-z."""
    w, x, y, z = quat / max(float(np.linalg.norm(quat)), 1e-9)
    return np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


def forces_by_torque(
    q: np.ndarray, torque: np.ndarray, up: np.ndarray, legs: Sequence[Callable[[np.ndarray], Kinematics]]
) -> np.ndarray:
    """Return the vertical forces (4,), N, by which the ground balances the joints' torques: tau + J' f = 0.

    NaN for a leg with readings that are not finite, 0 for a straight leg.

    Args:
        q: (12,) joint angles, rad.
        torque: (12,) of the joints, N m.
        up: (3,) the vertical in the trunk's frame.
        legs: for each leg the function that returns position, Jacobian and turning of its foot (``kinematics``).
    """
    jacobians = np.array([leg(angles)[1] for leg, angles in zip(legs, q.reshape(LEGS, 3), strict=True)])
    unread = ~(np.isfinite(jacobians).all(axis=(1, 2)) & np.isfinite(torque.reshape(LEGS, 3)).all(axis=1))
    jacobians[unread] = np.eye(3)
    straight = abs(np.linalg.det(jacobians)) <= SINGULAR
    jacobians[straight] = np.eye(3)
    forces = -np.linalg.solve(jacobians.transpose(0, 2, 1), torque.reshape(LEGS, 3, 1))[..., 0] @ up
    forces[straight] = 0.0
    forces[unread] = np.nan
    return np.asarray(forces)


Kinematics = tuple[np.ndarray, np.ndarray, np.ndarray]


def kinematics(config: FilterConfig) -> list[Callable[[np.ndarray], Kinematics]]:
    """Return the compiled kinematics of each leg; raise EstimatorError if the compiled filter is missing."""
    return [leg.foot for leg in compiled_legs(config)]


def calibrated(
    counts: np.ndarray, by_torque: np.ndarray, before: FootCalibration | None = None
) -> tuple[FootCalibration | None, str]:
    """Return the calibration updated by a robot at rest, and a description of the update.

    A robot with unloaded feet (lying or suspended) gives zeros, a standing one scales.

    Args:
        counts: (4,) mean counts of the sensors.
        by_torque: (4,) mean vertical forces that balance the torques, N.
        before: the present calibration.
    """
    total = float(by_torque.sum())
    if HELD < total < LIGHT:
        scale = None if before is None else before.scale
        return FootCalibration(tuple(map(float, counts)), scale), "zeros, from a lying or suspended robot"  # type: ignore[arg-type]
    if total < STANDING or by_torque.min() < 0.3 * total / LEGS:
        return before, f"unchanged: the feet carry {total:.0f} N by the torques, which is neither lying nor standing"
    if before is None:
        return None, "unchanged: zeros are unknown; run check=true first while the robot lies or is suspended"
    scale = (counts - before.zero) / by_torque
    if scale.min() <= 0.0:
        legs = ", ".join(leg for leg, value in zip(robot.LEGS, scale, strict=True) if value <= 0.0)
        return before, f"unchanged: the counts of {legs} do not grow under load"
    return FootCalibration(before.zero, tuple(map(float, scale))), "scales, from a standing robot"  # type: ignore[arg-type]
