"""Random numbers that belong to one environment, whatever batch it sits in.

Environment ``i`` of a batch must see the numbers that it would see alone, and adding one randomisation must not
shift another's. So every consumer has its own stream, and a number is a hash of (seed, stream, environment, counter):
splitmix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014), whose state is
just the counter. ``torch.Generator`` offers neither property. No call synchronises with the host.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torch import Tensor


def _signed(x: int) -> int:
    """Map an unsigned 64-bit constant to the int64 with the same bits."""
    return x - (1 << 64) if x >= 1 << 63 else x


_GAMMA = _signed(0x9E3779B97F4A7C15)
_MIX_1 = _signed(0xBF58476D1CE4E5B9)
_MIX_2 = _signed(0x94D049BB133111EB)


def _shift_right(z: Tensor, bits: int) -> Tensor:
    """Shift right without sign extension (torch has no unsigned arithmetic on all devices)."""
    return (z >> bits) & ((1 << (64 - bits)) - 1)


def _mix(z: Tensor) -> Tensor:
    """Finalise splitmix64: a bijection of 64-bit words in which every input bit reaches every output bit."""
    z = (z ^ _shift_right(z, 30)) * _MIX_1
    z = (z ^ _shift_right(z, 27)) * _MIX_2
    return z ^ _shift_right(z, 31)


Units = Callable[["Tensor", "Tensor", int], "Tensor"]


def unit_numbers(key: Tensor, counter: Tensor, count: int) -> Tensor:
    """Return the ``count`` numbers (N, count) after ``counter`` (1,), float32, uniform in [0, 1), of ``key`` (N, 1)."""
    index = counter + torch.arange(1, count + 1, device=key.device)
    bits = _mix(key + index * _GAMMA)
    return _shift_right(bits, 40).to(torch.float32) * 2.0**-24


class Stream:
    """The numbers of one consumer: one independent sequence per environment."""

    def __init__(self, key: Tensor, units: Units | None = None) -> None:
        """Start at the beginning.

        Args:
            key: (N, 1) int64, the environments' hash for this stream.
            units: does the arithmetic of ``unit_numbers``, faster.
        """
        self.key = key
        self._units = units or unit_numbers
        self.counter = torch.zeros(1, dtype=torch.int64, device=key.device)

    def uniform(self, *shape: int, low: float | Tensor = 0.0, high: float | Tensor = 1.0) -> Tensor:
        """Draw ``(N, *shape)`` float32, uniform from low to high (reached by rounding only); the bounds broadcast."""
        count = math.prod(shape)
        unit = self._units(self.key, self.counter, count).reshape(-1, *shape)
        self.counter += count
        return low + (high - low) * unit

    def normal(self, *shape: int) -> Tensor:
        """Draw ``(N, *shape)`` float32 from the standard normal distribution (Box and Muller, 1958)."""
        radius, angle = self.uniform(2, *shape).unbind(1)
        return torch.sqrt(-2.0 * torch.log1p(-radius)) * torch.cos(2.0 * math.pi * angle)

    def integers(self, high: int, *shape: int) -> Tensor:
        """Draw ``(N, *shape)`` int64 from 0 to ``high - 1``."""
        return (self.uniform(*shape) * high).long().clamp(max=high - 1)


class EnvRandom:
    """All streams of a batch of environments: a pure function of the seed, the environments' numbers and the counters.

    Args:
        seed: any int.
        num_envs: N.
        first_env: number of the first environment, so that env 7 of a batch can be replayed alone.
        device: where the numbers are wanted.
        shared: give every environment the numbers of the first.
        units: does the arithmetic of ``unit_numbers``, faster.
    """

    def __init__(
        self,
        seed: int,
        num_envs: int,
        first_env: int = 0,
        device: str | torch.device = "cpu",
        *,
        shared: bool = False,
        units: Units | None = None,
    ) -> None:
        self.num_envs, self.first_env, self.device = num_envs, first_env, torch.device(device)
        self._shared, self._units = shared, units
        self._streams: dict[str, Stream] = {}
        self.seed = seed

    def _key(self, name: str) -> Tensor:
        env = torch.arange(self.first_env, self.first_env + self.num_envs, device=self.device).unsqueeze(1)
        if self._shared:
            env = torch.full_like(env, self.first_env)
        start = torch.tensor(_signed((self.seed * 0x632BE59BD9B4E019 + zlib.crc32(name.encode())) % (1 << 64)))
        return _mix(_mix(start.to(self.device)) + env * _GAMMA)

    def stream(self, name: str) -> Stream:
        """Return the stream of the consumer ``name``, always the same object."""
        if name not in self._streams:
            self._streams[name] = Stream(self._key(name), self._units)
        return self._streams[name]

    def counters(self) -> dict[str, int]:
        """Return how many numbers each stream has given. Waits for the device."""
        return {name: int(stream.counter) for name, stream in self._streams.items()}

    def leave_out(self, draws: Mapping[str, int]) -> None:
        """Let as many numbers of each stream pass as ``draws`` says, unseen."""
        for name, count in draws.items():
            self._streams[name].counter += count

    def reseed(self, seed: int) -> None:
        """Start every stream again from ``seed``, in place."""
        self.seed = seed
        for name, stream in self._streams.items():
            stream.key.copy_(self._key(name))
            stream.counter.zero_()

    def state_dict(self) -> dict[str, Tensor | int]:
        """Return the seed and the counters; the keys follow from the seed."""
        counters = {name: stream.counter.clone() for name, stream in self._streams.items()}
        return {"seed": self.seed, **counters}

    def load_state_dict(self, state: dict[str, Tensor | int]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self.reseed(int(state["seed"]))
        for name, counter in state.items():
            if name != "seed":
                self.stream(name).counter.copy_(torch.as_tensor(counter))
