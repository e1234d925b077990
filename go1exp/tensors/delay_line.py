"""A signal as it was some time ago."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp.tensors.memory import Memory

if TYPE_CHECKING:
    from torch import Tensor


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
        self._dt, self._longest = dt, longest
        self._depth = math.ceil(longest / dt - 1e-9) + 2
        self._past = torch.zeros(self._depth, num_envs, joints, dtype=dtype, device=device)
        self._newest = torch.zeros(1, dtype=torch.int64, device=device)
        self._age = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)

    def twin(self) -> DelayLine:
        """Return an empty line for another signal (N, J) of the same kind."""
        _, n, joints = self._past.shape
        return DelayLine(n, joints, self._longest, self._dt, self._past.dtype, self._past.device)

    def restored(self, state: dict[str, Tensor] | None) -> DelayLine | None:
        """Return a twin with the state of one; None for None."""
        if state is None:
            return None
        twin = self.twin()
        twin.load_state_dict(state)
        return twin

    def reset(self, mask: Tensor) -> None:
        """Let the next sample stand for the whole past in the rows of ``mask`` (N,)."""
        self._age.masked_fill_(mask.unsqueeze(1), 0)

    def advance(self, sample: Tensor, delay: Tensor) -> Tensor:
        """Take the newest ``sample`` (N, J) and return the signal ``delay`` (N, J) or (N, 1) s ago."""
        self._newest.add_(1).remainder_(self._depth)
        self._past.index_copy_(0, self._newest, sample.unsqueeze(0))
        steps = torch.minimum((delay / self._dt).clamp(0.0, self._depth - 2), self._age).expand_as(sample)
        self._age += 1
        whole = steps.floor()
        share = steps - whole
        index = (self._newest - whole.long()).remainder_(self._depth).unsqueeze(0)
        a = self._past.gather(0, index).squeeze(0)
        b = self._past.gather(0, index.sub_(1).remainder_(self._depth)).squeeze(0)
        return torch.where(share == 0, a, torch.lerp(a, b, share))
