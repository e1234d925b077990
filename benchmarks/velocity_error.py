"""The error of the estimated velocity as noise: ``python -m benchmarks.velocity_error run=RUN [robots=16]``.

A policy walks by what the filter makes of the robots' sensors, with noise and randomisation as in training, on the CPU.
Prints the root mean square error by axis and how long it lasts: what ``noise`` and ``correlation_time`` of an
observation should be.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from go1exp.base.tensors.threads import one_thread
from go1exp.config.schema.physics import CpuBackend
from go1exp.evaluate.agents import VelocityFilters
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import parse_train
from go1exp.train import run_folder
from go1exp.train.policy import load_policy

SETTLED_S = 2.0


def errors(run: Path, robots: int, seconds: float, seed: int) -> tuple[np.ndarray, float]:
    """Return the errors (T, N, 3), m/s in the trunk's frame, of the robots that did not fall, and the period, s."""
    config = parse_train(run_folder.read_config(run))
    policy, _ = load_policy(run, config)
    sim = dataclasses.replace(config.task.sim, physics_dt=0.002, episode_s=seconds + 1.0, spread_starts=False)
    task = dataclasses.replace(config.task, sim=sim, backend=CpuBackend("cpu", threads=1))
    core = Go1Core(task, robots, seed, imu=True)
    estimated, observation = VelocityFilters(core, True, seed), core.reset()
    rows, upright = [], np.ones(robots, dtype=bool)
    for _ in range(round(seconds / sim.policy_dt)):
        result = core.step(policy(estimated.put(observation)))
        observation = result.observation
        upright &= ~(result.terminated | result.truncated).numpy()
        true = core.snapshot().base_lin_vel_b
        assert true is not None
        rows.append(estimated.velocities() - true.numpy())
    return np.array(rows)[round(SETTLED_S / sim.policy_dt) :, upright], sim.policy_dt


def lasting(error: np.ndarray, period: float) -> np.ndarray:
    """Return the time (3,), s, after which the correlation of an error (T, N, 3) has fallen to 1 / e."""
    away = error - error.mean(axis=0)
    lags = range(1, len(away) // 2)
    correlation = np.array([(away[:-lag] * away[lag:]).mean((0, 1)) for lag in lags]) / (away**2).mean((0, 1))
    return (1 + np.argmax(correlation < np.exp(-1.0), axis=0)) * period


def main(arguments: Sequence[str]) -> None:
    """Print a table."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    if not {"run"} <= set(given) <= {"run", "robots", "seconds", "seed"}:
        raise SystemExit("usage: python -m benchmarks.velocity_error run=RUN [robots=16] [seconds=20] [seed=0]")
    robots, seconds = int(given.get("robots", 16)), float(given.get("seconds", 20.0))
    with one_thread():
        error, period = errors(Path(given["run"]), robots, seconds, int(given.get("seed", 0)))
    rms, times = np.sqrt((error**2).mean((0, 1))), lasting(error, period)
    for axis, size, time in zip("xyz", rms, times, strict=True):
        print(f"{axis}: {size:.4f} m/s root mean square (half-width {np.sqrt(3) * size:.3f}), lasts {time:.2f} s")
    print(f"{error.shape[1]} of {robots} robots did not fall; {error.shape[0] * period:.0f} s each")


if __name__ == "__main__":
    main(sys.argv[1:])
