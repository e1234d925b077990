"""A rollout that stays on the learner's device, and the gradient steps' samples from it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from torch import Tensor

from go1exp.train.group import Group
from go1exp.train.loss import write_advantages
from go1exp.train.ppo import GaussianPolicy, MeanRolloutBuffer


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
            widths = {"observations": self.obs_shape, "actions": (self.action_dim,), "means": (self.action_dim,)}
            singles = (
                "rewards",
                "starts",
                "values",
                "log_probs",
                "advantages",
                "returns",
                "ended",
                "totals",
                "lengths",
            )
            shapes: dict[str, Any] = {**widths, **dict.fromkeys(singles, ())}
            size = (self.buffer_size, self.n_envs)
            self.data = {name: torch.zeros(*size, *shape, device=self.device) for name, shape in shapes.items()}
            self.whole = self.data
            self._next = torch.zeros(1, dtype=torch.int64, device=self.device)  # on the device: steps are replayed
        self._next.zero_()
        self.pos, self.full, self.generator_ready = 0, False, False

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
