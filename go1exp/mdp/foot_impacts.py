"""How hard each foot meets the ground, seen at every physics step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp import robot
from go1exp.base.tensors.memory import Memory

if TYPE_CHECKING:
    from torch import Tensor

IMPOSSIBLE_FORCE = 5000.0
"""Force on a foot that no robot of 13 kg makes, N: 40 body weights. A physics step went wrong.

MuJoCo Warp's height field was seen to give 300 kN now and then."""

LARGEST_PRICED_FORCE = 2000.0
"""Rewards see no larger force on a foot, N: one wrong step would outweigh a whole rollout."""


def impossible(peak_force: Tensor) -> Tensor:
    """(N,) bool, robots with a force on a foot that physics cannot have made; ``peak_force`` (N, 4), N."""
    return peak_force.amax(-1) > IMPOSSIBLE_FORCE


class FootImpacts(Memory):
    """Peak forces and touchdown speeds, (N, 4) float32; ``foot_peak_force`` and ``foot_touchdown_speed`` of a Snapshot.

    The speed is the one before the impact. A sensor's velocity belongs to the start of the physics step and its force
    acts during that step (``sim/physics/backend.py``): in the first step with a force, the velocity is not yet changed.
    """

    memory = ("peak_force", "touchdown_speed")

    def __init__(self, num_envs: int, device: torch.device) -> None:
        """Start with zeros."""
        self.peak_force, self.touchdown_speed = torch.zeros(2, num_envs, robot.NUM_LEGS, device=device).unbind(0)

    def begin_step(self) -> None:
        """Forget the forces of the last policy step."""
        self.peak_force.zero_()

    def update(self, landed: Tensor, force: Tensor, velocity: Tensor) -> None:
        """Take in the sensors' readings of one physics step.

        Args:
            landed: (N, 4) bool, the feet whose swing ended in it.
            force: (N, 4, 3) of the ground on each foot, N.
            velocity: (N, 4, 3) of the foot centres in the world's frame at the start of the step, m/s.
        """
        self.peak_force.copy_(torch.maximum(self.peak_force, torch.linalg.vector_norm(force, dim=-1)))
        descent = velocity[..., 2].neg().clamp(min=0.0)
        self.touchdown_speed.copy_(torch.where(landed, descent, self.touchdown_speed))

    def reset(self, mask: Tensor) -> None:
        """Zero the rows of ``mask`` (N,) bool."""
        rows = mask.unsqueeze(1)
        for name in self.memory:
            getattr(self, name).masked_fill_(rows, 0.0)
