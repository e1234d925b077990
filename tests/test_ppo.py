"""The learner: the divergence and the rate rule against references, SB3's object as configured, and that it learns."""

from __future__ import annotations

import copy
import dataclasses
import gc
import math
import weakref
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.buffers import RolloutBufferSamples
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn
from torch.distributions import Independent, Normal, kl_divergence

from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.mdp.types import StepResult
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.sb3_env import Go1VecEnv
from go1exp.sim.task import PPOConfig, parse_train
from go1exp.train import trainer
from go1exp.train.loss import ppo_loss
from go1exp.train.network import GaussianPolicy, policy_settings
from go1exp.train.ppo import AdaptivePPO, adapted_rate, gaussian_kl, linear_rate
from tests.small_run import small

TINY = small(
    *("ppo=paper", "ppo.matmul_precision=highest"), num_envs=8, steps=8, epochs=2, hidden="[16]", iterations=5000
)


def settings(*overrides: str) -> PPOConfig:
    return parse_train(compose("train", [*TINY, *overrides])).ppo


class Slider(VecEnv):
    """A point on a line that is paid for being at 0: obs (N, 1) its place, action (N, 1) its step; 16 steps long."""

    LENGTH = 16

    def __init__(self, num_envs: int = 8) -> None:
        box = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
        super().__init__(num_envs, gym.spaces.Box(-np.inf, np.inf, (1,), np.float32), box)
        self.random = np.random.default_rng(0)
        self.returns: list[float] = []

    def _start(self) -> np.ndarray:
        return self.random.uniform(-1.0, 1.0, (self.num_envs, 1)).astype(np.float32)

    def reset(self) -> np.ndarray:
        self.place, self.time, self.total = self._start(), 0, np.zeros(self.num_envs)
        return self.place.copy()

    def step_async(self, actions: np.ndarray) -> None:
        self.place = self.place + 0.5 * actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        reward = -np.abs(self.place[:, 0]).astype(np.float32)
        self.time += 1
        self.total += reward
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        over = self.time == self.LENGTH
        if over:
            self.returns.append(float(self.total.mean()))
            for i, info in enumerate(infos):
                info["terminal_observation"] = self.place[i].copy()
                info["TimeLimit.truncated"] = True
                info["episode"] = {"r": float(self.total[i]), "l": self.LENGTH}
            self.place, self.time, self.total = self._start(), 0, np.zeros(self.num_envs)
        return self.place.copy(), reward, np.full(self.num_envs, over), infos

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def slider_ppo(*overrides: str) -> AdaptivePPO:
    config = settings(*overrides)
    return AdaptivePPO(config, Slider(config.num_envs), seed=3, device="cpu")


def learn(ppo: AdaptivePPO, iterations: int) -> None:
    ppo.learn(iterations * ppo.n_steps * ppo.n_envs)


def gaussian(policy: GaussianPolicy, observations: Tensor) -> Normal:
    distribution = policy.get_distribution(observations).distribution
    assert isinstance(distribution, Normal)
    return distribution


def collect(ppo: AdaptivePPO) -> None:
    """Fill the rollout buffer once, without an update."""
    _, callback = ppo._setup_learn(ppo.n_steps * ppo.n_envs, None)
    callback.on_training_start({}, {})
    assert ppo.env is not None
    ppo.collect_rollouts(ppo.env, callback, ppo.rollout_buffer, ppo.n_steps)


# ---------------------------------------------------------------------- divergence


@pytest.mark.parametrize("seed", range(5))
def test_the_divergence_is_that_of_torch_distributions(seed: int) -> None:
    torch.manual_seed(seed)
    old_mean, mean = torch.randn(32, 12, dtype=torch.float64), torch.randn(32, 12, dtype=torch.float64)
    old_log_std, log_std = torch.randn(12, dtype=torch.float64), torch.randn(12, dtype=torch.float64)
    old = Independent(Normal(old_mean, old_log_std.exp()), 1)
    new = Independent(Normal(mean, log_std.exp()), 1)
    torch.testing.assert_close(gaussian_kl(old_mean, old_log_std, mean, log_std), kl_divergence(old, new))


def test_the_value_clip_holds_on_both_sides() -> None:
    config, zero = parse_train(compose("train", ["ppo.value_clip=0.1"])).ppo, torch.zeros(2)
    batch = RolloutBufferSamples(zero, zero[:, None], zero, zero, torch.tensor([1.0, -1.0]), zero)
    box = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    policy = GaussianPolicy(box, box, lambda _: 1e-3, **policy_settings(config))
    policy.evaluate_actions = lambda o, a: (torch.tensor([[0.5], [-0.7]]), zero, zero)  # type: ignore[assignment]
    # Values of 0, with returns of 0, have moved to 0.5 and -0.7: they count as 0.1 and -0.1.
    assert float(ppo_loss(policy, batch, config).value) == pytest.approx(0.1**2)


# ---------------------------------------------------------------------- rate rule


@pytest.mark.parametrize(
    ("rate", "kl", "expected"),
    [
        (1e-3, 0.0201, 1e-3 / 1.5),  # too far: slower
        (1e-3, 1e9, 1e-3 / 1.5),
        (1e-3, math.inf, 1e-3 / 1.5),
        (1e-3, 0.02, 1e-3),  # on the edge: unchanged
        (1e-3, 0.01, 1e-3),
        (1e-3, 0.005, 1e-3),  # on the edge: unchanged
        (1e-3, 0.0049, 1.5e-3),  # too near: faster
        (1e-3, 1e-12, 1.5e-3),
        (1e-3, 0.0, 1e-3),  # the same policy says nothing about the rate
        (1e-3, -1e-9, 1e-3),  # nor does rounding
        (1.2e-5, 1.0, 1e-5),  # bounds
        (1e-5, 1.0, 1e-5),
        (0.008, 1e-4, 0.01),
        (0.01, 1e-4, 0.01),
        (0.01, 1.0, 0.01 / 1.5),  # off a bound again
        (1e-5, 1e-4, 1.5e-5),
    ],
)
def test_the_rate_rule_is_rsl_rls(rate: float, kl: float, expected: float) -> None:
    given = torch.tensor([rate, kl], dtype=torch.float64)
    assert float(adapted_rate(given[0], given[1], 0.01, (1e-5, 1e-2))) == pytest.approx(expected, rel=1e-12)


class Watched:
    """What happened in every minibatch of a training, with divergences computed anew by torch.distributions."""

    def __init__(self, ppo: AdaptivePPO) -> None:
        self.rates: list[list[float]] = []
        self.own_kl: list[list[float]] = []
        self.kl: list[list[float]] = []
        self._seen = torch.empty(0)
        train, evaluate_actions = ppo.train, ppo.policy.evaluate_actions

        def watched_train() -> None:
            self.rates.append([])
            self.own_kl.append([])
            self._old = copy.deepcopy(ppo.policy)
            train()
            self.kl.append(list(ppo._kl))

        def watched_evaluate(obs: Tensor, actions: Tensor) -> Any:
            self._seen = obs.clone()
            return evaluate_actions(obs, actions)

        def before_step(optimizer: torch.optim.Optimizer, *_: Any) -> None:
            """Runs when the learner has set the rate."""
            self.rates[-1].append(optimizer.param_groups[0]["lr"])
            with torch.no_grad():
                old, new = gaussian(self._old, self._seen), gaussian(ppo.policy, self._seen)
                self.own_kl[-1].append(float(kl_divergence(old, new).sum(-1).mean()))

        ppo.train = watched_train  # type: ignore[method-assign]
        ppo.policy.evaluate_actions = watched_evaluate  # type: ignore[method-assign, assignment]
        ppo.policy.optimizer.register_step_pre_hook(before_step)


@pytest.fixture(scope="module")
def adaptive() -> tuple[AdaptivePPO, Watched]:
    """Twelve iterations with a goal that the rate has to look for in both directions."""
    ppo = slider_ppo("ppo.schedule=adaptive", "ppo.epochs=3", "ppo.minibatches=4", "ppo.desired_kl=0.003")
    watched = Watched(ppo)
    learn(ppo, 12)
    return ppo, watched


def test_divergences_of_all_minibatches_are_from_the_policy_that_collected_their_samples(
    adaptive: tuple[AdaptivePPO, Watched],
) -> None:
    _, watched = adaptive
    assert [len(k) for k in watched.kl] == [12] * 12  # 3 epochs of 4 minibatches
    np.testing.assert_allclose(watched.kl, watched.own_kl, atol=2e-6, rtol=1e-3)
    assert np.mean(watched.kl) > 1e-4  # so that the tolerance means something
    assert [k[0] for k in watched.kl] == [0.0] * 12  # exactly: nothing has changed yet
    assert all(k[-1] > 0.0 for k in watched.kl)


def test_the_divergence_of_a_minibatch_is_worked_out_once(monkeypatch: pytest.MonkeyPatch) -> None:
    ppo = slider_ppo("ppo.epochs=3", "ppo.minibatches=4", "ppo.max_kl=100")
    divergence, calls = ppo._divergence, [0]

    def counted() -> Tensor:
        calls[0] += 1
        return divergence()

    monkeypatch.setattr(ppo, "_divergence", counted)
    learn(ppo, 2)
    assert calls == [2 * 3 * 4]
    assert len(ppo._kl) == 3 * 4


def test_the_first_step_of_an_update_is_taken_whatever_rounding_says(monkeypatch: pytest.MonkeyPatch) -> None:
    ppo = slider_ppo("ppo.epochs=3", "ppo.minibatches=4", "ppo.max_kl=0.1")
    monkeypatch.setattr(ppo, "_divergence", lambda: torch.tensor(1.0))
    learn(ppo, 1)
    assert ppo.logger.name_to_value["train/gradient_steps"] == 1


def test_the_rate_of_every_gradient_step_follows_from_the_divergences(adaptive: tuple[AdaptivePPO, Watched]) -> None:
    ppo, watched = adaptive
    low, high = ppo.config.learning_rate_range
    rate = ppo.config.learning_rate
    expected = []
    for kl in np.concatenate(watched.kl):
        if kl > 0.006:
            rate = rate / 1.5 if rate / 1.5 > low else low
        elif kl > 0.0 and kl < 0.0015:
            rate = rate * 1.5 if rate * 1.5 < high else high
        expected.append(rate)
    got = np.concatenate(watched.rates)
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    assert (np.diff(got) > 0).any()
    assert (np.diff(got) < 0).any()
    assert ppo.logger.name_to_value["train/learning_rate"] == got[-1]
    assert ppo.logger.name_to_value["train/kl"] == pytest.approx(np.mean(watched.kl[-1]))


def test_a_linear_schedule_ends_at_the_least_rate() -> None:
    bounds = "ppo.learning_rate_range=[0.0001, 0.01]"
    ppo = slider_ppo("ppo.schedule=linear", "ppo.iterations=4", "ppo.learning_rate=0.002", bounds)
    rates = [linear_rate(ppo.config, k) for k in range(6)]
    assert rates == pytest.approx([0.002, 0.001525, 0.00105, 0.000575, 0.0001, 0.0001], rel=1e-12)
    for rate in rates[:2]:
        ppo.learn(1)
        assert ppo.policy.optimizer.param_groups[0]["lr"] == rate


def test_a_fixed_schedule_keeps_the_rate_whatever_the_divergence() -> None:
    ppo = slider_ppo("ppo.schedule=fixed", "ppo.desired_kl=1e-6", "ppo.learning_rate=0.002")
    watched = Watched(ppo)
    learn(ppo, 3)
    assert set(np.concatenate(watched.rates)) == {0.002}
    assert max(np.concatenate(watched.kl)) > 2e-6  # adaptive would have answered


def test_an_iteration_reports_once_when_its_update_is_complete() -> None:
    ppo = slider_ppo()
    seen = []
    ppo.after_iteration = lambda p: seen.append((p.iteration, p.num_timesteps, p._n_updates))
    learn(ppo, 3)
    assert seen == [(1, 64, 2), (2, 128, 4), (3, 192, 6)]


def test_a_learner_that_is_no_longer_referenced_is_freed() -> None:
    ppo = slider_ppo()
    learn(ppo, 1)
    held = weakref.ref(ppo)
    del ppo
    gc.collect()  # Hydra runs the jobs of a sweep in one process
    assert held() is None


# ---------------------------------------------------------------------- SB3's object


def test_every_setting_arrives_in_sb3() -> None:
    ppo = slider_ppo(
        "ppo.steps=16",
        "ppo.minibatches=4",
        "ppo.epochs=3",
        "ppo.learning_rate=0.002",
        "ppo.gamma=0.9",
        "ppo.gae_lambda=0.8",
        "ppo.clip_range=0.15",
        "ppo.value_clip=0.3",
        "ppo.entropy=0.01",
        "ppo.value_coef=0.7",
        "ppo.max_grad_norm=0.4",
        "ppo.normalize_advantage=false",
        "ppo.init_std=0.3",
    )
    assert (ppo.n_steps, ppo.batch_size, ppo.n_epochs, ppo.n_envs) == (16, 8 * 16 // 4, 3, 8)
    assert (ppo.gamma, ppo.gae_lambda) == (0.9, 0.8)
    assert (ppo.rollout_buffer.gamma, ppo.rollout_buffer.gae_lambda) == (0.9, 0.8)
    assert (ppo.ent_coef, ppo.vf_coef, ppo.max_grad_norm) == (0.01, 0.7, 0.4)
    assert ppo.normalize_advantage is False
    assert ppo.target_kl is None  # SB3 would stop an update early
    assert callable(ppo.clip_range)
    assert callable(ppo.clip_range_vf)
    assert [ppo.clip_range(p) for p in (1.0, 0.5, 0.0)] == [0.15] * 3
    assert [ppo.clip_range_vf(p) for p in (1.0, 0.5, 0.0)] == [0.3] * 3
    assert ppo.policy.optimizer.param_groups[0]["lr"] == 0.002
    torch.testing.assert_close(ppo.policy.log_std.exp(), torch.tensor([0.3]))
    assert slider_ppo("ppo.value_clip=null").clip_range_vf is None
    assert slider_ppo().normalize_advantage is True


@pytest.mark.parametrize(("name", "kind"), [("elu", nn.ELU), ("relu", nn.ReLU), ("tanh", nn.Tanh)])
def test_actor_and_critic_are_networks_of_their_own_with_the_configured_layers(name: str, kind: type) -> None:
    policy = slider_ppo("ppo.hidden=[32,16,8]", f"ppo.activation={name}").policy
    actor, critic = policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net
    for net in (actor, critic):
        linear = [(m.in_features, m.out_features) for m in net.children() if isinstance(m, nn.Linear)]
        assert linear == [(1, 32), (32, 16), (16, 8)]
        assert [type(m) for m in net.children()] == [nn.Linear, kind] * 3
    assert (policy.action_net.in_features, policy.action_net.out_features) == (8, 1)
    assert (policy.value_net.in_features, policy.value_net.out_features) == (8, 1)
    observation = torch.linspace(-1, 1, 5).unsqueeze(1)
    value = policy.predict_values(observation).detach()
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.zero_()
    torch.testing.assert_close(policy.predict_values(observation).detach(), value, rtol=0, atol=0)


def test_orthogonal_weights_are_a_choice() -> None:
    def first_layer(choice: str) -> Tensor:
        policy = slider_ppo("ppo.hidden=[16,8]", f"ppo.orthogonal_init={choice}").policy
        weight = policy.state_dict()["mlp_extractor.policy_net.2.weight"]
        return weight @ weight.T

    torch.testing.assert_close(first_layer("true"), 2.0 * torch.eye(8), atol=1e-5, rtol=0)  # gain sqrt(2)
    assert not torch.allclose(first_layer("false"), 2.0 * torch.eye(8), atol=0.1)


# ---------------------------------------------------------------------- precision


def network(precision: str) -> GaussianPolicy:
    torch.manual_seed(0)
    box = gym.spaces.Box(-1.0, 1.0, (12,), np.float32)
    config = settings(f"ppo.matmul_precision={precision}", "ppo.hidden=[64,32]")
    return GaussianPolicy(
        gym.spaces.Box(-np.inf, np.inf, (48,), np.float32), box, lambda _: 1e-3, **policy_settings(config)
    )


def outputs(policy: GaussianPolicy, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    actions = torch.zeros(len(observation), 12)
    values, log_prob, _ = policy.evaluate_actions(observation, actions)
    return policy.last_distribution.distribution.mean.detach(), values.detach(), log_prob.detach()


def test_bf16_changes_the_forward_pass_of_training_only_and_not_by_much() -> None:
    exact, rough = network("highest"), network("bf16")
    rough.load_state_dict(exact.state_dict())
    observation = torch.randn(256, 48)
    for policy in (exact, rough):
        policy.set_training_mode(False)
    reference = outputs(exact, observation)
    for one, other in zip(reference, outputs(rough, observation), strict=True):
        assert torch.equal(one, other)
    for policy in (exact, rough):
        policy.set_training_mode(True)
    for one, other in zip(reference, outputs(exact, observation), strict=True):
        assert torch.equal(one, other)
    for one, other in zip(reference, outputs(rough, observation), strict=True):
        assert other.dtype == torch.float32
        assert not torch.equal(one, other)
        assert (one - other).abs().max() < 0.02 * one.abs().max()


@pytest.mark.parametrize(("units", "precision"), [((), "highest"), (("_is_amx_tile_supported",), "bf16")])
def test_without_units_for_bfloat16_the_update_is_in_float32(
    units: tuple[str, ...], precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for check in ("_is_avx512_bf16_supported", "_is_amx_tile_supported"):
        monkeypatch.setattr(torch.cpu, check, lambda check=check: check in units)
    auto, chosen = (policy_settings(settings(f"ppo.matmul_precision={p}")) for p in ("auto", precision))
    assert auto == chosen


def test_bf16_keeps_weights_and_their_gradients_in_float32() -> None:
    ppo = slider_ppo("ppo.matmul_precision=bf16")
    before = copy.deepcopy(ppo.policy.state_dict())
    learn(ppo, 2)
    for name, parameter in ppo.policy.named_parameters():
        assert parameter.dtype == torch.float32
        assert parameter.grad is not None
        assert parameter.grad.dtype == torch.float32
        assert not torch.equal(parameter, before[name])


@pytest.mark.parametrize("precision", ["highest", "bf16"])
def test_the_means_kept_with_a_rollout_are_float32_and_those_of_its_observations(precision: str) -> None:
    ppo = slider_ppo(f"ppo.matmul_precision={precision}")
    reference = slider_ppo().policy
    reference.load_state_dict(ppo.policy.state_dict())
    collect(ppo)
    observations = torch.as_tensor(ppo.rollout_buffer.observations).reshape(-1, 1)
    with torch.no_grad():
        expected = gaussian(reference, observations).mean
    got = torch.as_tensor(ppo.rollout_buffer.means).reshape(-1, 1)
    torch.testing.assert_close(got, expected, atol=1e-6, rtol=1e-6)
    assert got.std() > 1e-3


# ---------------------------------------------------------------------- the environment's border


def test_a_time_limit_is_bootstrapped_with_the_value_of_the_last_observation_and_a_fall_is_not(
    make_core: Callable[..., Go1Core],
) -> None:
    """Rewards in the rollout against the environment's own, computed by hand for the episodes that ended."""
    core = make_core("sim.episode_s=0.12", "termination={tilt: {max_angle: 0.15}}", num_envs=16)
    env = Go1VecEnv(core)
    config = settings("ppo.num_envs=16", "ppo.gamma=0.9")
    ppo = AdaptivePPO(config, env, seed=0, device="cpu")
    results: list[StepResult] = []
    step = core.step

    def recorded(action: Tensor) -> StepResult:
        result = step(action)
        results.append(dataclasses.replace(result, reward=result.reward.clone()))
        return result

    core.step = recorded  # type: ignore[method-assign]
    collect(ppo)
    kinds = {"running": 0, "fell": 0, "time": 0}
    for k, result in enumerate(results):
        with torch.no_grad():
            values = ppo.policy.predict_values(result.final_observation)[:, 0]
        for i in range(core.num_envs):
            expected = float(result.reward[i])
            kind = "fell" if result.terminated[i] else "time" if result.truncated[i] else "running"
            kinds[kind] += 1
            if kind == "time":
                assert abs(values[i]) > 1e-3  # so that leaving it out would show
                expected += 0.9 * float(values[i])
            assert ppo.rollout_buffer.rewards[k, i] == pytest.approx(expected, rel=1e-5, abs=1e-6)
            if k + 1 < len(results):
                assert bool(ppo.rollout_buffer.episode_starts[k + 1, i]) == (kind != "running")
    assert min(kinds.values()) > 0, kinds


# ---------------------------------------------------------------------- learning


def test_it_learns_to_walk_to_a_point_on_a_line() -> None:
    ppo = slider_ppo("ppo.num_envs=32", "ppo.steps=16", "ppo.epochs=4", "ppo.minibatches=4", "ppo.init_std=0.5")
    learn(ppo, 40)
    env = ppo.env
    assert isinstance(env, Slider)
    first, last = np.mean(env.returns[:3]), np.mean(env.returns[-3:])
    assert first < -6.0  # a random walk
    assert last > 0.5 * first
    observation = torch.tensor([[-0.4], [0.4]])
    with torch.no_grad():
        left, right = ppo.policy._predict(observation, deterministic=True)[:, 0]
    assert left > 0.2
    assert right < -0.2


def test_a_device_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """SB3 would train on the CPU without a word."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="device = 'cuda': torch finds no CUDA device"):
        trainer.build(parse_train(compose("train", ["device=cuda", "ppo.num_envs=1"])))
