"""The logger of the hidden robot: noise, steps of the encoder, an uneven clock, lost samples; and the files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.gap.motions import RATE
from benchmarks.gap.simulate import Episode, Samples, attitude
from go1exp import robot
from go1exp.logs.recording import Meta, Recording, joint_channels, write


@dataclass(frozen=True)
class Logger:
    """Errors of one robot's logger.

    Attributes:
        q_noise: rad.
        q_step: step of the encoders, rad; 0 for none.
        qd_noise: rad/s.
        torque_noise: N m; None if torque is not reported.
        jitter: standard deviation of a time stamp, s.
        tick: step of the clock, s; 0 for none.
        skew: error of the clock's rate.
        dropped: share of lost samples.
    """

    q_noise: float = 0.0
    q_step: float = 0.0
    qd_noise: float = 0.0
    torque_noise: float | None = None
    jitter: float = 0.0
    tick: float = 0.0
    skew: float = 0.0
    dropped: float = 0.0


def draw(rng: np.random.Generator) -> Logger:
    """Draw a logger of the kind that a Go1 has (14-bit encoders, 500 Hz)."""
    return Logger(
        q_noise=float(rng.uniform(2e-4, 6e-4)),
        q_step=float(rng.choice([2 * np.pi / 2**14, 2 * np.pi / 2**15])),
        qd_noise=float(rng.uniform(0.02, 0.06)),
        torque_noise=float(rng.uniform(0.08, 0.2)) if rng.random() < 0.5 else None,
        jitter=float(rng.uniform(1e-5, 6e-5)),
        tick=1e-5,
        skew=float(rng.uniform(-3e-5, 3e-5)),
        dropped=float(rng.uniform(0.0005, 0.005)),
    )


def log(
    logger: Logger,
    samples: Samples,
    k: int,
    target: np.ndarray,
    on: np.ndarray,
    rng: np.random.Generator,
    beside: Mapping[str, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """Return the channels of robot ``k``; ``beside`` are others (T,), with their noise."""
    rows = len(target)
    late = np.clip(logger.jitter * rng.standard_normal(rows), -0.4 / RATE, 0.4 / RATE)
    t = float(rng.uniform(1.0, 60.0)) + np.arange(rows) / RATE * (1.0 + logger.skew) + late
    if logger.tick:
        t = np.round(t / logger.tick) * logger.tick
    q = samples.q[:, k] + logger.q_noise * rng.standard_normal((rows, robot.NUM_JOINTS))
    if logger.q_step:
        q = np.round(q / logger.q_step) * logger.q_step
    qd = samples.qd[:, k] + logger.qd_noise * rng.standard_normal(q.shape)
    channels = {"t": t}
    for name, values in (("q", q), ("qd", qd), ("q_target", target)):
        channels |= dict(zip(joint_channels(name, robot.JOINTS), values.T, strict=True))
    if logger.torque_noise is not None:
        torque = samples.torque[:, k] + logger.torque_noise * rng.standard_normal(q.shape)
        channels |= dict(zip(joint_channels("tau_est", robot.JOINTS), torque.T, strict=True))
    if not on.all():
        channels["torque_enable"] = on
    channels |= beside or {}
    kept = rng.random(rows) >= logger.dropped
    kept[0] = True
    return {name: np.ascontiguousarray(values[kept]) for name, values in channels.items()}


def meta(episode: Episode) -> Meta:
    """Describe an episode as a real robot's logger would; nothing in it tells what the robot hides."""
    w, x, y, z = attitude(episode.hang).as_quat(scalar_first=True)
    base_quat = (float(w), float(x), float(y), float(z))
    return described(episode.name, episode.excitation, (episode.kp, episode.kd), base_quat, episode.repeat_of)


def described(
    name: str,
    excitation: str,
    gains: tuple[float, float],
    base_quat: tuple[float, float, float, float] | None,
    repeat_of: str | None = None,
) -> Meta:
    """Describe a recording at gains kp and kd, N m/rad and N m s/rad; ``base_quat`` is the attitude of a held trunk."""
    kp, kd = gains
    return Meta(
        robot="go1",
        joints=robot.JOINTS,
        rate_hz=RATE,
        base="floating" if base_quat is None else "fixed",
        base_quat=base_quat,
        kp=(kp,) * robot.NUM_JOINTS,
        kd=(kd,) * robot.NUM_JOINTS,
        tau_limit=tuple(float(v) for v in robot.per_joint(robot.EFFORT_LIMIT)),
        excitation=excitation,
        episode=name,
        repeat_of=repeat_of,
        source="measured",
        tool="logger",
        versions={},
        notes="",
    )


def save(folder: Path, recordings: list[Recording]) -> None:
    """Write the episodes of a case as ``episode_NN.parquet``."""
    for k, recording in enumerate(recordings):
        write(folder / f"episode_{k:02d}.parquet", recording)
