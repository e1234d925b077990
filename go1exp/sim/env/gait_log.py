"""Figures of gait and contact for the log of a training: sums over steps and robots, cheap enough for every step.

They follow ``go1exp/mdp/measures`` where that costs nothing, and say where they do not: they show where a training is
going, ``go1exp eval`` shows what came out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp import robot
from go1exp.base.tensors.memory import Memory
from go1exp.mdp.derived import slip_speed
from go1exp.mdp.foot_impacts import impossible
from go1exp.mdp.measures.gait import GAITS

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.mdp.types import Snapshot

LONGEST_STRIDE = 1.0
"""Strides that take longer have no phases, s."""

FAST = 0.2
"""Speed at which a foot on the ground slips, m/s."""

LEGS = robot.NUM_LEGS
FR = robot.LEGS.index("FR")
OTHERS = slice(FR + 1, LEGS)  # a list of indices would be copied to the GPU at each step
TROT = GAITS["trot"][OTHERS]
"""Touchdown of FL, RR and RL after FR in a trot, cycles."""

WIDTHS = {
    **{"moving": 1, "touchdowns": LEGS, "contacts": LEGS, "forces": LEGS, "errors": 3, "phases": 3},
    **{"fast": 1, "on_ground": 1, "peaks": 1, "stances": 1, "speeds": 1, "landings": 1},
}
"""Sums and how many numbers each of them is."""


class GaitLog(Memory):
    """Sums since the last ``drain``, and what each robot needs of its past; nothing branches on data."""

    memory = ("sums", "largest", "since", "period", "stance_peak")

    def __init__(self, num_envs: int, dt: float, device: torch.device) -> None:
        """Start with nothing; ``dt`` is the policy's period, s."""
        self._dt = dt
        self.sums = torch.zeros(sum(WIDTHS.values()), dtype=torch.float64, device=device)
        self.largest, self.impossible = torch.zeros(2, device=device).unbind(0)
        self.since = torch.full((num_envs,), torch.inf, device=device)  # FR's last touchdown, s ago
        self.period = torch.zeros(num_envs, device=device)  # of its last stride, s
        self.stance_peak = torch.zeros(num_envs, LEGS, device=device)
        self._trot = torch.tensor(TROT, device=device)

    def add(self, s: Snapshot) -> None:
        """Take in a policy step, before ended episodes begin anew."""
        assert s.foot_peak_force is not None
        assert s.foot_touchdown_speed is not None
        moving = (s.command != 0.0).any(-1, keepdim=True)
        landed = s.foot_touchdown & moving
        contact = s.foot_contact.float()
        errors, phases = self._phase_errors(s, landed)
        fast = contact * (slip_speed(s) > FAST)
        peak = torch.maximum(self.stance_peak, s.foot_peak_force)
        ended = ~s.foot_contact & (peak > 0.0)
        self.stance_peak.copy_(torch.where(s.foot_contact, peak, 0.0))
        self.largest.copy_(torch.maximum(self.largest, s.foot_peak_force.max()))
        self.impossible.add_(impossible(s.foot_peak_force).sum())
        feet = [fast, contact, peak * ended, ended, s.foot_touchdown_speed * s.foot_touchdown, s.foot_touchdown]
        columns = [moving, landed, contact * moving, s.foot_force * moving, errors, phases]
        columns += [each.sum(-1, keepdim=True) for each in feet]
        self.sums += torch.cat([c.float() for c in columns], -1).sum(0, dtype=torch.float64)

    def _phase_errors(self, s: Snapshot, landed: Tensor) -> tuple[Tensor, Tensor]:
        """(N, 3) each: distance to the trot of FL, RR and RL where they landed, in cycles, and where they did.

        The phase is the time since FR's touchdown over FR's last stride. Instants are known to the physics step:
        a foot's contact time tells how long ago it landed.
        """
        elapsed = self.since + self._dt
        ago = s.foot_contact_time[:, FR]
        self.period.copy_(torch.where(landed[:, FR], elapsed - ago, self.period))
        self.since.copy_(torch.where(landed[:, FR], ago, elapsed))
        known = (self.period > 0.0) & (self.period < LONGEST_STRIDE) & (self.since < LONGEST_STRIDE)
        phases = landed[:, OTHERS] & known.unsqueeze(-1)
        turn = (self.since.unsqueeze(-1) - s.foot_contact_time[:, OTHERS]) / self.period.unsqueeze(-1)
        error = ((turn - self._trot + 0.5).remainder(1.0) - 0.5).abs()
        return torch.where(phases, error, 0.0), phases

    def reset(self, mask: Tensor) -> None:
        """Forget the past of the rows of ``mask`` (N,)."""
        self.since.masked_fill_(mask, torch.inf)
        self.period.masked_fill_(mask, 0.0)
        self.stance_peak.masked_fill_(mask.unsqueeze(-1), 0.0)

    def drain(self) -> dict[str, float]:
        """Return the figures since the last call; NaN where nothing happened. ``gait/`` is of robots told to move.

        ``gait/stride_rate``: touchdowns of a foot per second, Hz, bounces that a policy step tells apart included.
        ``gait/trot_error``: mean circular distance of touchdowns to a trot's, cycles, of the worst foot; 0.25 for
        random ones, and never less than the measure, which averages phases first. ``gait/duty_mean``, ``duty_spread``
        (largest less smallest foot), ``gait/load_share_min``: of the batch's mean force. ``contact/slip_share``,
        ``contact/peak_force``: mean over stances of the largest force, N. ``contact/touchdown_speed``: mean, m/s.
        ``contact/largest_force``: of all, N. ``contact/impossible``: steps with a force that physics cannot make
        (``mdp/foot_impacts.py``), each the end of an episode.
        """
        sums = dict(zip(WIDTHS, self.sums.split(list(WIDTHS.values())), strict=True))
        duty, force = sums["contacts"] / sums["moving"], sums["forces"]
        figures = {
            "gait/stride_rate": sums["touchdowns"].mean() / (sums["moving"] * self._dt),
            "gait/trot_error": (sums["errors"] / sums["phases"]).max(),
            "gait/duty_mean": duty.mean(),
            "gait/duty_spread": duty.max() - duty.min(),
            "gait/load_share_min": force.min() / force.sum(),
            "contact/slip_share": sums["fast"] / sums["on_ground"],
            "contact/peak_force": sums["peaks"] / sums["stances"],
            "contact/touchdown_speed": sums["speeds"] / sums["landings"],
            "contact/largest_force": self.largest,
            "contact/impossible": self.impossible,
        }
        values = torch.stack([v.reshape(()).double() for v in figures.values()]).tolist()
        self.sums.zero_()
        self.largest.zero_()
        self.impossible.zero_()
        return dict(zip(figures, values, strict=True))
