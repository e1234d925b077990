"""PPO's gradient steps on the device, without a look at any value on the way.

One gradient step (gather the minibatch, loss, backward pass, clipping, rate, Adam) is one CUDA graph where the
environment's step is one; in a group (``train/group.py``) two, between which gradients are averaged. SB3's own loop
reads six numbers a minibatch back, which costs more than the arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import torch
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from torch import Tensor

from go1exp.train.group import Group
from go1exp.train.loss import ppo_loss, write_advantages
from go1exp.train.ppo import LOSS_FIGURES, AdaptivePPO, GaussianPolicy, MeanRolloutBuffer, adapted_rate, gaussian_kl

FIGURES = (*LOSS_FIGURES, "kl", "finite", "taken")
"""What is kept of each gradient step; ``finite`` is 1 if its gradients were, ``taken`` if the update had not ended."""

SINGLES = ("rewards", "starts", "values", "log_probs", "advantages", "returns", "ended", "totals", "lengths")
"""Parts of a rollout that are one number for each robot and step."""

WARM_UP = 3
"""Steps before one is recorded, as CUDA graphs ask."""


class DeviceRolloutBuffer(MeanRolloutBuffer):
    """A rollout of tensors ``(steps, n, ...)`` on the learner's device, and the episodes that ended in it.

    Attributes:
        data: the rollout of this learner's robots.
        group: who else collects.
        whole: ``(steps, N, ...)``, the rollouts of all robots of the group after ``estimate``; alone, ``data`` itself.
    """

    policy: GaussianPolicy
    data: dict[str, Tensor]
    group = Group()
    whole: dict[str, Tensor]

    def reset(self) -> None:
        """Empty the buffer; its memory is made once."""
        if not hasattr(self, "data"):
            shapes = {
                "observations": self.obs_shape,
                "actions": (self.action_dim,),
                "means": (self.action_dim,),
            }
            self.data = {name: self._zeros(*shape) for name, shape in shapes.items()}
            self.data |= {name: self._zeros() for name in SINGLES}
            self.whole = self.data
            self._next = torch.zeros(1, dtype=torch.int64, device=self.device)  # on the device: steps are replayed
        self._next.zero_()
        self.pos, self.full, self.generator_ready = 0, False, False

    def _zeros(self, *shape: int) -> Tensor:
        return torch.zeros(self.buffer_size, self.n_envs, *shape, device=self.device)

    def share_with(self, group: Group) -> None:
        """Collect together with ``group``."""
        self.group = group
        if group.size > 1:
            wide = (self.buffer_size, self.n_envs * group.size)
            self.whole = {name: local.new_zeros(*wide, *local.shape[2:]) for name, local in self.data.items()}

    def store(self, **step: Tensor) -> None:
        """Keep one step: values (N, ...) by the names of ``data``. The caller counts with ``pos``."""
        for name, value in step.items():
            kept = self.data[name]
            kept.index_copy_(0, self._next, value.to(kept.dtype).unsqueeze(0))
        self._next.add_(1).remainder_(self.buffer_size)

    def estimate(self, last_values: Tensor, last_ended: Tensor) -> None:
        """Compute advantages and returns, and join the rollouts of the group.

        Args:
            last_values: (n,) of the states after the rollout.
            last_ended: (n,) whether an episode ended in its last step.
        """
        d = self.data
        write_advantages(
            advantages=d["advantages"],
            rewards=d["rewards"],
            values=d["values"],
            starts=d["starts"],
            last_values=last_values,
            last_ended=last_ended,
            gamma=self.gamma,
            gae_lambda=self.gae_lambda,
        )
        torch.add(d["advantages"], d["values"], out=d["returns"])
        if self.whole is not d:
            for name, local in d.items():
                self.group.join(local, self.whole[name])

    def episodes(self, most: int) -> list[dict[str, float]]:
        """Return return ``r`` and length ``l`` of the newest episodes, up to ``most``, oldest first."""
        rows = self.whole["ended"].flatten().nonzero().squeeze(1)[-most:]
        totals, lengths = (self.whole[name].flatten()[rows].tolist() for name in ("totals", "lengths"))
        return [{"r": r, "l": int(n)} for r, n in zip(totals, lengths, strict=True)]

    def minibatches(self, batch_size: int | None = None) -> Iterator[Tensor]:
        """Yield the rows (B,) of one minibatch after another, in an order drawn anew."""
        total = self.buffer_size * self.n_envs * self.group.size
        yield from torch.randperm(total, device=self.device).split(batch_size or total)

    def batch(self, rows: Tensor) -> RolloutBufferSamples:
        """Return the samples of ``rows``, and have their means at hand."""
        names = ("observations", "actions", "values", "log_probs", "advantages", "returns")
        *samples, self.current_means = (self.whole[name].flatten(0, 1)[rows] for name in (*names, "means"))
        return RolloutBufferSamples(*samples)

    def get(self, batch_size: int | None = None) -> Iterator[RolloutBufferSamples]:  # type: ignore[override]
        """Yield shuffled minibatches."""
        yield from map(self.batch, self.minibatches(batch_size))

    def explained_variance(self) -> float:
        """Return the share of the returns' variance that the value function explained; NaN without any variance."""
        returns, values = self.whole["returns"], self.whole["values"]
        left, total = (returns - values).var(), returns.var()
        return float(torch.where(total > 0.0, 1.0 - left / total, torch.nan))


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
        self._group = buffer.group
        self._adam = ppo.policy.optimizer
        c, device = ppo.config, ppo.device
        self._rate = torch.zeros((), device=device)
        self._old_log_std = torch.zeros_like(ppo.policy.log_std)
        self._rows = torch.zeros(ppo.batch_size * self._group.size, dtype=torch.int64, device=device)
        self._build_averaged(device)
        self._figures = torch.zeros(c.epochs * c.minibatches, len(FIGURES), device=device)
        self._position = torch.zeros(1, dtype=torch.int64, device=device)
        self._ended = torch.zeros((), dtype=torch.bool, device=device)
        self._on_gpu = device.type == "cuda"
        self._captures = captures and self._on_gpu
        self._tf32 = c.matmul_precision == "tf32" and self._on_gpu
        self._step: Callable[[], None] | None = None

    def _build_averaged(self, device: torch.device) -> None:
        """Make the memory of gradients and figures one piece, which is averaged over the group in one go."""
        parameters = list(self._policy.parameters())
        sizes = [p.numel() for p in parameters]
        measured = len(LOSS_FIGURES) + 1  # and the divergence
        self._averaged = torch.zeros(sum(sizes) + measured, device=device)
        *gradients, self._step_figures = self._averaged.split([*sizes, measured])
        self._gradients = [g.view_as(p) for g, p in zip(gradients, parameters, strict=True)]

    def __call__(self, scheduled_rate: float) -> dict[str, list[float]]:
        """Make the steps on the full buffer and return their figures, a list each.

        ``scheduled_rate`` is the learning rate of the linear schedule.
        """
        self._take_over_rate()
        if self._config.schedule == "linear":
            self._rate.fill_(scheduled_rate)
        self._old_log_std.copy_(self._policy.log_std.detach())
        with _rounded_factors(self._tf32):
            if self._step is None:  # a graph keeps the precision of its recording
                self._step = self._captured() if self._captures else self._gradient_step
            self._position.zero_()
            self._ended.zero_()
            for _ in range(self._config.epochs):
                for rows in self._buffer.minibatches(len(self._rows)):
                    self._rows.copy_(rows)
                    self._step()
        *figures, taken = self._figures.cpu().T
        return {name: values[taken > 0.0].tolist() for name, values in zip(FIGURES[:-1], figures, strict=True)}

    def _gradient_step(self) -> None:
        """Loss, gradients and rsl_rl's rate for one minibatch; in place, so that it can be replayed."""
        self._find_gradients()
        self._group.average(self._averaged)
        self._follow_gradients()

    def _find_gradients(self) -> None:
        """Work out gradients and figures of this member's part of the minibatch."""
        policy, group, buffer = self._policy, self._group, self._buffer
        batch = buffer.batch(self._rows[group.rows(len(self._rows))])
        among = None if group.size == 1 else buffer.whole["advantages"].flatten()[self._rows]
        loss = ppo_loss(policy, batch, self._config, self._mirror, among)
        self._averaged.zero_()
        for parameter, gradient in zip(policy.parameters(), self._gradients, strict=True):
            parameter.grad = gradient
        loss.total.backward()
        with torch.no_grad():
            means = buffer.current_means
            mean = policy.last_distribution.distribution.mean[: len(means)]  # without mirror images
            kl = gaussian_kl(means, self._old_log_std, mean, policy.log_std).mean()
            self._step_figures.copy_(torch.stack((*loss, kl)))

    def _follow_gradients(self) -> None:
        """Take the step, at a rate that the divergence asks for."""
        c = self._config
        norm = torch.nn.utils.clip_grad_norm_(self._policy.parameters(), c.max_grad_norm)
        with torch.no_grad():
            kl = self._step_figures[-1]
            if c.max_kl is not None:
                self._ended.logical_or_((kl > c.max_kl) & (self._position[0] > 0))  # the first step is always taken
            if c.schedule == "adaptive":
                rate = adapted_rate(self._rate, kl, c.desired_kl, c.learning_rate_range)
                self._rate.copy_(torch.where(self._ended, self._rate, rate))
            figures = torch.cat((self._step_figures, torch.stack((torch.isfinite(norm), ~self._ended)).float()))
            self._figures.index_copy_(0, self._position, figures.unsqueeze(0))
            self._position.add_(1)
        if c.max_kl is None:
            self._adam.step()
        else:
            self._step_unless_ended()

    def _step_unless_ended(self) -> None:
        """Take Adam's step, and take it back if the update has ended: a graph cannot leave it out."""
        policy, state = list(self._policy.parameters()), self._adam.state
        before = [value.clone() for value in (*policy, *_moments(state))] if state else []
        self._adam.step()
        with torch.no_grad():  # without moments it was the first step of all, before which nothing can end
            for value, kept in zip((*policy, *_moments(state)), before, strict=bool(before)):
                value.copy_(torch.where(self._ended, kept, value))

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
        """Record a gradient step as CUDA graphs; the ones that must come before it leave no trace."""
        saved = [(p, p.detach().clone(), _clone(self._adam.state.get(p))) for p in self._policy.parameters()]
        rate = self._rate.clone()
        stream = torch.cuda.Stream(self._rate.device)
        stream.wait_stream(torch.cuda.current_stream(self._rate.device))
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                self._position.zero_()
                self._gradient_step()
        torch.cuda.synchronize(self._rate.device)
        self._rate.copy_(rate)
        with torch.no_grad():
            for parameter, value, state in saved:
                parameter.copy_(value)
                for name, kept in self._adam.state[parameter].items():
                    kept.copy_(state[name]) if state else kept.zero_()
        if self._group.size == 1:
            return self._recorded(self._gradient_step, stream)
        self._group.meet()
        find, follow = (self._recorded(part, stream) for part in (self._find_gradients, self._follow_gradients))
        self._group.meet()

        def step() -> None:
            find()
            self._group.average(self._averaged)
            follow()

        return step

    def _recorded(self, work: Callable[[], None], stream: torch.cuda.Stream) -> Callable[[], None]:
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
            work()
        return graph.replay


@contextmanager
def _rounded_factors(wanted: bool) -> Iterator[None]:
    """Let a GPU round the factors of its matrix products to TF32 if ``wanted``; the environment keeps float32."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if wanted else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def _moments(state: Mapping[Tensor, dict[str, Tensor]]) -> list[Tensor]:
    return [value for of_parameter in state.values() for value in of_parameter.values()]


def _clone(state: dict[str, Tensor] | None) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in (state or {}).items()}
