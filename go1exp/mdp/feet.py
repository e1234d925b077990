"""Feet over all physics steps of a policy step: swing and stance times, touchdowns, peak forces, touchdown speeds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from go1exp import robot
from go1exp.base.tensors.memory import Memory

if TYPE_CHECKING:
    from torch import Tensor


class FootTimers(Memory):
    """Running and last completed swing and stance times, (N, 4), s, at the physics rate as Isaac Lab's sensor has them.

    ``air`` and ``contact`` are the running phases, one of them zero; ``last_air`` and ``last_contact`` the last
    completed ones; ``touchdown`` (bool) is true where a swing ended since ``begin_step``.
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


class Feet:
    """Timers and impacts of N robots' feet, fed with the sensors' readings at every physics step."""

    def __init__(self, num_envs: int, dt: float, device: torch.device) -> None:
        """Start with zeros; ``dt`` is the physics step, s."""
        self.timers = FootTimers(num_envs, dt, device)
        self.impacts = FootImpacts(num_envs, device)

    def begin_step(self) -> None:
        """Forget touchdowns and forces of the last policy step."""
        self.timers.begin_step()
        self.impacts.begin_step()

    def update(self, force: Tensor, velocity: Tensor) -> None:
        """Let one physics step pass, with forces (N, 4, 3), N, and velocities (N, 4, 3), m/s, of the sensors."""
        landed = self.timers.update(force[..., 2] != 0)  # the vertical force: exactly zero if there is none
        self.impacts.update(landed, force, velocity)

    def reset(self, mask: Tensor) -> None:
        """Zero the rows of ``mask`` (N,) bool."""
        self.timers.reset(mask)
        self.impacts.reset(mask)

    def snapshot_fields(self) -> dict[str, Tensor]:
        """Return the fields of a Snapshot that this knows, (N, 4) each, live but for ``foot_contact``."""
        timers, impacts = self.timers, self.impacts
        return {
            "foot_contact": timers.contact > 0,
            "foot_air_time": timers.air,
            "foot_contact_time": timers.contact,
            "foot_last_air_time": timers.last_air,
            "foot_last_contact_time": timers.last_contact,
            "foot_touchdown": timers.touchdown,
            "foot_peak_force": impacts.peak_force,
            "foot_touchdown_speed": impacts.touchdown_speed,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return copies of what is remembered."""
        return {"timers": self.timers.state_dict(), "impacts": self.impacts.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``, in place."""
        self.timers.load_state_dict(state["timers"])
        self.impacts.load_state_dict(state["impacts"])
