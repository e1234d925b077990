"""``suite=deploy`` and ``suite=mpc``: timing of the runtime and of ``controller=mpc`` on this machine.

The runtime is ``python -m go1exp.deploy`` in a process of its own, as on the robot's computer, with a network of the
size of training, against the simulated robot in another process. The policy is hardly trained: it stands.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
import timeit
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from go1exp.deploy.export.build import build
from go1exp.deploy.runtime import go1_wire as wire
from go1exp.deploy.runtime.bundle import loads
from go1exp.deploy.runtime.launch import RobotError, SimulatedRobot
from go1exp.deploy.runtime.loop import run as loop
from go1exp.evaluate.bench.env import Measured
from go1exp.evaluate.controller.batch import Driven
from go1exp.evaluate.controller.mpc import Mpc
from go1exp.evaluate.controller.settings import MpcSettings
from go1exp.evaluate.controller.types import Command, Sensed
from go1exp.robot.go1_fields import JOINTS
from go1exp.robot.messages import LowCmd, LowState
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig, parse_train
from go1exp.train import run_folder, trainer

RATE = 400.0
CALLS = 500

LITTLE = {"num_envs": 4, "steps": 4, "minibatches": 2, "epochs": 1, "iterations": 1}
"""Settings of a training that takes a moment."""


def run(container: dict[str, Any], much: Measured) -> dict[str, float]:
    """Measure; return the medians over the rounds by name. ``container`` is a training's configuration."""
    little = container | {"ppo": container["ppo"] | LITTLE}
    results: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory(prefix="go1exp-") as folder:
        place = Path(folder)
        run_folder.write(place / "run", little)
        trainer.train(parse_train(little), little, place / "run")
        data = build(place / "run", seconds=0.5)
        file = place / "walk.zip"
        file.write_bytes(data)
        bundle = loads(data, str(file))
        readings = {port.name: np.zeros((1, port.size), np.float32) for port in bundle.policy.inputs}
        for k in range(much.rounds):
            idle = loop(lambda now: True, RATE, much.seconds)
            jitter = {"idle_missed_400hz": 100.0 * idle.missed_share, "idle_period_p99_ms": 1e3 * idle.period_p99}
            calls = {"policy_us": _median_us(lambda: bundle.policy(readings)), "packets_us": _packets()}
            results.append(_walk(file, much.seconds, place / str(k)) | calls | jitter)
            much.on_round(k + 1, much.rounds)
    return {name: float(np.median([one[name] for one in results])) for name in results[0]}


def _packets() -> float:
    """Return the time to pack, check and unpack a command and a state, both ends together, us: the median."""
    rng = np.random.default_rng(0)
    command = LowCmd(rng.normal(size=JOINTS), np.full(JOINTS, 20.0), np.full(JOINTS, 0.5))
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    q, qd, torque = (rng.normal(size=JOINTS) for _ in range(3))
    state = LowState(0.0, q, qd, torque, quat, np.zeros(3), np.zeros(3), np.full(4, 30.0))
    health, rpy = wire.Health(), np.zeros(3)
    packet = wire.pack_state(state, 2, health, rpy)

    def both_ends() -> None:
        wire.unpack_command(wire.pack_command(command))
        wire.pack_state(state, 2, health, rpy)
        if wire.state_refusal(packet) is None:
            wire.tick_of(packet)
            wire.unpack_state(packet, 0.0, 0.0)

    return _median_us(both_ends)


def _median_us(work: Callable[[], object]) -> float:
    return 1e6 * float(np.median(timeit.repeat(work, number=1, repeat=CALLS)))


def _walk(file: Path, seconds: float, out: Path) -> dict[str, float]:
    times = ["--rate", str(RATE), "--seconds", str(seconds), "--stand-up", "0.2", "--brake", "0.1", "--stale", "5"]
    with SimulatedRobot(str(file), {}, {}) as robot:
        done = subprocess.run(
            [sys.executable, "-m", "go1exp.deploy", str(file), *times, "--robot", str(robot.port), "--out", str(out)],
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
        )
    if done.returncode:
        raise RobotError(f"python -m go1exp.deploy: {done.stderr.strip() or done.stdout.strip().splitlines()[-1]}")
    account = json.loads(next(out.glob("*.json")).read_text())
    timing = account["timing"]
    with np.load(next(out.glob("*.npz"))) as cycles:
        took = 1e3 * (cycles["sent_at"] - cycles["t"])
    p50, p99 = np.nanpercentile(took, [50, 99])
    return {
        "command_p50_ms": float(p50),
        "command_p99_ms": float(p99),
        "cycle_p50_ms": 1e3 * timing["work_p50"],
        "cycle_p99_ms": 1e3 * timing["work_p99"],
        "missed_400hz": 100.0 * timing["missed_share"],
        "period_p99_ms": 1e3 * timing["period_p99"],
        "start_s": account["first_command_after_s"],
        "memory_mb": account["memory_mb"],
    }


COMMANDS = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 1.0))
"""Commands of the robots, one each: x, y in m/s, yaw rate in rad/s."""


class _Timed:
    def __init__(self, inner: Mpc, times: list[float]) -> None:
        self.inner, self.period, self._times = inner, inner.period, times

    def reset(self) -> None:
        """Forget everything."""
        self.inner.reset()

    def step(self, command: Command, sensed: Sensed) -> LowCmd:
        """Act, and note the time that it took."""
        start = time.perf_counter()
        drive = self.inner.step(command, sensed)
        self._times.append(time.perf_counter() - start)
        return drive


def run_mpc(task: TaskConfig, settings: MpcSettings, much: Measured) -> dict[str, float]:
    """Walk the seconds of simulated time in each round; return medians over the rounds of percentiles, ms."""
    task = dataclasses.replace(task, rand=(), event=())
    results = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for k in range(much.rounds):
            times: list[float] = []
            core = Go1Core(task, len(COMMANDS), k, noise=False, imu=True)
            driven = Driven(core, lambda times=times: _Timed(Mpc(settings), times), noise=True, seed=k)  # type: ignore[misc]
            observation = core.reset()
            for _ in range(max(round(much.seconds / core.task.sim.policy_dt), 1)):
                core.command.value.copy_(torch.tensor(COMMANDS))
                observation = core.step(driven(observation)).observation
            results.append(1e3 * np.percentile(times, [50, 99]))
            much.on_round(k + 1, much.rounds)
    finally:
        torch.set_num_threads(threads)
    p50, p99 = np.median(results, axis=0)
    return {"mpc_p50_ms": float(p50), "mpc_p99_ms": float(p99)}
