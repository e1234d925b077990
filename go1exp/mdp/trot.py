"""Reward ``trot``: the gait row of Table III, free of time scale, duty factor and bounces."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from go1exp.base.tensors.memory import Memory
from go1exp.config.schema.registry import NonNegative, Positive, reward
from go1exp.mdp.derived import ASYNC_PAIRS, SYNC_PAIRS, is_moving, since_last_contact_began
from go1exp.mdp.types import Snapshot, TermSetup

if TYPE_CHECKING:
    from torch import Tensor

SHORTEST_CYCLE, LONGEST_CYCLE = 0.04, 1.0
"""Between these a foot's cycle counts as one, s: two policy steps, and a foot that was left standing."""

BOUNCE, BOUNCE_SHARE = 0.03, 0.2
"""A swing shorter than this, s, and than this share of the foot's last cycle, is a bounce (chosen): as they lift off,
simulated feet touch the ground again for some milliseconds, and as they land they come off it again."""


@reward("trot")
class Trot(Memory):
    """Trot at any stride rate: product of two synchrony and four asynchrony factors of phases; 0 while standing.

    sync(i, j) = exp(-(1 - cos(p_i - p_j)) / scale) over diagonal legs, async(i, j) = exp(-(1 + cos(p_i - p_j)) / scale)
    over the other pairs; p is the phase of a foot, from touchdown to touchdown. Pace, bound and pronk earn
    exp(-8 / scale). The exponent is that of four equally coupled oscillators, which have one stable state: from almost
    all phases there is a way up to the trot (``docs/paper.md``). A foot that does not touch down anew after one cycle
    loses its phase within the next, and its cosines go to zero. Cycles shorter than ``full_cycle`` s earn in proportion
    to their length, mean of the feet. In (0, 1]. Source: the product is Table III's, whose factors are not printed;
    these are von Mises distributions.
    """

    memory = ("since", "cycle", "swing")

    def __init__(
        self,
        setup: TermSetup,
        *,
        scale: Positive = 2.0,
        full_cycle: NonNegative = 0.0,
        speed_threshold: NonNegative = 0.5,
    ) -> None:
        """Start without phases; ``scale`` without unit, ``full_cycle`` in s, ``speed_threshold`` in m/s."""
        self._dt, self._scale, self._speed_threshold = setup.dt, scale, speed_threshold
        self._full_cycle = full_cycle
        self.since = setup.zeros(4)  # s since the touchdown that began the cycle
        self.cycle = setup.zeros(4)  # s, the last cycle's length
        self.swing = setup.zeros(4)  # s, longest time in the air since then
        self.reset(torch.ones(setup.num_envs, dtype=torch.bool, device=setup.device))

    def reset(self, mask: Tensor) -> None:
        """Take the phases of the rows of ``mask`` (N,) away."""
        rows = mask.unsqueeze(1)
        self.since.masked_fill_(rows, 2.0 * LONGEST_CYCLE)
        self.cycle.masked_fill_(rows, LONGEST_CYCLE)
        self.swing.masked_fill_(rows, 0.0)

    def __call__(self, s: Snapshot) -> Tensor:
        """(N,) of one policy step."""
        self._follow(s)
        phase = self.since / self.cycle
        length, angle = (2.0 - phase).clamp(0.0, 1.0), 2.0 * math.pi * phase
        x, y = length * torch.cos(angle), length * torch.sin(angle)
        error = torch.zeros_like(x[:, 0])
        for pairs, sign in ((SYNC_PAIRS, 1.0), (ASYNC_PAIRS, -1.0)):
            for i, j in pairs:
                error = error + 1.0 - sign * (x[:, i] * x[:, j] + y[:, i] * y[:, j])
        long_enough = (self.cycle.mean(-1) / self._full_cycle).clamp(max=1.0)
        return torch.exp(-error / self._scale) * long_enough * is_moving(s, self._speed_threshold)

    def _follow(self, s: Snapshot) -> None:
        """Let one policy step pass for the phases."""
        self.since += self._dt
        torch.maximum(self.swing, torch.where(s.foot_touchdown, s.foot_last_air_time, s.foot_air_time), out=self.swing)
        lost = self.since > 2.0 * self.cycle
        landed = s.foot_touchdown & ((self.swing >= (BOUNCE_SHARE * self.cycle).clamp(max=BOUNCE)) | lost)
        late = torch.minimum(since_last_contact_began(s), torch.full_like(self.since, self._dt))
        length = self.since - late
        # A first step is the beginning of no cycle: any second one ends the shortest.
        cycle = torch.where(length > LONGEST_CYCLE, torch.zeros_like(length), length).clamp(min=SHORTEST_CYCLE)
        self.cycle.copy_(torch.where(landed, cycle, self.cycle))
        self.since.copy_(torch.where(landed, late, self.since))
        self.swing.copy_(torch.where(landed, s.foot_air_time, self.swing))
