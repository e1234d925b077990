"""What a training logs of gait and contact, on steps made by hand."""

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
from go1exp.sim.env.metrics import GaitLog
from go1exp.train import checkpoint
from go1exp.train.checkpoint import DamagedCheckpoint
from go1exp.train.group import Group

DT, SUBSTEPS = 0.02, 10
TROT, PRONK, HOP = (0.0, 0.5, 0.5, 0.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.11, 0.71, 0.05)


def walk(phase: tuple[float, ...], rate: float = 2.0, command: float = 1.0, seconds: float = 5.0) -> GaitLog:
    """The log of two robots whose feet land at ``phase`` cycles after FR with 1 m/s and 200 N."""
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
    assert s.foot_peak_force is not None
    log.add(dataclasses.replace(s, foot_vel_w=torch.ones(3, 4, 3), foot_peak_force=s.foot_peak_force * 1000.0))
    figures = log.drain()
    assert figures["contact/slip_share"] == 1.0
    assert figures["contact/largest_force"] > 1e5


def test_a_checkpoint_of_before_is_refused_in_a_line(
    make_core: Callable[..., Go1Core], monkeypatch: pytest.MonkeyPatch
) -> None:
    core = make_core(num_envs=1)
    state = core.state_dict()
    del state["gait_log"]
    monkeypatch.setattr(checkpoint, "_core", lambda ppo: core)
    learner: Any = SimpleNamespace(group=Group())
    with pytest.raises(DamagedCheckpoint, match="of another version of go1exp: it has no 'gait_log'"):
        checkpoint.restore(learner, {"env": state})


def test_the_environment_logs_the_same_figures_after_a_pause(make_core: Callable[..., Go1Core]) -> None:
    overrides = ("rand=table1", "sim.episode_s=0.4", "command.hold_time=[0.06,0.4]")
    straight, first, second = (make_core(*overrides, num_envs=4) for _ in range(3))
    action = torch.as_tensor(torch.randn(30, 4, 12, generator=torch.Generator().manual_seed(0)))
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
