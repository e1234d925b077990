"""What robots observe beyond the values of the terms: their noise, and what earlier steps saw.

A term's newest value is its frame. With ``history: k`` a term has k times its columns: the frame, that of one policy
step before, and so on, each with the noise that it had when it was new.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from go1exp.base.tensors.memory import Memory
from go1exp.config.schema.history import frame_width, history_columns
from go1exp.config.schema.registry import Term
from go1exp.mdp.types import TermSetup


class Frames(Memory):
    """Adds noise to the frames of N robots and puts earlier ones behind them.

    Attributes:
        size: F, numbers in a frame of all terms.
        noise: (F,) half-width of the uniform distribution of each number's noise.
        past: (N, H) earlier frames of the terms with a history: term by term, the newest first.
        error: (N, C) present noise of the numbers whose noise is correlated in time.
    """

    def __init__(self, terms: Sequence[Term], setup: TermSetup) -> None:
        """Prepare for the observations ``terms``."""
        widths = [frame_width(t) for t in terms]
        self.size = sum(widths)

        def numbers(slot: str) -> Tensor:
            each = torch.tensor([float(t.slots.get(slot, 0.0)) for t in terms])
            return each.repeat_interleave(torch.tensor(widths)).to(setup.device)

        def indices(columns: Sequence[int]) -> Tensor:
            return torch.tensor(columns, dtype=torch.int64, device=setup.device)

        self.noise = numbers("noise")
        kept = torch.exp(-setup.dt / numbers("correlation_time"))  # 0 for a time of 0
        self._correlated = kept.nonzero().squeeze(1)
        self._kept = kept[self._correlated]
        columns = history_columns(terms)
        self._newest, self._carried = indices(columns.newest), indices(columns.carried)
        earlier = set(columns.earlier)
        frames, past = iter(range(self.size)), iter(range(self.size, self.size + len(earlier)))
        self._order = indices([next(past if k in earlier else frames) for k in range(self.size + len(earlier))])
        self.past, self.error = setup.zeros(len(earlier)), setup.zeros(len(self._kept))
        self.memory = tuple(name for name in ("past", "error") if getattr(self, name).shape[1])

    def ended(self, frame: Tensor, unit: Tensor | None) -> Tensor:
        """Return the observation (N, O) at the end of a step, before any robot begins anew.

        Args:
            frame: (N, F) values of the terms.
            unit: (N, F) uniform from -1 to 1; None for no noise.
        """
        if unit is not None:
            if len(self._kept):
                fresh = torch.sqrt(1.0 - self._kept**2) * self._drawn(unit)
                self.error.copy_(self._kept * self.error + fresh)
            frame = self._noisy(frame, unit)
        return self._with_past(frame)

    def begun(self, frame: Tensor, unit: Tensor | None, anew: Tensor) -> Tensor:
        """Return what the policy sees next (N, O), and keep its frame for later steps.

        Args:
            frame: as for ``ended``.
            unit: as for ``ended``.
            anew: (N,) bool, robots whose episode begins: their earlier frames are all the first one.
        """
        rows = anew.unsqueeze(1)
        if unit is not None:
            if len(self._kept):
                self.error.copy_(torch.where(rows, self._drawn(unit), self.error))
            frame = self._noisy(frame, unit)
        if not self.past.shape[1]:
            return frame
        self.past.copy_(torch.where(rows, self._with_past(frame)[:, self._newest], self.past))
        observation = self._with_past(frame)
        self.past.copy_(observation[:, self._carried])
        return observation

    def _drawn(self, unit: Tensor) -> Tensor:
        """Return new noise (N, C) of the numbers whose noise is correlated."""
        return (unit * self.noise)[:, self._correlated]

    def _noisy(self, frame: Tensor, unit: Tensor) -> Tensor:
        """Return frames (N, F) with noise: drawn anew, or as the correlated one is now."""
        noise = unit * self.noise
        return frame + (noise.index_copy(1, self._correlated, self.error) if len(self._kept) else noise)

    def _with_past(self, frame: Tensor) -> Tensor:
        """Return frames (N, F) with the earlier ones of each term behind it, (N, O)."""
        return torch.cat([frame, self.past], dim=1)[:, self._order] if self.past.shape[1] else frame
