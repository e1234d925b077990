"""PPO's gradient steps on the device, without a look at any value on the way.

One gradient step (gather the minibatch, loss, backward pass, clipping, rate, Adam) is one CUDA graph where the
environment's step is one. SB3's own loop reads six numbers a minibatch back, which costs more than the arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from go1exp.train.device_buffer import DeviceRolloutBuffer
from go1exp.train.loss import ppo_loss
from go1exp.train.ppo import LOSS_FIGURES, AdaptivePPO, adapted_rate, gaussian_kl

FIGURES = (*LOSS_FIGURES, "kl", "finite")
"""What is kept of each gradient step; ``finite`` is 1 if its gradients were."""

WARM_UP = 3
"""Steps before one is recorded, as CUDA graphs ask."""


class DeviceUpdate:
    """All gradient steps of an iteration.

    The memory of policy and optimiser must stay where it is from the first call on: restore checkpoints before it.

    Args:
        ppo: the learner.
        buffer: its rollouts.
        captures: record the gradient step as a CUDA graph; else make its calls one by one.
    """

    def __init__(self, ppo: AdaptivePPO, buffer: DeviceRolloutBuffer, captures: bool) -> None:
        self._config, self._policy, self._buffer, self._mirror = ppo.config, ppo.policy, buffer, ppo.mirror
        self._adam = ppo.policy.optimizer
        c, device = ppo.config, ppo.device
        self._rate = torch.zeros((), device=device)
        self._old_log_std = torch.zeros_like(ppo.policy.log_std)
        self._rows = torch.zeros(ppo.batch_size, dtype=torch.int64, device=device)
        self._figures = torch.zeros(c.epochs * c.minibatches, len(FIGURES), device=device)
        self._taken = torch.zeros(1, dtype=torch.int64, device=device)
        self._on_gpu = device.type == "cuda"
        self._captures = captures and self._on_gpu
        self._step: Callable[[], None] | None = None

    def __call__(self, scheduled_rate: float) -> dict[str, list[float]]:
        """Make the steps on the full buffer and return their figures, a list each.

        ``scheduled_rate`` is the learning rate of the linear schedule.
        """
        self._take_over_rate()
        if self._config.schedule == "linear":
            self._rate.fill_(scheduled_rate)
        self._old_log_std.copy_(self._policy.log_std.detach())
        if self._step is None:
            self._step = self._captured() if self._captures else self._gradient_step
        self._taken.zero_()
        for _ in range(self._config.epochs):
            for rows in self._buffer.minibatches(len(self._rows)):
                self._rows.copy_(rows)
                self._step()
        return dict(zip(FIGURES, self._figures.T.tolist(), strict=True))

    def _gradient_step(self) -> None:
        """Loss, gradients and rsl_rl's rate for one minibatch; in place, so that it can be replayed."""
        c, policy = self._config, self._policy
        batch = self._buffer.batch(self._rows)
        loss = ppo_loss(policy, batch, c, self._mirror)

        self._adam.zero_grad(set_to_none=True)
        loss.total.backward()
        norm = torch.nn.utils.clip_grad_norm_(policy.parameters(), c.max_grad_norm)
        with torch.no_grad():
            means = self._buffer.current_means
            mean = policy.last_distribution.distribution.mean[: len(means)]  # without mirror images
            kl = gaussian_kl(means, self._old_log_std, mean, policy.log_std).mean()
            if c.schedule == "adaptive":
                self._rate.copy_(adapted_rate(self._rate, kl, c.desired_kl, c.learning_rate_range))
            figures = torch.stack((*loss, kl, torch.isfinite(norm).float()))
            self._figures.index_copy_(0, self._taken, figures.unsqueeze(0))
            self._taken.add_(1)
        self._adam.step()

    def _take_over_rate(self) -> None:
        """Put the optimiser's rate, and its counts of steps, where a graph can reach them."""
        group = self._adam.param_groups[0]
        if group["lr"] is self._rate:
            return
        self._rate.fill_(group["lr"])
        group["lr"], group["capturable"] = self._rate, self._on_gpu
        for state in self._adam.state.values():
            state["step"] = state["step"].to(self._rate.device if self._on_gpu else "cpu")

    def _captured(self) -> Callable[[], None]:
        """Record a gradient step as a CUDA graph; the ones that must come before it leave no trace."""
        saved = [(p, p.detach().clone(), _clone(self._adam.state.get(p))) for p in self._policy.parameters()]
        rate = self._rate.clone()
        stream = torch.cuda.Stream(self._rate.device)
        stream.wait_stream(torch.cuda.current_stream(self._rate.device))
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                self._taken.zero_()
                self._gradient_step()
        torch.cuda.synchronize(self._rate.device)
        self._rate.copy_(rate)
        with torch.no_grad():
            for parameter, value, state in saved:
                parameter.copy_(value)
                for name, kept in self._adam.state[parameter].items():
                    kept.copy_(state[name]) if state else kept.zero_()
        self._adam.zero_grad(set_to_none=True)  # the graph makes gradients in memory of its own
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
            self._gradient_step()
        return graph.replay


def _clone(state: dict[str, Any] | None) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in (state or {}).items()}
