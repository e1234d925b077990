"""The whole chain: train, export, check, deploy against the simulated robot, read the log, replay it."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from go1exp import cli
from go1exp.base.paths import data_root
from go1exp.config.compose import compose
from go1exp.gap.result import GapSettings
from go1exp.gap.robots.go1 import suspended
from go1exp.gap.stages.replay import Part, replay
from go1exp.logs import recording
from go1exp.logs.recording import Recording, joint_channels
from go1exp.sim.task import parse_parts
from tests.lockstep import lockstep
from tests.small_run import small

STEP = 0.002
"""Training's and the robot's, s."""

WALKING = (
    *small("start_from=paper", hidden="[512,256,128]", coarse_physics=1),
    *("ppo.learning_rate=1e-6", "ppo.learning_rate_range=[1e-6,1e-6]"),
)
"""Two iterations from the weights of a policy that walks."""

TORQUE, SPEED, ANGLE = 0.05, 0.25, 0.006
"""Bounds on the RMSE of a log of the simulator in the simulator, N m, rad/s, rad."""


@pytest.fixture
def verb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Run ``go1exp`` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(data_root()))

    def run(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["go1exp", *words])
        return cli.main()

    return run


def replayed(log: Recording, shift: int) -> Part:
    """Replay a log whose commands are ``shift`` samples late."""
    names = joint_channels("q_target", log.meta.joints)
    channels = {n: np.roll(v, shift) if n in names else v for n, v in log.channels.items()}
    moved = dataclasses.replace(log, channels={name: values[1:-1] for name, values in channels.items()})
    machine = suspended(parse_parts(compose("gap", ["logs=x"]), ("robot",))[0]["robot"])
    (part,) = replay([moved], machine, GapSettings(threads=1), STEP).parts
    return part


@pytest.mark.parametrize(
    "real_time",
    [False, pytest.param(True, marks=pytest.mark.slow("go1exp/deploy/", "go1exp/gap/stages/replay.py"))],
    ids=["in lock-step", "in real time"],
)
def test_from_training_to_the_replayed_log(
    real_time: bool, verb: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert verb("train", *WALKING, "hydra.run.dir=run") == 0
    assert verb("export", "run=run", "out=walk.zip", "seconds=0.2") == 0
    assert verb("export", "check", "walk.zip") == 0
    words = ["command=[0.4,0,0]", "seconds=2", "stand_up=0.5", "lie_down=1.5", "brake=0.5", "stale=5"]
    robot = ["sim.start=lying", "sim.noise=0.1", "truth=true"]
    with nullcontext() if real_time else lockstep():
        assert verb("deploy", "walk.zip", *words, *robot, "out=logs") == 0
    (kept,) = (tmp_path / "logs").glob("*.parquet")
    account = json.loads(kept.with_suffix(".json").read_text())
    assert account["ended"] == "walked to the end"
    assert list(account["phases"]) == ["waiting", "standing_up", "handing_over", "walking", "lying_down", "damping"]
    log = recording.read(kept)
    height = log.block("base_pos_z_w")[:, 0]
    assert height[0] > 0.22  # it has stood up with other gains
    assert height[-1] < 0.12

    capsys.readouterr()
    assert verb("gap", "replay", f"logs={kept}", "search.threads=1", "out=replay") == 0
    assert "times the floor (1 is right)" in capsys.readouterr().out
    (part,) = json.loads((tmp_path / "replay/replay.json").read_text())["parts"]
    assert len(part["windows"]) > 5
    assert {"q_FR_hip", "tau_est_RL_calf", "imu_acc_z", "yaw", "base_lin_vel_x_b"} <= set(part["rmse"])
    with np.load(tmp_path / "replay/replay.npz") as curves:
        off = np.where(curves["valid"][..., None], curves["simulated"] - curves["measured"], 0.0)
        rms = np.sqrt(np.mean(np.sum(off**2, axis=1) / curves["valid"].sum(1)[:, None], axis=0))
        assert dict(zip(curves["channels"].tolist(), rms.tolist(), strict=True)) == pytest.approx(part["rmse"])

    found = {
        q: np.sqrt(np.mean([v**2 for c, v in part["rmse"].items() if c in joint_channels(q, log.meta.joints)]))
        for q in ("q", "qd", "tau_est")
    }
    assert found["tau_est"] < TORQUE
    assert found["qd"] < SPEED
    assert found["q"] < ANGLE
    assert part["times_floor"] < 1.5
    for late in (-1, 1):
        assert replayed(log, late).quantity("tau_est") > 4.0 * found["tau_est"]  # nine times
