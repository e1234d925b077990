"""Feet over all physics steps of a policy step: swing and stance times, touchdowns, peak forces, touchdown speeds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

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


class Feet(Memory):
    """Feet of N robots, fed with the sensors' readings at every physics step; all values are (N, 4).

    ``air`` and ``contact`` are the running phases, one of them zero; ``last_air`` and ``last_contact`` the last
    completed ones, s; ``touchdown`` (bool) is true where a swing ended since ``begin_step``. ``peak_force``, N, is the
    largest since then. ``touchdown_speed``, m/s, is the one before the impact: a sensor's velocity belongs to the start
    of the physics step and its force acts during that step (``sim/physics/backend.py``), so in the first step with a
    force the velocity is not yet changed.
    """

    timers = ("air", "contact", "last_air", "last_contact", "touchdown")
    impacts = ("peak_force", "touchdown_speed")
    memory = (*timers, *impacts)

    def __init__(self, num_envs: int, dt: float, device: torch.device) -> None:
        """Start with zeros; ``dt`` is the physics step, s."""
        shape = (num_envs, robot.NUM_LEGS)
        self._dt = dt
        self.air, self.contact, self.last_air, self.last_contact = torch.zeros(4, *shape, device=device).unbind(0)
        self.touchdown = torch.zeros(shape, dtype=torch.bool, device=device)
        self.peak_force, self.touchdown_speed = torch.zeros(2, *shape, device=device).unbind(0)

    def begin_step(self) -> None:
        """Forget touchdowns and forces of the last policy step."""
        self.touchdown.zero_()
        self.peak_force.zero_()

    def update(self, force: Tensor, velocity: Tensor) -> None:
        """Let one physics step pass.

        Args:
            force: (N, 4, 3) of the ground on each foot, N; the vertical one is exactly zero where there is none.
            velocity: (N, 4, 3) of the foot centres in the world's frame at the start of the step, m/s.
        """
        landed = self.touch(force[..., 2] != 0)
        self.peak_force.copy_(torch.maximum(self.peak_force, torch.linalg.vector_norm(force, dim=-1)))
        descent = velocity[..., 2].neg().clamp(min=0.0)
        self.touchdown_speed.copy_(torch.where(landed, descent, self.touchdown_speed))

    def touch(self, touching: Tensor) -> Tensor:
        """Let one physics step pass for the times, with feet (N, 4) bool that bore force; return which landed."""
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
        for name in self.memory:
            getattr(self, name).masked_fill_(mask.unsqueeze(1), 0)

    def snapshot_fields(self) -> dict[str, Tensor]:
        """Return the fields of a Snapshot that this knows, (N, 4) each, live but for ``foot_contact``."""
        return {
            "foot_contact": self.contact > 0,
            "foot_air_time": self.air,
            "foot_contact_time": self.contact,
            "foot_last_air_time": self.last_air,
            "foot_last_contact_time": self.last_contact,
            "foot_touchdown": self.touchdown,
            "foot_peak_force": self.peak_force,
            "foot_touchdown_speed": self.touchdown_speed,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return copies of what is remembered, in two parts."""
        state = super().state_dict()
        return {part: {n: state[n] for n in getattr(self, part)} for part in ("timers", "impacts")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, in place."""
        super().load_state_dict({**state["timers"], **state["impacts"]})
