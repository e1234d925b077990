"""PPO that never leaves the GPU: rollouts, advantages and gradient steps stay where the environment is.

SB3's loop takes every step through numpy and looks at every environment's info in Python, its buffer computes
advantages on the host, and its update waits for the device six times a minibatch (docs/notebook/benchmarks.md has
what that costs). Policy, optimiser, saving, callbacks and logger are SB3's here too; advantages and loss are those of
``go1exp.train.loss``, as on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from go1exp import robot
from go1exp.config.schema.training import EstimatorConfig
from go1exp.sim.env.engine import captured
from go1exp.sim.env.faults import NumericalFault
from go1exp.sim.task import PPOConfig
from go1exp.train.device_update import DeviceRolloutBuffer, DeviceUpdate
from go1exp.train.group import Group, SharedNoise
from go1exp.train.ppo import AdaptivePPO, linear_rate


class DevicePPO(AdaptivePPO):
    """``AdaptivePPO`` on an environment whose tensors are on the learner's own device."""

    buffer_class: type[RolloutBuffer] = DeviceRolloutBuffer
    rollout_buffer: DeviceRolloutBuffer

    def __init__(
        self,
        config: PPOConfig,
        env: VecEnv,
        seed: int,
        device: str,
        estimator: EstimatorConfig | None = None,
        group: Group | None = None,
    ) -> None:
        # Each new distribution would otherwise look at its parameters, and wait for them.
        torch.distributions.Distribution.set_default_validate_args(False)
        self.group = group or Group()
        super().__init__(config, env, seed, device, estimator)

    def _setup_model(self) -> None:
        super()._setup_model()
        self.rollout_buffer.share_with(self.group)
        if self.group.size > 1:
            self.policy.action_dist = SharedNoise(robot.NUM_JOINTS, self.group)
        self._observation = torch.zeros(self.n_envs, *self.rollout_buffer.obs_shape, device=self.device)
        self._starts = torch.zeros(self.n_envs, dtype=torch.bool, device=self.device)
        self._replay: Callable[[], None] | None = None
        self._update: DeviceUpdate | None = None

    def _collect_step(self) -> None:
        """Act on the observation, step, keep both; in place, so that it can be replayed as a graph."""
        core, policy = self.core, self.policy
        with torch.no_grad():
            actions, values, log_probs = policy(self._observation)
            result = core.step_by_call(actions)
            # A time limit is no end: what would have come after it counts.
            beyond = policy.predict_values(result.final_observation).squeeze(1)
            ended = result.terminated | result.truncated
            self.rollout_buffer.store(
                observations=self._observation,
                actions=actions,
                means=policy.last_distribution.distribution.mean,
                rewards=result.reward + self.gamma * beyond * result.truncated,
                starts=self._starts,
                values=values.squeeze(1),
                log_probs=log_probs,
                ended=ended,
                totals=result.episode_return,
                lengths=result.episode_length,
            )
            self._observation.copy_(result.observation)
            self._starts.copy_(ended)

    def _stepper(self) -> Callable[[], None]:
        """Return what makes one step of a rollout: the graph of it, recorded at the first call."""
        if not self.core.captures:
            return self._collect_step
        if self._replay is None:
            before = self._observation.clone(), self._starts.clone(), torch.cuda.get_rng_state(self.device)
            self.group.meet()
            self._replay, _ = captured(self.core, self._collect_step)
            self.group.meet()
            self._observation.copy_(before[0])
            self._starts.copy_(before[1])
            torch.cuda.set_rng_state(before[2], self.device)
            self.rollout_buffer.reset()
        return self._replay

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Fill the buffer; return whether the callback lets training go on. One wait for the device, at the end."""
        buffer = self.rollout_buffer
        self.policy.set_training_mode(False)
        self._observation.copy_(torch.as_tensor(np.asarray(self._last_obs)))
        self._starts.copy_(torch.as_tensor(np.asarray(self._last_episode_starts)))
        buffer.reset()
        callback.on_rollout_start()
        step = self._stepper()
        for _ in range(n_rollout_steps):
            step()
            buffer.pos += 1
            self.num_timesteps += env.num_envs * self.group.size
            callback.update_locals(locals())
            if not callback.on_step():
                return False
        buffer.full = buffer.pos == buffer.buffer_size
        with torch.no_grad():
            buffer.estimate(self.policy.predict_values(self._observation).squeeze(1), self._starts)
        self.core.check_so_far()
        assert self.ep_info_buffer is not None
        self.ep_info_buffer.extend(buffer.episodes(self._stats_window_size))
        self._last_obs, self._last_episode_starts = self._observation.cpu().numpy(), self._starts.cpu().numpy()
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _check_gradient(self, name: str, parameter: Tensor) -> None:
        """Do nothing as each gradient arrives: ``train`` looks at all of them in the end."""

    def train(self) -> None:
        """Update on the rollout, wait for the device once, then close the iteration.

        Raises:
            NumericalFault: if a gradient was not finite; the policy is spoilt by then, the last checkpoint is not.
        """
        self.policy.set_training_mode(True)
        if self._update is None:
            self._update = DeviceUpdate(self, self.rollout_buffer, captures=self.core.captures)
        figures = self._update(linear_rate(self.config, self.iteration))
        self._n_updates += self.n_epochs
        self._kl = figures.pop("kl")
        if not all(figures.pop("finite")):
            raise NumericalFault.not_finite("gradient of the policy", f"in iteration {self.iteration + 1}")
        self._report(figures)
        self._close_iteration()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_update", "_replay", "_observation", "_starts", "group"]
