"""Stable-Baselines3's PPO with rsl_rl's KL-adaptive learning rate.

SB3's policy, rollouts and logger are used as they are; advantages and loss are in ``go1exp.train.loss``, where the
learner on the GPU has them from too. The rule needs two things that SB3 does not keep: the action means at collection
(the buffer below stores them) and a look at every minibatch between forward pass and gradient step (a loop over
minibatches in place of SB3's).
"""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Callable, Generator
from functools import partial
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from stable_baselines3.common.utils import explained_variance, safe_mean
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch import Tensor, nn
from torch.optim import Optimizer

from go1exp.base.tensors.threads import one_thread
from go1exp.config.schema.history import width
from go1exp.config.schema.training import EstimatorConfig
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.faults import NumericalFault
from go1exp.sim.env.sb3_env import Go1VecEnv
from go1exp.sim.task import PPOConfig
from go1exp.train.group import Group
from go1exp.train.loss import mirror_of, ppo_loss, write_advantages
from go1exp.train.network import GaussianPolicy, policy_settings
from go1exp.train.schedule import Schedule

KL_FACTOR = 2.0
"""The rate changes when the divergence is off the desired one by this factor (rsl_rl)."""
RATE_FACTOR = 1.5
"""And then by this factor."""


def gaussian_kl(old_mean: Tensor, old_log_std: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Return KL(old || new) of diagonal Gaussians, summed over the last axis: analytic, without sampling.

    sum_d [ln(s_d / s0_d) + (s0_d^2 + (m0_d - m_d)^2) / (2 s_d^2) - 1/2]; means (B, A), log standard deviations (A,).
    """
    variance = torch.exp(2.0 * log_std)
    spread = torch.exp(2.0 * old_log_std) + (old_mean - mean).square()
    return (log_std - old_log_std + spread / (2.0 * variance) - 0.5).sum(-1)


def adapted_rate(rate: Tensor, kl: Tensor, desired: float, bounds: tuple[float, float]) -> Tensor:
    """Return the learning rate for the next gradient step, () (rsl_rl 5.4, ``algorithms/ppo.py``)."""
    slower, faster = (rate / RATE_FACTOR).clamp(min=bounds[0]), (rate * RATE_FACTOR).clamp(max=bounds[1])
    too_near = (kl > 0.0) & (kl < desired / KL_FACTOR)
    return torch.where(kl > KL_FACTOR * desired, slower, torch.where(too_near, faster, rate))


def linear_rate(config: PPOConfig, done: int) -> float:
    """Return the learning rate of the iteration after ``done`` ones: from ``learning_rate`` to the least allowed."""
    left = max(0.0, 1.0 - done / config.iterations)
    least = config.learning_rate_range[0]
    return least + left * (config.learning_rate - least)


LOSS_FIGURES = (
    "loss",
    "policy_gradient_loss",
    "value_loss",
    "entropy_loss",
    "clip_fraction",
    "approx_kl",
    "estimator_loss",
)
"""Names for the fields of ``Loss``, in their order: SB3's, and one for the estimator."""


class MeanRolloutBuffer(RolloutBuffer):
    """A rollout that also keeps the action means at collection, and knows those of the minibatch now in use."""

    policy: GaussianPolicy
    means: np.ndarray
    current_means: Tensor

    def reset(self) -> None:
        """Empty the buffer."""
        super().reset()
        self.means = np.zeros((self.buffer_size, self.n_envs, self.action_dim), dtype=np.float32)

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Store one step and the means of the forward pass that chose its actions."""
        self.means[self.pos] = self.policy.last_distribution.distribution.mean.detach().cpu().numpy()
        super().add(*args, **kwargs)

    def compute_returns_and_advantage(self, last_values: Tensor, dones: np.ndarray) -> None:
        """Compute advantages and returns, (T, N), from the values (N,) after the rollout and whether it ended there."""
        write_advantages(
            advantages=torch.as_tensor(self.advantages),  # shares the buffer's memory, in which it is written
            rewards=torch.as_tensor(self.rewards),
            values=torch.as_tensor(self.values),
            starts=torch.as_tensor(self.episode_starts),
            last_values=last_values.detach().cpu().flatten(),
            last_ended=torch.as_tensor(dones),
            gamma=self.gamma,
            gae_lambda=self.gae_lambda,
        )
        self.returns = self.advantages + self.values

    def explained_variance(self) -> float:
        """Return the share of the returns' variance that the value function explained; NaN without any variance."""
        return float(explained_variance(self.values.flatten(), self.returns.flatten()))

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        """Yield shuffled minibatches."""
        if not self.generator_ready:
            self.means = self.swap_and_flatten(self.means)
        yield from super().get(batch_size)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> RolloutBufferSamples:
        self.current_means = self.to_torch(self.means[batch_inds])
        return super()._get_samples(batch_inds, env)


class AdaptivePPO(PPO):
    """PPO that steers its learning rate and reports after each iteration.

    ``after_iteration(ppo)`` is called when an iteration is complete: rollout, update and metrics, nothing half done.

    Attributes:
        group: the GPUs that train together.
        schedule: the settings of the task that change between two iterations.
        mirror: of its samples, with ``ppo.symmetry``; else None.
    """

    buffer_class: type[RolloutBuffer] = MeanRolloutBuffer
    rollout_buffer: MeanRolloutBuffer
    policy: GaussianPolicy
    group = Group()
    schedule = Schedule()

    def __init__(
        self, config: PPOConfig, env: VecEnv, seed: int, device: str, estimator: EstimatorConfig | None = None
    ) -> None:
        self.config = config
        self.iteration = 0
        self.after_iteration: Callable[[AdaptivePPO], object] = lambda ppo: None
        terms = env.core.terms if isinstance(env, Go1VecEnv) else None
        assert terms or not config.symmetry, "only a robot's observations have mirror images"
        self.mirror = mirror_of(terms.observed) if config.symmetry and terms else None
        widths = [width(term) for term in terms.privileged] if terms else []
        policy_size = terms.policy_size if terms and widths else None
        super().__init__(
            GaussianPolicy,
            env,
            learning_rate=config.learning_rate,
            n_steps=config.steps,
            batch_size=env.num_envs * config.steps // config.minibatches,
            n_epochs=config.epochs,
            gamma=config.gamma,
            gae_lambda=config.gae_lambda,
            clip_range=config.clip_range,
            clip_range_vf=config.value_clip,
            normalize_advantage=config.normalize_advantage,
            ent_coef=config.entropy,
            vf_coef=config.value_coef,
            max_grad_norm=config.max_grad_norm,
            rollout_buffer_class=self.buffer_class,
            policy_kwargs=policy_settings(config, policy_size, estimator, widths),
            seed=seed,
            device=device,
        )

    @property
    def core(self) -> Go1Core:
        """The environments of a robot."""
        env = self.get_env()
        assert isinstance(env, Go1VecEnv)
        return env.core

    def _setup_model(self) -> None:
        super()._setup_model()
        self.rollout_buffer.policy = self.policy
        # Weakly: a hook of torch would keep the learner, and its robots, for ever.
        check = partial(type(self)._check_gradient, weakref.proxy(self))
        for name, parameter in self.policy.named_parameters():
            # Before the gradients' norm is clipped, which would spread a NaN to all of them.
            parameter.register_post_accumulate_grad_hook(partial(check, name))

    def _maybe_recommend_cpu(self, mlp_class_name: str = "ActorCriticPolicy") -> None:
        """Say nothing: the user chose the device."""

    def _update_learning_rate(self, optimizers: list[Optimizer] | Optimizer) -> None:
        """Leave the rate where the last minibatch put it; SB3 would set it from a schedule over time."""

    def _check_gradient(self, name: str, parameter: Tensor) -> None:
        if parameter.grad is not None and not torch.isfinite(parameter.grad.sum()):
            raise NumericalFault.not_finite(f"gradient of policy.{name}", f"in iteration {self.iteration + 1}")

    def _steer(self, divergence: float) -> None:
        """Note the divergence before the gradient step that is about to be taken, and set the rate of that step."""
        self._kl.append(divergence)
        if self.config.schedule == "adaptive":
            group, c = self.policy.optimizer.param_groups[0], self.config
            rate, kl = torch.tensor([group["lr"], divergence], dtype=torch.float64)
            group["lr"] = float(adapted_rate(rate, kl, c.desired_kl, c.learning_rate_range))

    def _divergence(self) -> Tensor:
        """Return the KL divergence of the policy from the one that collected this minibatch, ()."""
        with torch.no_grad():
            means = self.rollout_buffer.current_means
            mean = self.policy.last_distribution.distribution.mean[: len(means)]  # without mirror images
            return gaussian_kl(means, self._old_log_std, mean, self.policy.log_std).mean()

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> bool:
        """Collect as SB3 does, with one thread of torch: its idle threads would take cores from the physics."""
        with one_thread():
            return super().collect_rollouts(*args, **kwargs)

    def train(self) -> None:
        """Update on the rollout, then close the iteration."""
        self._old_log_std = self.policy.log_std.detach().clone()
        self._kl: list[float] = []
        if self.config.schedule == "linear":
            self.policy.optimizer.param_groups[0]["lr"] = linear_rate(self.config, self.iteration)
        self.policy.set_training_mode(True)
        batches = (batch for _ in range(self.n_epochs) for batch in self.rollout_buffer.get(self.batch_size))
        steps = list(itertools.takewhile(bool, map(self._gradient_step, batches)))
        self._n_updates += self.n_epochs
        self._report(dict(zip(LOSS_FIGURES, map(list, zip(*steps, strict=True)), strict=True)))
        self._close_iteration()

    def _gradient_step(self, batch: RolloutBufferSamples) -> list[float]:
        """Follow the loss of a minibatch downhill by one step; return the figures of the loss.

        No figures, and no step, where the policy has diverged by more than ``max_kl``: the update ends. Before its
        first step it has not moved: what divergence there is comes of rounding.
        """
        loss = ppo_loss(self.policy, batch, self.config, self.mirror)
        divergence = float(self._divergence())
        if self.config.max_kl is not None and self._kl and divergence > self.config.max_kl:
            return []
        self._steer(divergence)
        self.policy.optimizer.zero_grad()
        loss.total.backward()
        nn.utils.clip_grad_norm_(self.policy.parameters(), self.config.max_grad_norm)
        self.policy.optimizer.step()
        return [float(figure.detach()) for figure in loss]

    def _report(self, figures: dict[str, list[float]]) -> None:
        last_epoch = slice(-self.config.minibatches, None)  # the last steps, where a limit ended the update before
        means = {
            name: float(np.mean(values[last_epoch if name == "approx_kl" else slice(None)]))
            for name, values in figures.items()
        }
        means["loss"] = figures["loss"][-1]
        means["explained_variance"] = self.rollout_buffer.explained_variance()
        means["std"] = float(self.policy.log_std.detach().exp().mean())
        means["clip_range"] = self.config.clip_range
        if self.config.value_clip is not None:
            means["clip_range_vf"] = self.config.value_clip
        if not self.policy.estimator.latent:
            del means["estimator_loss"]
        for name, value in means.items():
            self.logger.record(f"train/{name}", value)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if self.config.max_kl is not None:
            self.logger.record("train/gradient_steps", len(figures["loss"]))

    def _close_iteration(self) -> None:
        self.iteration += 1
        self.logger.record("train/kl", float(np.mean(self._kl)))
        self.logger.record("train/learning_rate", float(self.policy.optimizer.param_groups[0]["lr"]))
        for key, name in (("r", "return"), ("l", "length")):  # NaN until a first episode has ended
            self.logger.record(f"rollout/{name}", safe_mean([e[key] for e in self.ep_info_buffer or ()]))
        self.after_iteration(self)

    def dump_logs(self, iteration: int = 0) -> None:
        """Do nothing: SB3 writes between rollout and update, which would put two iterations into one row."""

    def optimizer_state(self) -> dict[str, Any]:
        """Return the optimiser's state as any learner on any device can take it: rates are plain numbers."""
        state = self.policy.optimizer.state_dict()
        groups = [{**g, "lr": float(g["lr"]), "capturable": False} for g in state["param_groups"]]
        return {**state, "param_groups": groups}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "after_iteration", "schedule", "_kl", "_old_log_std"]
