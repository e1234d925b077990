"""Tensors that outlive a step: state written in place, delay lines, constants of a device."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from torch import Tensor


class Memory:
    """Base of everything stateful in an env: names its tensors once, so that saving and resuming cannot miss one.

    A subclass assigns tensors to the attributes it lists in ``memory`` and changes them in place only: a captured GPU
    graph would not see an assignment.
    """

    memory: tuple[str, ...] = ()

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the tensors named in ``memory``."""
        return {name: getattr(self, name).clone() for name in self.memory}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Write the tensors back, in place; raise KeyError if one is missing."""
        for name in self.memory:
            getattr(self, name).copy_(state[name])

    def renew(self) -> None:
        """Forget, in place, what outlives an episode; called when everything begins anew with another seed."""


class DelayLine(Memory):
    """The last samples of a signal (N, J), read back at a delay that may be a fraction of the sample period.

    Between two samples it interpolates linearly. Each environment and joint may have a delay of its own. A delay of
    zero returns the sample itself, bit for bit.
    """

    memory = ("_past", "_newest", "_age")

    def __init__(
        self, num_envs: int, joints: int, longest: float, dt: float, dtype: torch.dtype, device: torch.device
    ) -> None:
        """Allocate for delays up to ``longest`` s of a signal sampled every ``dt`` s."""
        self._dt = dt
        self._oldest = math.ceil(longest / dt - 1e-9)  # samples back
        slots = 1 << (self._oldest + 1).bit_length()  # a power of two: places wrap around by a mask
        self._wrap = slots - 1
        self._past = torch.zeros(slots, num_envs, joints, dtype=dtype, device=device)
        self._newest = torch.zeros(1, dtype=torch.int64, device=device)
        self._age = torch.zeros(num_envs, 1, dtype=dtype, device=device)

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Write the state back; that of an older version has as many places as the longest delay needs."""
        past, newest = state["_past"], state["_newest"]
        if len(past) < len(self._past):
            oldest_first = past.roll(-int(newest) - 1, 0)
            past, newest = torch.zeros_like(self._past), torch.full_like(newest, len(past) - 1)
            past[: len(oldest_first)] = oldest_first
        super().load_state_dict({**state, "_past": past, "_newest": newest})

    def reset(self, mask: Tensor) -> None:
        """Let the next sample stand for the whole past in the rows of ``mask`` (N,)."""
        rows = mask.unsqueeze(1)
        self._age.masked_fill_(rows, 0)
        self._past.masked_fill_(rows, 0)  # what counts nothing must be finite

    def steps(self, delay: Tensor) -> Tensor:
        """Return delays in s as numbers of samples, as :meth:`at` takes them."""
        return (delay / self._dt).clamp_(0.0, self._oldest)

    def advance(self, sample: Tensor, delay: Tensor) -> Tensor:
        """Take the newest ``sample`` (N, J) and return the signal ``delay`` (N, J) or (N, 1) s ago."""
        return self.at(sample, self.steps(delay))

    def at(self, sample: Tensor, steps: Tensor) -> Tensor:
        """Take the newest ``sample`` (N, J) and return the signal ``steps`` (N, J) or (N, 1) samples ago."""
        self._newest.add_(1).bitwise_and_(self._wrap)
        self._past.index_copy_(0, self._newest, sample.unsqueeze(0))
        steps = torch.minimum(steps, self._age).expand_as(sample).unsqueeze(0)
        self._age += 1
        index = (self._newest - steps.long()).bitwise_and_(self._wrap)
        after = self._past.gather(0, index)
        before = self._past.gather(0, index.sub_(1).bitwise_and_(self._wrap))
        return torch.lerp(after, before, steps.frac()).squeeze(0)


class CommandLine(DelayLine):
    """A delay line of targets, with one of torques that are fed forward beside it, from the first such torque on."""

    def __init__(
        self, num_envs: int, joints: int, longest: float, dt: float, dtype: torch.dtype, device: torch.device
    ) -> None:
        """Allocate as ``DelayLine`` does."""
        super().__init__(num_envs, joints, longest, dt, dtype, device)
        self._new = functools.partial(DelayLine, num_envs, joints, longest, dt, dtype, device)
        self._fed: DelayLine | None = None

    def fed(self, torque: Tensor, steps: Tensor) -> Tensor:
        """Take the newest ``torque`` (N, J) and return that of ``steps`` samples ago, as :meth:`at` does."""
        self._fed = self._fed or self._new()
        return self._fed.at(torque, steps)

    def reset(self, mask: Tensor) -> None:
        """Let the next target and torque stand for the whole past in the rows of ``mask`` (N,)."""
        super().reset(mask)
        if self._fed:
            self._fed.reset(mask)

    def state_dict(self) -> dict[str, Any]:
        """Return copies of both pasts."""
        return {**super().state_dict(), **({"fed": self._fed.state_dict()} if self._fed else {})}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Write both pasts back; without one of torques there is none."""
        super().load_state_dict(state)
        self._fed = self._new() if "fed" in state else None
        if self._fed:
            self._fed.load_state_dict(state["fed"])


@functools.cache
def constant(values: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return ``values`` (K,) as a tensor, always the same one; it must not be changed."""
    return torch.tensor(values, dtype=torch.float64).to(device=device, dtype=dtype)


def constant_like(values: tuple[float, ...], like: Tensor) -> Tensor:
    """Return ``values`` (K,) in the dtype and on the device of ``like``; they must not be changed."""
    return constant(values, like.dtype, like.device)
