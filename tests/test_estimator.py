"""An estimator: what it learns, whom PPO's gradient reaches, and that it trains, resumes and runs with the policy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from gymnasium.spaces import Box
from torch import Tensor

from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.config.schema.training import EstimatorConfig
from go1exp.deploy.export.graph import DeployedPolicy, to_onnx
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.sb3_env import Go1VecEnv
from go1exp.sim.task import TrainConfig, parse_train
from go1exp.train import checkpoint, run_folder, trainer
from go1exp.train.device import DevicePPO
from go1exp.train.network import GaussianPolicy, policy_settings
from go1exp.train.policy import load_network
from go1exp.train.ppo import AdaptivePPO
from tests import small_run
from tests.small_run import SMALL

P, C = 6, 4
"""Columns of the policy and of the critic alone."""

LEARNERS: tuple[type[AdaptivePPO], ...] = (AdaptivePPO, DevicePPO)


def settings(*overrides: str) -> TrainConfig:
    given = ("critic=privileged", "estimator=decoder", "estimator.latent=8", "estimator.hidden=[16]", *overrides)
    return parse_train(compose("train", [*SMALL, "ppo.matmul_precision=highest", *given]))


def learner(config: TrainConfig, kind: type[AdaptivePPO] = AdaptivePPO) -> Any:
    core = Go1Core(config.task, config.ppo.num_envs, 0, critic=True)
    return kind(config.ppo, Go1VecEnv(core), 0, "cpu", config.estimator)


def network() -> GaussianPolicy:
    """Return a small policy that sees ``P`` of ``P + C`` columns."""
    estimator = EstimatorConfig(latent=8, hidden=(32,))
    config = parse_train(compose("train", ["ppo.hidden=[16]", "ppo.matmul_precision=highest"])).ppo
    columns, actions = (Box(-np.inf, np.inf, (size,), np.float32) for size in (P + C, 2))
    return GaussianPolicy(columns, actions, lambda _: 1e-3, **policy_settings(config, P, estimator, (C - 1, 1)))


def gradients(policy: GaussianPolicy, loss: Tensor, part: str) -> float:
    """Return the largest gradient of ``loss`` in the parameters whose name has ``part`` in it."""
    named = {name: p for name, p in policy.named_parameters() if part in name}
    found = torch.autograd.grad(loss, list(named.values()), allow_unused=True, retain_graph=True)
    return max(0.0 if g is None else float(g.abs().max()) for g in found)


def surrogate(policy: GaussianPolicy, rows: Tensor) -> Tensor:
    """Return what PPO follows: log-probabilities of given actions."""
    return policy.evaluate_actions(rows, torch.ones(len(rows), 2))[1].sum()


def test_a_decoder_finds_what_the_observation_says_of_the_critics_columns() -> None:
    """Columns that are a linear map of the observation, and one that is not in it: its mean is all that can be said."""
    torch.manual_seed(0)
    policy, law = network(), torch.randn(P, C - 1)
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-2)
    for _ in range(400):
        seen, hidden = torch.randn(256, P), torch.randn(256, 1)
        rows = torch.cat([seen, seen @ law, 3.0 + hidden], dim=1)
        optimizer.zero_grad()
        loss = policy.mlp_extractor.estimation_loss(rows)
        loss.backward()
        optimizer.step()
    estimate = policy.mlp_extractor.estimate(rows[:, :P])
    error = (estimate - rows[:, P:]).square().mean(0)
    assert (error[:-1] < 0.05 * (seen @ law).var(0)).all()
    assert float(estimate[:, -1].detach().mean()) == pytest.approx(3.0, abs=0.2)
    # Each term counts the same, however many columns it has: three of the one, one of the other.
    assert float(loss.detach()) == pytest.approx(float((error[:-1].mean() + error[-1]).detach() / 2), rel=0.2)


def test_ppos_gradient_stops_before_the_encoder() -> None:
    policy, rows = network(), torch.randn(5, P + C)
    assert gradients(policy, surrogate(policy, rows), "policy_net.net") > 0.0
    assert gradients(policy, surrogate(policy, rows), "encoder") == 0.0
    assert gradients(policy, policy.mlp_extractor.estimation_loss(rows), "encoder") > 0.0


def test_both_paths_collect_and_learn_the_same() -> None:
    weights: list[dict[str, Tensor]] = []
    for path in LEARNERS:
        ppo = learner(settings("ppo.symmetry=true", "ppo.minibatches=1"), path)
        before = {name: value.clone() for name, value in ppo.policy.state_dict().items()}
        torch.manual_seed(1)  # one minibatch of all samples: no order that could differ
        logged: list[dict[str, float]] = []
        ppo.after_iteration = lambda p, logged=logged: logged.append(dict(p.logger.name_to_value))
        ppo.learn(16)
        assert logged[0]["train/estimator_loss"] > 0.0
        weights.append(ppo.policy.state_dict())
        assert all(not torch.equal(value, before[name]) for name, value in weights[-1].items() if "encoder" in name)
    for name, value in weights[0].items():
        torch.testing.assert_close(weights[1][name], value, rtol=1e-3, atol=1e-5, msg=name)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of a policy with an estimator and a history, on mirrored samples."""
    run = tmp_path_factory.mktemp("estimator") / "run"
    given = (
        "estimator=decoder",
        "observation=history",
        "critic=privileged",
        "ppo.symmetry=true",
        "checkpoint.every=1",
    )
    return small_run.trained(run, *given, "checkpoint.every=1")


def test_the_exported_graph_holds_the_estimator(trained: Path) -> None:
    config = run_folder.read_parsed(trained)
    policy, _ = load_network(trained, config)
    module = DeployedPolicy(policy, config.task.observation, config.task.action)
    session = onnxruntime.InferenceSession(to_onnx(module))
    readings = {port.name: torch.randn(3, port.size) for port in module.inputs}
    given = {name: reading.numpy() for name, reading in readings.items()}
    targets, observation, action = (torch.from_numpy(out) for out in session.run(None, given))
    with torch.no_grad():
        wanted = policy._predict(observation, deterministic=True)
        estimates = policy.mlp_extractor.estimate(observation)
    assert (estimates.std(0) > 0.0).all()
    torch.testing.assert_close(action, wanted, rtol=1e-4, atol=1e-4)
    assert targets.shape == (3, 12)


def test_a_run_resumes_as_if_it_had_never_stopped(trained: Path) -> None:
    first, second = map(checkpoint.read, checkpoint.checkpoints(trained))
    ppo = trainer.build(run_folder.read_parsed(trained))
    checkpoint.restore(ppo, first)
    ppo.learn(ppo.n_envs * ppo.n_steps, reset_num_timesteps=False)
    resumed = ppo.policy.state_dict()
    assert all(torch.equal(value, resumed[name]) for name, value in second["policy"].items())


def test_weights_fit_no_run_with_another_estimator(trained: Path) -> None:
    from go1exp.train.policy import read_weights

    other = parse_train(compose("train", [*SMALL, "observation=history", "critic=privileged", "ppo.symmetry=true"]))
    with pytest.raises(ConfigError, match=r"estimator\.latent is 0 here and 32 there"):
        read_weights(other, trained)


def test_an_estimator_needs_a_critic_that_sees_more() -> None:
    with pytest.raises(ConfigError, match=r"estimator: .*critic=privileged"):
        parse_train(compose("train", [*SMALL, "estimator=decoder", "critic=none"]))
