"""Where contact comes from, in errors of the estimated velocity: python -m benchmarks.foot_contacts [--run RUN].

The shipped policy walks in simulation under random commands up to 1.5 m/s, on flat ground and on boxes, with the
sensors of ``benchmarks/estimation.py``. The filter gets contact from the true forces under the feet, from torques
alone, from foot sensors whose zeros and scales are a calibration's (``check=true``), and from both together. The
calibration's own errors are those of a check in simulation: zeros up to 5 N high, since a lying robot's calves rest on
its feet, scales within a quarter, since a leg's weight is not in its torques. Beside it a plain leg odometry: the mean
speed of the feet that carry load, smoothed over 0.1 s. RMSE of the three components together, m/s, from 0.5 s on.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from benchmarks.estimation import COMMANDS, SENSORS
from benchmarks.replay import samples
from go1exp.base.paths import data_root
from go1exp.config.compose import compose
from go1exp.config.schema.registry import bind
from go1exp.deploy.estimation import go1, make_filter, readings
from go1exp.deploy.estimation.feet import FootCalibration, forces_by_torque, kinematics, mixed
from go1exp.deploy.runtime.estimate import BOTH, TORQUE
from go1exp.logs.record.simulate import Rig, Walk, play_policy
from go1exp.logs.recording import VECTORS, Recording
from go1exp.sim.task import parse_task

CONFIG = go1()
LEGS = kinematics(CONFIG)
BOXES = ("boxes_proportion=1.0", "bumps_proportion=0.0", "ramps_proportion=0.0", "flat_proportion=0.0")


def walks(run: Path, seconds: float, robots: int, seed: int = 0) -> Iterator[tuple[str, list[Recording]]]:
    """Yield ground and walks on it."""
    from go1exp.train.policy import load_run

    trained, policy, _ = load_run(run)
    command, problems = bind("command", "uniform_velocity", COMMANDS, "command")
    assert command is not None, problems
    for ground, terrain in (("flat", ["terrain=flat"]), ("boxes", ["terrain=rough", *(f"terrain.{b}" for b in BOXES)])):
        task = parse_task(compose("train", [*terrain, "backend.threads=1", "contact=stiff"]))
        rig = Rig(task.robot, task.actuator, (), task.terrain, task.backend, 0.002)
        names = [f"{ground}_{k}" for k in range(robots)]
        walk = Walk(replace(trained.task, command=command), policy, names, seconds, None)
        yield ground, list(play_policy(rig, walk, SENSORS, seed, lambda *_: None))


def by_torque(rows: np.ndarray) -> np.ndarray:
    """Return the vertical forces (T, 4), N, that balance the torques."""
    up = Rotation.from_quat(rows[:, readings.QUAT], scalar_first=True).as_matrix()[:, 2]
    each = zip(rows[:, readings.Q], rows[:, readings.TAU], up, strict=True)
    return np.array([forces_by_torque(q, torque, vertical, LEGS) for q, torque, vertical in each])


def counts(force: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, FootCalibration]:
    """Return what raw sensors say of forces (T, 4), N, in whole counts, and what a check would find of them."""
    zero, scale = rng.uniform(100.0, 130.0, 4), rng.uniform(0.5, 1.5, 4)
    seen = FootCalibration(
        tuple(zero + scale * rng.uniform(0.0, 5.0, 4)),
        tuple(scale * rng.uniform(0.75, 1.25, 4)),
    )
    return np.trunc(zero + scale * force), seen


def odometry(rows: np.ndarray, load: np.ndarray, smooth: float) -> np.ndarray:
    """Return the trunk's velocity (T, 3), m/s, by the feet that carry more than 25 N, smoothed over ``smooth`` s."""
    velocity, last = np.zeros((len(rows), 3)), np.zeros(3)
    for k, row in enumerate(rows):
        q, qd, gyro = (row[part] for part in (readings.Q, readings.QD, readings.GYRO))
        feet = [leg(one) for leg, one in zip(LEGS, q.reshape(4, 3), strict=True)]
        moving = np.array([j @ v + np.cross(gyro, p) for (p, j, _), v in zip(feet, qd.reshape(4, 3), strict=True)])
        standing = load[k] > 25.0
        last = -moving[standing].mean(axis=0) if standing.any() else last
        velocity[k] = last
    share = 1.0 - np.exp(-0.002 / smooth)
    return np.asarray(lfilter([share], [1.0, share - 1.0], velocity, axis=0))


def filtered(rows: np.ndarray, load: np.ndarray | None, **changes: object) -> np.ndarray:
    """Return the filter's velocity (T, 3), m/s; ``load`` (T, 4) stands for the foot forces."""
    rows = rows.copy()
    if load is not None:
        rows[:, readings.FOOT_FORCE] = load
    return np.asarray(make_filter(go1(**changes)).run(rows)[:, 3:6])


def sources(rows: np.ndarray, rng: np.random.Generator) -> dict[str, Callable[[], np.ndarray]]:
    """Return for each source of contact a function that gives the velocity."""
    torque = by_torque(rows)
    raw, seen = counts(rows[:, readings.FOOT_FORCE], rng)
    by_both = np.array([mixed(seen, one, two) for one, two in zip(raw, torque, strict=True)])
    return {
        "true forces": lambda: filtered(rows, None),
        "torques alone": lambda: filtered(rows, None, **TORQUE),
        "calibrated sensors": lambda: filtered(rows, (raw - seen.zero) / np.array(seen.scale)),
        "torques and calibrated sensors": lambda: filtered(rows, by_both, **BOTH),
        "leg odometry, smoothed, by both": lambda: odometry(rows, by_both, 0.1),
    }


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, default=data_root() / "assets/policies/paper")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    print("| ground | s | speed mean (max) | contact from | all | x y z | worst walk |\n|---|---|---|---|---|---|---|")
    for ground, recordings in walks(given.run, given.seconds, given.robots, given.seed):
        errors: dict[str, list[np.ndarray]] = {}
        speeds, total = [], 0.0
        for r in recordings:
            rows = samples(r)
            attitude = Rotation.from_quat(r.block(*VECTORS["base_quat"]), scalar_first=True)
            truth = attitude.inv().apply(r.block(*VECTORS["base_lin_vel"]))
            later = r.t > r.t[0] + 0.5
            speeds.append(np.linalg.norm(truth[later, :2], axis=1))
            total += r.t[-1] - r.t[0]
            for name, velocity in sources(rows, rng).items():
                errors.setdefault(name, []).append((velocity() - truth)[later])
        speed = np.concatenate(speeds)
        for name, each in errors.items():
            whole = np.concatenate(each)
            axes = " ".join(f"{value:.3f}" for value in np.sqrt((whole**2).mean(axis=0)))
            rmse = [float(np.sqrt((one**2).sum(axis=1).mean())) for one in (whole, *each)]
            about = f"| {ground} | {total:.0f} | {speed.mean():.2f} ({speed.max():.2f}) | {name} "
            print(f"{about}| {rmse[0]:.3f} | {axes} | {max(rmse[1:]):.3f} |", flush=True)


if __name__ == "__main__":
    main()
