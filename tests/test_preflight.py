"""What this machine cannot run is refused in a line, before a run folder says that a run began."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from pathlib import Path

import pytest
import torch

import go1exp
from go1exp.base import memory
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.task import LoggerConfig, TrainConfig, WandbConfig, parse_train
from go1exp.train import metrics, preflight

CPU = torch.device("cpu")


def config(*overrides: str) -> TrainConfig:
    return parse_train(compose("train", overrides))


# ---------------------------------------------------------------------- devices


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["device=cuda"], "device = 'cuda': torch finds no CUDA device; use device=cpu"),
        (["backend=warp"], "backend.device = 'cuda': torch finds no CUDA device; use backend=cpu"),
    ],
)
def test_a_device_that_is_not_there_is_refused(
    overrides: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    with pytest.raises(ConfigError) as caught:
        preflight.check(config(*overrides))
    assert caught.value.problems == [message]


def test_the_second_of_one_device_and_an_engine_that_is_not_installed_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError) as caught:
        preflight.check_devices(config("backend=warp", "device=cuda:1"))
    engine, device = caught.value.problems
    assert "pip install 'go1exp[gpu]'" in engine
    assert device == "device = 'cuda:1': torch finds 1 CUDA devices, numbered from 0"


def test_videos_without_their_writer_are_refused_before_a_training(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    preflight.check(config())  # has no videos
    with pytest.raises(ConfigError, match=r"video.every = 5: .* pip install 'go1exp\[video\]'"):
        preflight.check(config("video.every=5"))


# ---------------------------------------------------------------------- memory


def test_what_a_training_takes_grows_with_all_that_it_holds() -> None:
    base = preflight.needed_bytes(config("ppo.num_envs=4096"))
    assert 25e6 < base < 1e9
    for bigger in ("ppo.num_envs=8192", "ppo.steps=1000", "ppo.hidden=[4096,4096]"):
        overrides = ["ppo.num_envs=4096", bigger] if "num_envs" not in bigger else [bigger]
        assert preflight.needed_bytes(config(*overrides)) > base
    assert preflight.needed_bytes(config("ppo.num_envs=4096", "backend=warp")) > 4096 * 4 * 18 * 64


def test_what_does_not_fit_is_refused_with_both_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preflight, "free_on", lambda device: 8_000_000_000)
    preflight.check_memory(config("ppo.num_envs=4096"), CPU)
    with pytest.raises(ConfigError, match=r"at least \d+\.\d GB, and 8\.0 GB are free in memory") as caught:
        preflight.check_memory(config("ppo.num_envs=10000000"), CPU)
    assert len(caught.value.problems) == 1


def test_robots_whose_state_does_not_fit_are_refused_with_the_number_that_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measured with 60,000 robots and two steps: 15.9 kB each, 8.0 kB without randomisation, delay and pushes."""
    monkeypatch.setattr(memory, "free", lambda: 1_000_000_000)
    offered = []
    for overrides, measured in (([], 15_900), (["experiment=minute"], 8_000)):
        with pytest.raises(ConfigError, match=r"^num_envs = 1000000: with 1000000 robots it .* would fit$") as caught:
            go1exp.make(overrides, num_envs=10**6)
        offered.append(int(caught.value.problems[0].split("; ")[1].split()[0]))
        assert 1e9 / measured < offered[-1] < 1.2e9 / measured
    assert offered[1] > 1.5 * offered[0]


def group(folder: Path, limit_file: str, limit: str, used: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / limit_file).write_text(f"{limit}\n")
    (folder / "memory.stat").write_text(f"{used} 1000\nfile 777777\n")


@pytest.mark.parametrize(
    ("line", "place", "limit_file", "used"),
    [("0::/job/step", "", "memory.max", "anon"), ("4:cpu,memory:/job/step", "memory", "memory.limit_in_bytes", "rss")],
)
def test_the_limit_of_a_container_or_of_a_job_counts(
    line: str, place: str, limit_file: str, used: str, tmp_path: Path
) -> None:
    (tmp_path / "cgroup").write_text(f"7:pids:/elsewhere\n{line}\n")
    group(tmp_path / place / "job", limit_file, "50000", used)
    group(tmp_path / place / "job/step", limit_file, "max", used)
    assert memory._of_group(tmp_path / "cgroup", tmp_path) == 49000
    group(tmp_path / place / "job/step", limit_file, "20000", used)
    assert memory._of_group(tmp_path / "cgroup", tmp_path) == 19000
    assert memory._of_group(tmp_path / "nothing", tmp_path) is None


def test_a_length_that_does_not_fit_is_told_with_what_it_takes_and_what_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "free", lambda: 8_000_000_000)
    assert memory.too_long(8000.0, 1e6) is None
    words = "takes at least 1000.0 GB, and 8.0 GB are free in memory; 8000 s at most would fit"
    assert memory.too_long(1e6, 1e6) == words
    assert "takes at least inf GB" in str(memory.too_long(1e308, 1e6))
    monkeypatch.setattr(memory, "free", lambda: None)
    assert memory.too_long(1e9, 1e6) is None


# ---------------------------------------------------------------------- accounts


def test_online_logging_without_a_key_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE"):
        monkeypatch.delenv(name, raising=False)
    for name in ("HOME", "WANDB_CONFIG_DIR", "WANDB_CACHE_DIR", "WANDB_DATA_DIR"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    account = WandbConfig(project="go1exp-tests", mode="online", group=None, entity=None)
    with pytest.raises(ConfigError, match="there is no API key; set WANDB_API_KEY") as caught:
        metrics.check_account(LoggerConfig(csv=True, tensorboard=False, wandb=account))
    assert len(caught.value.problems) == 1


# ---------------------------------------------------------------------- curriculum


TINY = "command.lin_vel_x=[-0.01,0.01] command.lin_vel_y=[0,0] command.ang_vel_z=[-0.02,0.02]"
SLOW = "command.lin_vel_x=[0,0] command.lin_vel_y=[0,0] command.ang_vel_z=[-0.2,0.2]"


@pytest.mark.parametrize(
    "choice",
    ["command.standing_fraction=1.0", "command.zero_fraction=1.0", "terrain.rows=1", TINY],
)
def test_a_curriculum_that_promotes_no_robot_is_warned_of(choice: str) -> None:
    rough = ("terrain=rough", "curriculum=terrain_level", "curriculum.terrain_level.start_level_max=0")
    with pytest.warns(UserWarning, match=r"^curriculum\.terrain_level: promotes no robot; "):
        preflight.warn_of_idle_curriculum(config(*rough, *choice.split()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        preflight.warn_of_idle_curriculum(config(*rough))
        preflight.warn_of_idle_curriculum(config(*rough, *SLOW.split()))
        preflight.warn_of_idle_curriculum(config("terrain=rough", *choice.split()))


def test_a_ground_that_does_not_fit_is_refused_by_its_own_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "free", lambda: 8_000_000_000)
    preflight.check_memory(config("terrain=rough", "terrain.rows=2000"), CPU)
    with pytest.raises(ConfigError, match=r"^terrain\.rows = 100000, cols = 20: 13,\S+ samples .* 8\.0 GB are free"):
        preflight.check_memory(config("terrain=rough", "terrain.rows=100000"), CPU)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ("terrain=steps terrain.gaps_proportion=0.02", r"^terrain\.cols = 20: too few for the shares of gaps$"),
        ("terrain=rough terrain.cols=2", "shares of ramp_up, ramp_down, flat$"),
        (
            "terrain=steps terrain.stair_tread=30",
            "^terrain: tiles of stairs_up, stairs_down are flat, also in the last of 10 rows$",
        ),
        (
            "terrain=rough terrain.rows=1",
            "^terrain: tiles of boxes, bumps, ramp_up, ramp_down are flat, also in the last of 1 rows$",
        ),
    ],
)
def test_ground_that_is_asked_for_and_missing_is_warned_of(overrides: str, said: str) -> None:
    with pytest.warns(UserWarning, match=said):
        preflight.check(config(*overrides.split()))


@pytest.mark.parametrize(
    "choice", ["terrain=flat", "terrain=rough", "terrain=steps", "experiment=rough", "experiment=rough_climb"]
)
def test_the_grounds_of_conf_have_all_that_they_name(choice: str) -> None:
    preflight.warn_of_lost_ground(config(choice).task.terrain)
