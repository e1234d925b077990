"""Metrics of a training: gait, contact, ends of episodes and tracking, on steps made by hand."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from go1exp.extend.testing.snapshots import random_snapshot
from go1exp.mdp.feet import Feet
from go1exp.mdp.types import Snapshot
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.metrics import KINDS, GaitLog, TaskLog
from go1exp.train import checkpoint
from go1exp.train.checkpoint import DamagedCheckpoint
from go1exp.train.group import Group

DT, SUBSTEPS = 0.02, 10
TROT, PRONK, HOP = (0.0, 0.5, 0.5, 0.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.11, 0.71, 0.05)


def walk(
    phase: tuple[float, ...], rate: float = 2.0, command: float = 1.0, seconds: float = 5.0, bounce: float = 0.0
) -> GaitLog:
    """The log of two robots whose feet land at ``phase`` cycles after FR with 1 m/s and 200 N.

    ``bounce`` cycles after touchdown and before liftoff they come off the ground for as long.
    """
    log, feet = GaitLog(2, DT, torch.device("cpu")), Feet(2, 0.002, torch.device("cpu"))
    plain = random_snapshot(2)
    still = {"command": torch.tensor([[command, 0.0, 0.0]] * 2), "foot_vel_w": torch.zeros(2, 4, 3)}
    still |= {"base_ang_vel_b": torch.zeros(2, 3), "joint_vel": torch.zeros(2, 12)}
    velocity = torch.zeros(2, 4, 3)
    velocity[..., 2] = -1.0
    offset = torch.tensor(phase)
    for step in range(round(seconds / DT)):
        feet.begin_step()
        for k in range(SUBSTEPS):
            turn = (rate * (step * DT + 0.002 * k) - offset + 1e-6) % 1.0
            force = torch.zeros(2, 4, 3)
            force[..., 2] = torch.where(turn < 0.003, 200.0, torch.where(turn < 0.5, 50.0, 0.0))
            off = ((turn > bounce) & (turn < 2 * bounce)) | ((turn > 0.5 - 2 * bounce) & (turn < 0.5 - bounce))
            force[..., 2][:, off] = 0.0
            feet.update(force, velocity)
        now = {"foot_force": force.norm(dim=-1), **still, **feet.snapshot_fields()}
        log.add(dataclasses.replace(plain, **now))
    return log


@pytest.mark.parametrize(("phase", "error"), [(TROT, 0.0), (PRONK, 0.5), (HOP, 0.39)])
def test_a_gait_made_by_hand_has_its_rate_duty_and_error_to_a_trot(phase: tuple[float, ...], error: float) -> None:
    figures = walk(phase).drain()
    assert figures["gait/stride_rate"] == pytest.approx(2.0, rel=0.11)
    assert figures["gait/trot_error"] == pytest.approx(error, abs=0.01)
    assert figures["gait/duty_mean"] == pytest.approx(0.5, abs=0.03)
    assert 0.15 < figures["gait/load_share_min"] <= 0.25  # the blows are as long as a sample
    assert figures["contact/peak_force"] == pytest.approx(200.0, rel=0.03)  # the first stance has no blow
    assert figures["contact/touchdown_speed"] == pytest.approx(1.0)
    assert figures["contact/largest_force"] == 200.0
    assert figures["contact/slip_share"] == 0.0


def test_bounces_are_no_touchdowns() -> None:
    figures = walk(TROT, bounce=0.03).drain()
    assert figures["gait/stride_rate"] == pytest.approx(2.0, rel=0.11)
    assert figures["gait/trot_error"] < 0.05  # of an instant that is known to a bounce and a policy step


def test_trembling_shows_as_a_stride_rate() -> None:
    assert walk(TROT, rate=12.5).drain()["gait/stride_rate"] == pytest.approx(12.5, rel=0.05)


def test_a_robot_told_to_stand_has_no_gait_but_contacts() -> None:
    figures = walk(TROT, command=0.0).drain()
    assert all(math.isnan(v) for k, v in figures.items() if k.startswith("gait/"))
    assert figures["contact/touchdown_speed"] == pytest.approx(1.0)


def test_a_drained_log_begins_anew() -> None:
    log = walk(TROT)
    log.drain()
    assert all(v == 0.0 or math.isnan(v) for v in log.drain().values())


def test_a_reset_forgets_the_stride_of_its_rows() -> None:
    log = walk(TROT)
    log.reset(torch.tensor([True, False]))
    assert torch.isinf(log.since).tolist() == [True, False]
    assert (log.period > 0).tolist() == [False, True]


def test_a_slipping_foot_and_a_blow_are_seen(make_core: Callable[..., Go1Core], tmp_path: Path) -> None:
    s: Snapshot = random_snapshot(3)
    log = GaitLog(3, DT, torch.device("cpu"))
    log.add(dataclasses.replace(s, foot_vel_w=torch.ones(3, 4, 3), foot_peak_force=s.foot_peak_force * 1000.0))
    figures = log.drain()
    assert figures["contact/slip_share"] == 1.0
    assert figures["contact/largest_force"] > 1e5


def test_a_checkpoint_of_before_is_refused_in_a_line(make_core: Callable[..., Go1Core]) -> None:
    core = make_core(num_envs=1)
    state = core.state_dict()
    del state["gait_log"]
    learner: Any = SimpleNamespace(group=Group(), core=core)
    with pytest.raises(DamagedCheckpoint, match="of another version of go1exp: it has no 'gait_log'"):
        checkpoint.restore(learner, {"env": state})


def test_the_environment_logs_the_same_figures_after_a_pause(make_core: Callable[..., Go1Core]) -> None:
    overrides = ("rand=table1", "sim.episode_s=0.4", "command.hold_time=[0.06,0.4]", "contact=soft", "actuator=pd")
    straight, first, second = (make_core(*overrides, num_envs=4) for _ in range(3))
    action = 3.0 * torch.randn(30, 4, 12, generator=torch.Generator().manual_seed(0))
    for core in (straight, first):
        core.reset()
    for k in range(30):
        straight.step(action[k])
        if k == 15:
            second.load_state_dict(first.state_dict())
        (first if k < 15 else second).step(action[k])
    mine, theirs = straight.drain_metrics(30), second.drain_metrics(30)
    assert mine == pytest.approx(theirs, rel=0.0, abs=0.0, nan_ok=True)
    assert {k.split("/")[0] for k in mine} >= {"gait", "contact"}
    assert 0.0 < mine["gait/trot_error"] < 0.5
    assert mine["contact/largest_force"] > 50.0


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


def test_the_environment_counts_falls_and_time_outs(
    start_core: Callable[..., Go1Core], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the fifth step one robot leaves the map and one falls; episodes have ten steps."""
    core = start_core("sim.episode_s=0.2", "termination=none", num_envs=3)
    steps = [0]

    def only(robot: int) -> Callable[..., torch.Tensor]:
        return lambda *about: (torch.arange(3) == robot) & (steps[0] == 5)

    monkeypatch.setattr(core.terms, "cut_short", only(0))
    monkeypatch.setattr(core.terms, "terminated", only(1))
    for steps[0] in range(1, 21):
        core.step(torch.zeros(3, 12))
    got = core.drain_metrics(20)
    assert (got["task/fall_share"], got["task/timeout_share"]) == pytest.approx((1 / 6, 4 / 6))
    assert got["tracking/rmse_x"] > 0.0
