"""What a Snapshot says of the feet beyond the last substep: phases, touchdowns and impacts over all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from go1exp.mdp.foot_impacts import FootImpacts
from go1exp.mdp.foot_timers import FootTimers

if TYPE_CHECKING:
    import torch
    from torch import Tensor


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
