"""``suite=mpc``: time of one tick of ``controller=mpc`` on one core, on a walk with the sensors' noise."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np
import torch

from go1exp.evaluate.controller.batch import Driven
from go1exp.evaluate.controller.mpc import Mpc
from go1exp.evaluate.controller.settings import MpcSettings
from go1exp.evaluate.controller.types import Command, Sensed
from go1exp.robot.messages import LowCmd
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig

COMMANDS = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 1.0))
"""Commands of the robots, one each: x, y in m/s, yaw rate in rad/s."""


class _Timed:
    """A controller whose calls are timed."""

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


def run(
    task: TaskConfig, settings: MpcSettings, rounds: int, seconds: float, on_round: Callable[[int, int], None]
) -> dict[str, float]:
    """Walk ``seconds`` of simulated time in each round; return medians over the rounds of percentiles, ms."""
    task = dataclasses.replace(task, rand=(), event=())
    results = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for k in range(rounds):
            times: list[float] = []
            core = Go1Core(task, len(COMMANDS), k, noise=False, imu=True)
            driven = Driven(core, lambda times=times: _Timed(Mpc(settings), times), noise=True, seed=k)  # type: ignore[misc]
            observation = core.reset()
            for _ in range(max(round(seconds / core.task.sim.policy_dt), 1)):
                core.command.value.copy_(torch.tensor(COMMANDS))
                observation = core.step(driven(observation)).observation
            results.append(1e3 * np.percentile(times, [50, 99]))
            on_round(k + 1, rounds)
    finally:
        torch.set_num_threads(threads)
    p50, p99 = np.median(results, axis=0)
    return {"mpc_p50_ms": float(p50), "mpc_p99_ms": float(p99)}
