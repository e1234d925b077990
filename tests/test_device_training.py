"""Training on the device: the same numbers as SB3's own buffer and loop, and what it owes when something goes wrong."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer

from go1exp.config.compose import compose
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.faults import NumericalFault
from go1exp.sim.env.sb3_env import Go1VecEnv
from go1exp.sim.task import parse_train
from go1exp.train import checkpoint
from go1exp.train.device import DevicePPO
from go1exp.train.device_update import DeviceUpdate
from go1exp.train.ppo import AdaptivePPO, linear_rate

SMALL = (
    *("ppo=paper", "ppo.num_envs=8", "ppo.steps=6", "ppo.hidden=[16,8]", "sim.episode_s=0.2"),
    *("backend.threads=1", "torch_threads=1", "logger=local", "actuator=pd", "contact=soft"),
)


def learner(kind: type[AdaptivePPO] = DevicePPO, *overrides: str) -> Any:
    """Build a learner of a class on a new environment, all on the CPU: the law is that of the GPU."""
    config = parse_train(compose("train", (*SMALL, *overrides)))
    core = Go1Core(config.task, config.ppo.num_envs, 0, spread_starts=True)
    ppo: Any = kind(config.ppo, Go1VecEnv(core), 0, "cpu")
    ppo.log = []
    ppo.after_iteration = lambda p: p.log.append(dict(p.logger.name_to_value))
    torch.manual_seed(1)
    return ppo


def test_advantages_and_returns_on_the_cpu_are_those_of_sb3() -> None:
    ppo = learner(AdaptivePPO)
    env = ppo.get_env()
    assert env is not None
    _, callback = ppo._setup_learn(48, None)
    callback.on_training_start({}, {})
    for _ in range(2):  # episodes of 10 steps end in the second rollout of 6
        ppo.collect_rollouts(env, callback, ppo.rollout_buffer, 6)
    ours = ppo.rollout_buffer
    assert ours.episode_starts.any()
    last, ended = torch.randn(8), np.arange(8) % 2 == 0
    ours.compute_returns_and_advantage(last, ended)
    advantages, returns = ours.advantages.copy(), ours.returns.copy()
    RolloutBuffer.compute_returns_and_advantage(ours, last, ended)
    np.testing.assert_allclose(advantages, ours.advantages, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(returns, ours.returns, rtol=1e-6, atol=1e-6)


def test_a_rollout_holds_what_sb3s_own_loop_collects() -> None:
    """Same seed, same first rollout: observations, actions, rewards with the value beyond a time limit, episodes."""
    mine, theirs = (learner(kind, "termination={tilt: {max_angle: 0.03}}") for kind in (DevicePPO, AdaptivePPO))
    for ppo in (mine, theirs):
        ppo.train = lambda: None
        torch.manual_seed(1)
        ppo.learn(48)
    data = mine.rollout_buffer.data
    assert data["starts"][1:].any()
    assert 0.0 < mine.core.drain_metrics(6)["task/fall_share"] < 1.0  # both ends
    for name in ("observations", "actions", "rewards", "values", "log_probs", "advantages", "returns", "means"):
        wanted = getattr(theirs.rollout_buffer, name)
        np.testing.assert_allclose(data[name].numpy(), wanted, rtol=1e-5, atol=1e-5, err_msg=name)
    np.testing.assert_array_equal(data["starts"].numpy(), theirs.rollout_buffer.episode_starts)
    assert [e["l"] for e in mine.ep_info_buffer] == [e["l"] for e in theirs.ep_info_buffer]
    assert [e["r"] for e in mine.ep_info_buffer] == pytest.approx([e["r"] for e in theirs.ep_info_buffer], rel=1e-5)
    np.testing.assert_array_equal(mine._last_obs, theirs._last_obs)


def test_minibatches_hold_every_sample_once() -> None:
    ppo = learner()
    ppo.learn(48)
    wanted = ppo.rollout_buffer.data["log_probs"].flatten().sort().values
    got = torch.cat([batch.old_log_prob for batch in ppo.rollout_buffer.get(12)])
    assert torch.equal(got.sort().values, wanted)


def through_sb3(ppo: AdaptivePPO) -> None:
    """An update by SB3's own loop and loss, which is steered as ``AdaptivePPO`` is."""
    ppo._old_log_std, ppo._kl = ppo.policy.log_std.detach().clone(), []
    if ppo.config.schedule == "linear":
        ppo.policy.optimizer.param_groups[0]["lr"] = linear_rate(ppo.config, ppo.iteration)
    if ppo.mirror is not None:
        minibatches, joined = type(ppo.rollout_buffer).get, ppo.mirror.joined
        ppo.rollout_buffer.get = lambda size: map(joined, minibatches(ppo.rollout_buffer, size))  # type: ignore
    steered = ppo.policy.optimizer.register_step_pre_hook(lambda *_: ppo._steer(float(ppo._divergence())))
    PPO.train(ppo)
    steered.remove()
    ppo._close_iteration()


class Sb3Update(AdaptivePPO):
    train = through_sb3


class Sb3UpdateOnDevice(DevicePPO):
    """The buffer of the device, and SB3's own update."""

    train = through_sb3
    _check_gradient = AdaptivePPO._check_gradient

    def collect_rollouts(self, *arguments: Any, **named: Any) -> bool:
        going = super().collect_rollouts(*arguments, **named)
        data = self.rollout_buffer.data
        self.rollout_buffer.values, self.rollout_buffer.returns = data["values"].numpy(), data["returns"].numpy()
        return going


@pytest.mark.parametrize(("ours", "sb3s"), [(DevicePPO, Sb3UpdateOnDevice), (AdaptivePPO, Sb3Update)])
@pytest.mark.parametrize(
    "overrides",
    [
        ("ppo.desired_kl=0.0005",),  # the rate goes up and down
        ("ppo.schedule=linear", "ppo.iterations=5", "ppo.value_clip=0.1", "ppo.max_grad_norm=0.05"),
        ("ppo.schedule=fixed", "ppo.normalize_advantage=false", "ppo.entropy=0.05", "ppo.clip_range=0.02"),
        ("ppo.desired_kl=0.0005", "ppo.symmetry=true"),
    ],
)
def test_an_update_is_sb3s(ours: type[AdaptivePPO], sb3s: type[AdaptivePPO], overrides: tuple[str, ...]) -> None:
    pair = []
    for kind in (ours, sb3s):
        pair.append(learner(kind, "ppo.epochs=3", "ppo.init_std=0.5", *overrides))
        pair[-1].learn(48 * 4)
    mine, theirs = pair
    assert len(mine.log) == len(theirs.log) == 4
    for name, value in theirs.policy.state_dict().items():
        torch.testing.assert_close(mine.policy.state_dict()[name], value, rtol=1e-3, atol=1e-5, msg=name)
    for one, other in zip(mine.log, theirs.log, strict=True):
        assert {k for k in one if k.startswith("train/")} == {k for k in other if k.startswith("train/")}
        for key in one:
            of_images = mine.config.symmetry and key in ("train/clip_fraction", "train/approx_kl")  # in SB3's
            if key.startswith("train/") and not of_images:
                assert one[key] == pytest.approx(other[key], rel=2e-3, abs=2e-5), key
    if mine.config.schedule == "adaptive":
        assert len({log["train/learning_rate"] for log in mine.log}) > 1


@pytest.mark.parametrize("kind", [DevicePPO, AdaptivePPO])
@pytest.mark.parametrize("schedule", ["fixed", "adaptive"])
def test_an_update_ends_before_the_step_at_which_the_policy_has_diverged_too_far(
    kind: type[AdaptivePPO], schedule: str
) -> None:
    overrides = ("ppo.epochs=5", "ppo.init_std=0.5", f"ppo.schedule={schedule}", "ppo.learning_rate=0.0002")
    limited = learner(kind, *overrides, "ppo.max_kl=0.001")
    limited.learn(48)
    steps = int(limited.log[0]["train/gradient_steps"])
    assert 2 <= steps < 5 * 4 - 1  # of five epochs of four minibatches
    assert limited.log[0]["train/kl"] <= 0.001

    stopped = learner(kind, *overrides)
    adam, taken = stopped.policy.optimizer, [0]
    step = adam.step

    def only_as_many() -> None:
        taken[0] += 1
        if taken[0] <= steps:
            step()

    adam.step = only_as_many
    stopped.learn(48)
    assert taken[0] == 20
    for name, value in stopped.policy.state_dict().items():
        assert torch.equal(limited.policy.state_dict()[name], value), name
    for parameter, other in zip(limited.policy.parameters(), stopped.policy.parameters(), strict=True):
        mine, its = limited.policy.optimizer.state[parameter], adam.state[other]
        assert all(torch.equal(mine[key], its[key]) for key in ("step", "exp_avg", "exp_avg_sq"))

    strict = learner(kind, *overrides, "ppo.max_kl=1e-12")
    strict.learn(48)
    assert strict.log[0]["train/gradient_steps"] == 1

    limited.learn(48, reset_num_timesteps=False)  # the next one begins anew
    assert limited.log[1]["train/gradient_steps"] >= 2
    assert len(set(limited._kl)) > 1


def test_training_stopped_and_resumed_is_training_in_one_go(tmp_path: Path) -> None:
    straight = learner()
    straight.learn(48 * 4)
    first = learner()
    first.learn(48 * 2)
    checkpoint.save(first, tmp_path, keep=1)
    second = learner()
    state, _ = checkpoint.load_latest(tmp_path)
    checkpoint.restore(second, state)
    second.learn(48 * 2, reset_num_timesteps=False)
    assert second.iteration == straight.iteration == 4
    for (name, a), b in zip(straight.policy.state_dict().items(), second.policy.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


def test_a_checkpoint_goes_from_one_learner_to_the_other(tmp_path: Path) -> None:
    first, second = learner(), learner(AdaptivePPO)
    first.learn(48)
    checkpoint.save(first, tmp_path, keep=1)
    drawn = random.random()  # by Python's own, which no part of a training draws from
    checkpoint.restore(second, checkpoint.load_latest(tmp_path)[0])
    assert random.random() == drawn
    second.learn(48, reset_num_timesteps=False)
    assert second.iteration == 2
    assert second.num_timesteps == 96


def test_a_gradient_that_is_not_finite_stops_training() -> None:
    ppo = learner()
    ppo.learn(48)
    weight = ppo.policy.action_net.weight
    assert isinstance(weight, torch.Tensor)
    weight.register_hook(lambda gradient: gradient * torch.nan)
    with pytest.raises(NumericalFault, match="gradient of the policy is not finite in iteration 2"):
        ppo.learn(48, reset_num_timesteps=False)


def test_a_fault_in_the_environment_is_found_after_the_rollout_with_its_moment() -> None:
    ppo = learner()
    core = ppo.get_env().core
    core._deferred = True  # as on a GPU
    ppo.learn(48)
    step, count = core.step_by_call, [0]

    def break_one(action: torch.Tensor) -> Any:
        count[0] += 1
        if count[0] == 3:
            core.backend.qvel[5, 7] = torch.nan
        return step(action)

    core.step_by_call = break_one
    with pytest.raises(NumericalFault, match="qpos is not finite in environment 5") as fault:
        ppo.learn(48, reset_num_timesteps=False)
    assert not np.isfinite(fault.value.dump["qpos"]).all()
    assert np.isfinite(fault.value.dump["action"]).all()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")
@pytest.mark.parametrize("option", ["ppo.symmetry=false", "ppo.symmetry=true", "ppo.max_kl=0.001"])
def test_a_recorded_gradient_step_is_the_called_one_and_goes_on_from_a_checkpoint(tmp_path: Path, option: str) -> None:
    overrides = (*SMALL, option, "backend=warp", "ppo.epochs=3", "ppo.init_std=0.5", "ppo.desired_kl=0.0005")
    config = parse_train(compose("train", [o for o in overrides if "threads" not in o]))
    found = []
    for captures in (True, False):
        core = Go1Core(config.task, config.ppo.num_envs, 0, spread_starts=True)
        core.captures = False  # the rollout is called either way: the same numbers go into the update
        ppo = DevicePPO(config.ppo, Go1VecEnv(core), 0, "cuda")
        ppo._update = DeviceUpdate(ppo, ppo.rollout_buffer, captures)
        torch.manual_seed(1)
        ppo.learn(48)
        path = tmp_path / str(captures)
        checkpoint.save(ppo, path, keep=1)
        again = DevicePPO(config.ppo, Go1VecEnv(Go1Core(config.task, config.ppo.num_envs, 0)), 0, "cuda")
        checkpoint.restore(again, checkpoint.load_latest(path)[0])
        again._update = DeviceUpdate(again, again.rollout_buffer, captures)
        for name, value in ppo.rollout_buffer.data.items():
            again.rollout_buffer.data[name].copy_(value)
        torch.manual_seed(2)
        figures = again._update(0.0)
        found.append((again.policy.state_dict(), figures))
    (recorded, its_figures), (called, other_figures) = found
    for name, value in called.items():
        torch.testing.assert_close(recorded[name], value, rtol=1e-4, atol=1e-6, msg=name)
    for name, values in other_figures.items():
        assert its_figures[name] == pytest.approx(values, rel=1e-3, abs=1e-5), name


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")
def test_tf32_rounds_the_update_alone_and_by_little(tmp_path: Path) -> None:
    """One gradient step on one rollout: other weights than in float32, nearly the same loss; float32 outside of it."""
    overrides = (*SMALL, "backend=warp", "ppo.hidden=[256,128]", "ppo.epochs=1", "ppo.minibatches=1")
    one_step = [o for o in overrides if "threads" not in o]
    ppos: list[Any] = []
    for precision in ("highest", "highest", "tf32"):
        config = parse_train(compose("train", [*one_step, f"ppo.matmul_precision={precision}"]))
        ppos.append(DevicePPO(config.ppo, Go1VecEnv(Go1Core(config.task, config.ppo.num_envs, 0)), 0, "cuda"))
    first, *others = ppos
    first.learn(48)
    checkpoint.save(first, tmp_path, keep=1)
    factor = torch.arange(65536.0, device="cuda").sqrt().reshape(256, 256)
    product, weights, losses = factor @ factor, [], []
    for ppo in others:
        checkpoint.restore(ppo, checkpoint.load_latest(tmp_path)[0])
        ppo._update = DeviceUpdate(ppo, ppo.rollout_buffer, captures=True)
        for name, value in first.rollout_buffer.data.items():
            ppo.rollout_buffer.data[name].copy_(value)
        losses.append(ppo._update(0.0)["value_loss"])
        weights.append(torch.cat([p.detach().flatten() for p in ppo.policy.parameters()]))
    assert torch.equal(product, factor @ factor)
    assert not torch.equal(*weights)
    assert losses[1] == pytest.approx(losses[0], rel=0.01)


def test_on_the_cpu_tf32_is_float32() -> None:
    weights = []
    for precision in ("highest", "tf32"):
        ppo = learner(DevicePPO, f"ppo.matmul_precision={precision}")
        ppo.learn(48)
        weights.append(torch.cat([p.detach().flatten() for p in ppo.policy.parameters()]))
    assert torch.equal(*weights)
