"""What a training logs of how episodes end and how commands are followed, on steps made by hand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch

from go1exp.extend.testing.snapshots import random_snapshot
from go1exp.mdp.types import Snapshot
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.metrics import KINDS, TaskLog

COMMANDS = [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.6, 0.8, 0.0], [2.0, 0.0, 0.0]]
"""One of each kind: stand, slow (turning), medium (1 m/s), fast."""


def step(log: TaskLog, fell: int | None = None, timeout: int | None = None, cut: int | None = None) -> None:
    """Add a step of four robots that stand still; one each may end its episode."""
    still = {
        "command": torch.tensor(COMMANDS),
        "base_lin_vel_b": torch.zeros(4, 3),
        "base_ang_vel_b": torch.zeros(4, 3),
    }
    s: Snapshot = dataclasses.replace(random_snapshot(4), **still)
    ends = tuple(torch.arange(4) == (-1 if k is None else k) for k in (fell, timeout, cut))
    log.add(s, (ends[0], ends[1], ends[2]), (torch.tensor([1.0, 2.0, 3.0, 4.0]), torch.tensor([10, 20, 30, 40])))


def test_ends_of_episodes_and_errors_are_those_of_a_count_by_hand() -> None:
    log = TaskLog(0.02, torch.device("cpu"))
    step(log, fell=3)
    step(log, fell=3, timeout=0, cut=2)
    got = log.drain()
    assert got["task/fall_share"] == 0.5
    assert got["task/timeout_share"] == 0.25
    assert got["task/falls_per_minute"] == pytest.approx(2 / (8 * 0.02 / 60))
    assert got["tracking/rmse_x"] == pytest.approx(math.sqrt((0.36 + 4.0) / 4))
    assert got["tracking/rmse_y"] == pytest.approx(0.4)
    assert got["tracking/rmse_yaw"] == pytest.approx(0.5)
    returns = [got[f"command_{kind}/return"] for kind in KINDS]
    assert [returns[0], *returns[2:]] == [1.0, 3.0, 4.0]
    assert math.isnan(returns[1])
    assert (got["command_stand/length"], got["command_fast/length"]) == (10.0, 40.0)
    assert [got[f"command_{kind}/rmse_xy"] for kind in KINDS] == pytest.approx([0.0, 0.0, 1.0, 2.0])


def test_a_drained_log_begins_anew_with_the_same_names() -> None:
    log = TaskLog(0.02, torch.device("cpu"))
    step(log, fell=0)
    names = list(log.drain())
    again = log.drain()
    assert list(again) == names
    assert all(math.isnan(v) for v in again.values())


def test_the_environment_counts_falls_and_time_outs(make_core: Callable[..., Go1Core]) -> None:
    core = make_core("sim.episode_s=0.2", "termination=none", num_envs=3)
    core.reset()
    for _ in range(20):
        result = core.step(torch.zeros(3, 12))
    assert bool(result.truncated.all())
    got = core.drain_metrics(20)
    assert (got["task/fall_share"], got["task/timeout_share"]) == (0.0, 1.0)
    assert got["tracking/rmse_x"] > 0.0
