"""Training shared out over several processes is the training of one."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.testing import assert_close

from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.sb3_env import Go1VecEnv
from go1exp.sim.task import TrainConfig, parse_train
from go1exp.train import checkpoint, preflight, run_folder, trainer
from go1exp.train.device import DevicePPO
from go1exp.train.group import Group, joined
from go1exp.train.schedule import Schedule

SMALL = (
    *("ppo=paper", "ppo.num_envs=128", "ppo.steps=4", "ppo.hidden=[16,8]", "ppo.minibatches=2", "ppo.epochs=2"),
    *("actuator=delay", "actuator.command=[0.0,0.02]", "effect=[strength,encoder_offset]", "event=push"),
    *("terrain=rough", "terrain.rows=4", "terrain.cols=3", "curriculum=terrain_level"),
    *("curriculum.terrain_level.start_level_max=3", "observation=clock"),
    *("rand=table1", "sim.episode_s=0.2", "ppo.symmetry=true", "critic=privileged", "ppo.iterations=2"),
    *("backend.threads=1", "torch_threads=1", "logger=local", "schedule=none"),
)


def settings(*overrides: str) -> tuple[TrainConfig, dict[str, Any]]:
    container = compose("train", (*SMALL, *overrides))
    return parse_train(container), container


def alone(config: TrainConfig) -> DevicePPO:
    changing = {ramp.path for ramp in config.schedule.values()}
    core = Go1Core(config.task, config.ppo.num_envs, 0, spread_starts=True, critic=True, changing=changing)
    ppo = DevicePPO(config.ppo, Go1VecEnv(core), 0, "cpu")
    ppo.schedule = Schedule(config.schedule, core, config.ppo.num_envs * config.ppo.steps, config.ppo.iterations)
    ppo.after_iteration = lambda ppo: ppo.schedule.advance(ppo.num_timesteps, {})
    return ppo


@pytest.fixture
def shared(tmp_path: Path) -> Callable[..., tuple[trainer.AdaptivePPO, Path]]:
    """Train in two processes of which each has half of the robots."""

    def train(*overrides: str) -> tuple[trainer.AdaptivePPO, Path]:
        config, container = settings("devices=2", *overrides)
        run_folder.write(tmp_path, container)
        return trainer.train(config, container, tmp_path), tmp_path

    return train


@pytest.mark.slow("go1exp/train/")
def test_two_members_train_as_one_learner_would_and_its_checkpoint_is_one_learners(
    shared: Callable[..., tuple[trainer.AdaptivePPO, Path]],
) -> None:
    ramp = "+schedule.x={set: reward.joint_velocity.weight, from: -0.015, to: -1.0, over: 512}"
    ppo, run = shared(ramp)
    config, _ = settings(ramp)
    one = alone(config)
    one.learn(2 * 128 * 4)
    for (name, mine), theirs in zip(ppo.policy.named_parameters(), one.policy.parameters(), strict=True):
        assert_close(mine, theirs, rtol=1e-3, atol=1e-5, msg=name)
    assert ppo.num_timesteps == one.num_timesteps == 1024
    state, usual = checkpoint.load_latest(run)[0], checkpoint._state(one)
    assert state["last_obs"].shape == usual["last_obs"].shape
    assert_close(state["last_obs"], usual["last_obs"], rtol=1e-2, atol=1e-3)
    assert_close(state["env"]["core"]["steps"], usual["env"]["core"]["steps"])
    checkpoint.restore(alone(config), state)  # goes on with one GPU
    ppo, _ = shared(ramp, "ppo.iterations=3")  # and with two, from the checkpoint
    assert ppo.iteration == 3


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs")
def test_two_gpus_train_as_one_does(tmp_path: Path) -> None:
    """Where it hangs, ``PYTHONFAULTHANDLER=1`` and ``NCCL_DEBUG=INFO`` say where."""
    task = (
        "backend=warp",
        "observation=clock",
        "ppo.num_envs=512",
        "ppo.iterations=3",
        "ppo.minibatches=4",
        "logger=local",
    )
    for devices in (1, 2):
        run = [sys.executable, "-m", "go1exp", "train", *task, f"devices={devices}"]
        subprocess.run([*run, f"hydra.run.dir={tmp_path / str(devices)}"], timeout=240, check=True)
    one, two = (checkpoint.load_latest(tmp_path / str(devices))[0] for devices in (1, 2))
    for name, value in one["policy"].items():
        assert_close(two["policy"][name], value, rtol=1e-2, atol=1e-3, msg=name)
    assert one["last_obs"].shape == two["last_obs"].shape


def test_a_state_is_joined_and_taken_apart_by_robots() -> None:
    def state(value: float) -> dict[str, Any]:
        return {"x": torch.full((64, 2), value), "list": [torch.full((3, 64), value), 7], "all": torch.ones(5)}

    states = [state(1.0), state(2.0)]
    whole = joined(states, 64)
    assert whole["x"].shape == (128, 2)
    assert whole["all"].shape == (5,)
    for rank, mine in enumerate(states):
        part = Group(rank, 2).part(whole, 64)
        assert_close(part["x"], mine["x"])
        assert_close(part["list"][0], mine["list"][0])
        assert part["list"][1] == 7


@pytest.mark.slow("go1exp/train/group.py")
def test_a_member_that_fails_ends_the_training_with_a_line(tmp_path: Path) -> None:
    code = (
        "from pathlib import Path; from go1exp.train.group import together\n"
        f"with together(2, int, {{}}, Path({str(tmp_path)!r}), 'gloo') as group:\n"
        "    group.agreed(1)\n"
        "    group.agreed(2)\n"
    )
    script = tmp_path / "script.py"
    script.write_text("if __name__ == '__main__':\n    " + code.replace("\n", "\n    "))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "GPU 1 of 2: TypeError" in done.stderr
    assert "a process of another GPU ended early" in done.stderr


def test_one_member_exchanges_nothing() -> None:
    group, state = Group(), {"x": torch.ones(3)}
    assert group.whole(state, 3) is state
    assert group.part(state, 3) is state
    assert group.agreed("this") == "this"
    assert group.metrics({"a": 1.0}) == {"a": 1.0}


@pytest.mark.parametrize(
    ("overrides", "what"),
    [
        (("devices=2",), "devices = 2: needs backend=warp"),
        (("devices=3", "ppo.num_envs=256"), "devices = 3: ppo.num_envs = 256 must be 64 or more for each"),
        (("devices=2", "ppo.num_envs=66"), "devices = 2: ppo.num_envs = 66 must be 64 or more for each"),
        (("devices=4", "ppo.num_envs=256", "ppo.minibatches=512"), "a minibatch (256 x 4 / 512) must be a multiple"),
    ],
)
def test_a_training_that_cannot_be_shared_out_is_refused(overrides: tuple[str, ...], what: str) -> None:
    config, _ = settings(*overrides)
    with pytest.raises(ConfigError) as refusal:
        preflight.check_shares(config)
    assert any(what in problem for problem in refusal.value.problems)


def test_a_devices_key_of_one_asks_for_nothing() -> None:
    config, _ = settings()
    assert dataclasses.replace(config.process, devices=1) == config.process
    preflight.check_shares(config)
