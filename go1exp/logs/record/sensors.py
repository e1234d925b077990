"""The simulated logger of a Go1: sampling rate, quantisation, noise, an uneven clock; only what the robot measures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from pydantic import ConfigDict, Field

from go1exp import robot
from go1exp.config.schema.registry import STRICT, Fraction, NonNegative, Positive
from go1exp.logs.recording import FOOT_FORCE, VECTORS, columns, joint_columns


@dataclass(frozen=True)
class Channel:
    """Errors of one kind of channel, in its unit.

    Attributes:
        noise: standard deviation of white noise.
        step: step between the values that can be reported; 0 for none.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    noise: NonNegative
    step: NonNegative


@dataclass(frozen=True)
class SensorConfig:
    """The logger.

    Attributes:
        rate_hz: samples per second (the vendor's SDK: 500).
        jitter: scale of the delay of a time stamp, s: the absolute value of a Gaussian with this standard deviation.
        dropped: share of the samples that are lost.
        q: joint angle, rad.
        qd: joint velocity, rad/s.
        tau_est: torque that the actuator reports, N m.
        gyro: angular velocity, rad/s.
        acc: specific force, m/s2.
        attitude: error of the reported attitude as a small rotation, rad (its ``step`` is of the quaternion).
        foot_force: force of a foot's sensor, N.
        truth: also write the true position and velocity of the base, as motion capture measures them.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    rate_hz: Positive
    jitter: NonNegative
    dropped: Annotated[Fraction, Field(lt=0.9)]
    q: Channel
    qd: Channel
    tau_est: Channel
    gyro: Channel
    acc: Channel
    attitude: Channel
    foot_force: Channel
    truth: bool


def _with_errors(true: np.ndarray, channel: Channel, rng: np.random.Generator) -> np.ndarray:
    return _quantised(true + channel.noise * rng.standard_normal(true.shape), channel)


def _quantised(values: np.ndarray, channel: Channel) -> np.ndarray:
    return np.round(values / channel.step) * channel.step if channel.step else values


def log(true: Mapping[str, np.ndarray], config: SensorConfig, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return the channels of a recording.

    Args:
        true: samples on an even clock: ``q``, ``qd``, ``q_target``, ``tau_est`` (T, J), ``gyro``, ``acc`` (T, 3) and
            ``quat`` (T, 4) of the IMU, ``foot_force`` (T, 4), ``torque_enable`` (T,), and for the ground truth
            ``base_pos``, ``base_quat``, ``base_lin_vel``, ``base_ang_vel``.
        config: the logger.
        rng: of its noise.
    """
    from scipy.spatial.transform import Rotation  # slow to import, and settings are checked first

    rows = len(true["q"])
    dt = 1.0 / config.rate_hz
    # The bus delays a stamp and never advances it; a delayed sample stays before the next one.
    late = np.minimum(np.abs(config.jitter * rng.standard_normal(rows)), 0.9 * dt)
    channels: dict[str, np.ndarray] = {"t": np.arange(rows) * dt + late}
    for name in ("q", "qd", "tau_est"):
        measured = _with_errors(true[name], getattr(config, name), rng)
        channels |= joint_columns(name, robot.JOINTS, measured)
    channels |= joint_columns("q_target", robot.JOINTS, true["q_target"])
    for name in ("gyro", "acc"):
        channels |= columns(VECTORS[f"imu_{name}"], _with_errors(true[name], getattr(config, name), rng))
    # The error is a small rotation in the body's axes, so that it does not depend on the attitude.
    error = Rotation.from_rotvec(config.attitude.noise * rng.standard_normal((rows, 3)))
    attitude = Rotation.from_quat(true["quat"], scalar_first=True) * error
    quat = _quantised(attitude.as_quat(canonical=True, scalar_first=True), config.attitude)
    channels |= columns(VECTORS["imu_quat"], quat)
    forces = np.maximum(_with_errors(true["foot_force"], config.foot_force, rng), 0.0)
    channels |= columns((FOOT_FORCE + leg for leg in robot.LEGS), forces)
    if not true["torque_enable"].all():
        channels["torque_enable"] = true["torque_enable"].astype(bool)
    if config.truth:
        for name in ("base_pos", "base_quat", "base_lin_vel", "base_ang_vel"):
            if name in true:
                channels |= columns(VECTORS[name], true[name])
    # Samples are lost after everything else is drawn: the noise of the others does not depend on the loss.
    kept = rng.random(rows) >= config.dropped
    kept[0] = True
    return {name: np.ascontiguousarray(values[kept]) for name, values in channels.items()}
