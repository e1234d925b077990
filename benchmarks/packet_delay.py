"""What late packets cost the estimated velocity: python -m benchmarks.packet_delay [--run RUN] [--seed 1].

The walks of ``benchmarks/foot_contacts.py``; their states, 500 a second, go through a network that delays each by up
to ``jitter`` more than the fastest and loses some. The runtime's estimator gets them as the link would deliver them,
and is asked at each cycle. RMSE of the three components together, m/s, against the truth at the cycle less the fastest
way:

- in order of arrival: what was overtaken is left out, and the estimate is that of the newest state (how it was before);
- in their turn: overtaken states are waited for, as ``KalmanEstimator`` does;
- to the cycle: and the IMU carries the velocity on to the cycle.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.foot_contacts import walks
from benchmarks.replay import samples
from go1exp.base.paths import data_root
from go1exp.deploy.estimation import go1, make_filter, readings, sample
from go1exp.deploy.runtime.estimate import KalmanEstimator
from go1exp.deploy.runtime.udp import PacketDelay
from go1exp.logs.recording import VECTORS
from go1exp.robot.go1_fields import PERIOD
from go1exp.robot.messages import OVERTAKEN_S, LowState

NETWORKS = ((0.0, 0.0), (0.0, 0.01), (0.002, 0.0), (0.005, 0.01), (0.01, 0.01), (0.02, 0.02))
"""Jitter, s, and share of the packets that are lost."""

WAYS = ("in order of arrival", "in their turn", "to the cycle")


def arrivals(rows: np.ndarray, jitter: float, loss: float, rng: np.random.Generator) -> list[LowState]:
    """Return the states of samples (T, 51), ``PERIOD`` apart by the robot's clock, in the order of their arrival."""
    arrived = PERIOD * np.arange(len(rows)) + jitter * rng.random(len(rows))
    arrived[rng.random(len(rows)) < loss] = np.inf
    order = np.argsort(arrived, kind="stable")
    return [_state(rows[k], float(arrived[k]), PERIOD * int(k)) for k in order if np.isfinite(arrived[k])]


def _state(row: np.ndarray, t: float, clock: float) -> LowState:
    return LowState(
        t=t,
        clock=clock,
        joint_pos=row[readings.Q],
        joint_vel=row[readings.QD],
        joint_torque=row[readings.TAU],
        imu_quat=row[readings.QUAT],
        imu_gyro=row[readings.GYRO],
        imu_acc=row[readings.ACC],
        foot_force=row[readings.FOOT_FORCE],
    )


class AsTheyArrive:
    """The filter on states in the order of arrival, without those that were overtaken."""

    def __init__(self) -> None:
        """Begin without any state."""
        self._filter, self._newest = make_filter(go1()), -1.0

    def update(self, state: LowState) -> None:
        """Take a state, unless a newer one was taken before."""
        if state.clock > self._newest:
            self._newest = state.clock
            parts = (state.imu_quat, state.imu_gyro, state.imu_acc, state.joint_pos, state.joint_vel)
            self._filter.update(sample(state.clock, *parts, state.joint_torque, state.foot_force))

    def ahead(self, age: float) -> np.ndarray:
        """Return the velocity (3,), m/s, at the newest state, whatever its age."""
        return np.array(self._filter.velocity_b)


def estimates(states: list[LowState], at: np.ndarray, way: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimate (C, 3), m/s, and the age of the newest state (C,), s, at the cycles ``at`` (C,), s."""
    estimator = AsTheyArrive() if way == WAYS[0] else KalmanEstimator(go1(), lambda *_: None)
    packets, k, newest = PacketDelay(), 0, -1.0
    found, ages = np.empty((len(at), 3)), np.empty(len(at))
    for cycle, now in enumerate(at):
        while k < len(states) and states[k].t <= now:
            state, k = states[k], k + 1
            packets.note(state.t, state.clock)
            if state.clock > newest - OVERTAKEN_S - 1e-9:
                estimator.update(state)
            newest = max(newest, state.clock)
        ages[cycle] = packets.age(now, newest)
        found[cycle] = estimator.ahead(ages[cycle] if way == WAYS[2] else 0.0)
    return found, ages


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, default=data_root() / "assets/policies/paper")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--robots", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print(f"| ground | s | cycles at | jitter, ms | lost | age p50, p99, ms | {' | '.join(WAYS)} |")
    print(f"|---|---|---|---|---|---|{'---|' * len(WAYS)}")
    for ground, recordings in walks(given.run, given.seconds, given.robots, given.seed):
        for rate in (50, 400):
            for jitter, loss in NETWORKS:
                errors: dict[str, list[np.ndarray]] = {name: [] for name in WAYS}
                ages, total = [], 0.0
                for number, r in enumerate(recordings):
                    rows, total = samples(r), total + r.t[-1] - r.t[0]
                    attitude = Rotation.from_quat(r.block(*VECTORS["base_quat"]), scalar_first=True)
                    truth = attitude.inv().apply(r.block(*VECTORS["base_lin_vel"]))
                    at = np.arange(1.0, PERIOD * (len(rows) - 1) - 0.05, 1.0 / rate)
                    true = np.stack([np.interp(at, PERIOD * np.arange(len(rows)), one) for one in truth.T], axis=1)
                    for way in WAYS:
                        states = arrivals(rows, jitter, loss, np.random.default_rng(number))
                        found, age = estimates(states, at, way)
                        errors[way].append(found - true)
                    ages.append(age)
                p50, p99 = 1e3 * np.percentile(np.concatenate(ages), [50, 99])
                cells = " | ".join(
                    f"{np.sqrt((np.concatenate(each) ** 2).sum(axis=1).mean()):.3f}" for each in errors.values()
                )
                about = f"| {ground} | {total:.0f} | {rate} Hz | {1e3 * jitter:g} | {100 * loss:g} % "
                print(f"{about}| {p50:.1f}, {p99:.1f} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
