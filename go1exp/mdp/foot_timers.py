"""How long each foot has been in the air or on the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp import robot
from go1exp.base.tensors.memory import Memory

if TYPE_CHECKING:
    from torch import Tensor


class FootTimers(Memory):
    """Running and last completed swing and stance times, (N, 4), s, at the physics rate as Isaac Lab's sensor has them.

    ``air`` and ``contact`` are the running phases, one of them zero; ``last_air`` and ``last_contact`` the last
    completed ones; ``touchdown`` (bool) tells whether a swing ended since ``begin_step``.
    """

    memory = ("air", "contact", "last_air", "last_contact", "touchdown")

    def __init__(self, num_envs: int, dt: float, device: torch.device) -> None:
        """Start with all times zero; ``dt`` is the physics step, s."""
        shape = (num_envs, robot.NUM_LEGS)
        self._dt = dt
        self.air, self.contact, self.last_air, self.last_contact = torch.zeros(4, *shape, device=device).unbind(0)
        self.touchdown = torch.zeros(shape, dtype=torch.bool, device=device)

    def begin_step(self) -> None:
        """Forget the touchdowns of the last policy step."""
        self.touchdown.zero_()

    def update(self, touching: Tensor) -> Tensor:
        """Let one physics step pass in which the feet of ``touching`` (N, 4) bool bore force; return who landed."""
        landed = touching & (self.air > 0)
        lifted = ~touching & (self.contact > 0)
        self.last_air.copy_(torch.where(landed, self.air + self._dt, self.last_air))
        self.last_contact.copy_(torch.where(lifted, self.contact + self._dt, self.last_contact))
        self.air.add_(self._dt).mul_(~touching)
        self.contact.add_(self._dt).mul_(touching)
        self.touchdown.logical_or_(landed)
        return landed

    def reset(self, mask: Tensor) -> None:
        """Zero the rows of ``mask`` (N,) bool."""
        keep = ~mask.unsqueeze(1)
        for name in self.memory:
            getattr(self, name).mul_(keep)
