"""Metrics of a training: gait, contact and task, as sums over steps and robots that are cheap enough for every step.

They follow ``go1exp/mdp/measures`` where that costs nothing; docstrings name the differences. Nothing branches on data
or waits for the device.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.memory import Memory
from go1exp.mdp.derived import slip_speed
from go1exp.mdp.feet import impossible
from go1exp.mdp.measures.gait import GAITS

if TYPE_CHECKING:
    from go1exp.mdp.types import Snapshot


LONGEST_STRIDE = 1.0
"""Strides that take longer have no phases, s."""

FAST = 0.2
"""Speed at which a foot on the ground slips, m/s."""

BOUNCE = 0.03
"""A swing shorter than this is a bounce, s (chosen): feet come off stiff ground for some milliseconds as they land and
as they lift off."""

LEGS = robot.NUM_LEGS
FR = robot.LEGS.index("FR")
OTHERS = slice(FR + 1, LEGS)  # a list of indices would be copied to the GPU at each step
TROT = GAITS["trot"][OTHERS]
"""Touchdown of FL, RR and RL after FR in a trot, cycles."""

GAIT_SUMS = {
    **{"moving": 1, "touchdowns": LEGS, "contacts": LEGS, "forces": LEGS, "errors": 3, "phases": 3},
    **{"fast": 1, "on_ground": 1, "peaks": 1, "stances": 1, "speeds": 1, "landings": 1},
}
"""Sums and how many numbers each of them is."""


class GaitLog(Memory):
    """Gait and contact: sums since the last ``drain``, and the past that each robot's phases need."""

    memory = ("sums", "largest", "since", "period", "swing", "stance_peak")

    def __init__(self, num_envs: int, dt: float, device: torch.device) -> None:
        """Start with nothing; ``dt`` is the policy's period, s."""
        self._dt = dt
        self.sums = torch.zeros(sum(GAIT_SUMS.values()), dtype=torch.float64, device=device)
        self.largest, self.impossible = torch.zeros(2, device=device).unbind(0)
        self.since = torch.full((num_envs,), torch.inf, device=device)  # FR's last touchdown, s ago
        self.period = torch.zeros(num_envs, device=device)  # of its last stride, s
        self.swing = torch.zeros(num_envs, LEGS, device=device)  # longest since the last touchdown that counted, s
        self.stance_peak = torch.zeros(num_envs, LEGS, device=device)
        self._trot = torch.tensor(TROT, device=device)

    def add(self, s: Snapshot) -> None:
        """Take in a policy step, before ended episodes begin anew."""
        moving = (s.command != 0.0).any(-1, keepdim=True)
        airborne = torch.where(s.foot_touchdown, s.foot_last_air_time, s.foot_air_time)
        swing = torch.maximum(self.swing, airborne)
        touchdown = s.foot_touchdown & (swing > BOUNCE)
        self.swing.copy_(torch.where(touchdown, s.foot_air_time, swing))
        landed = touchdown & moving
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
        """(N, 3) each: distance to the trot of FL, RR and RL where they landed, in cycles, and a mask.

        The phase is the time since FR's touchdown over FR's last stride. Instants are known to the physics step:
        a foot's contact time is the time since it landed.
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
        self.swing.masked_fill_(mask.unsqueeze(-1), 0.0)
        self.stance_peak.masked_fill_(mask.unsqueeze(-1), 0.0)

    def drain(self) -> dict[str, float]:
        """Return the metrics since the last call; NaN where nothing happened.

        ``gait/`` is of robots with a non-zero command.

        ``gait/stride_rate``: touchdowns of a foot per second, Hz, without bounces (``BOUNCE``).
        ``gait/trot_error``: mean circular distance of touchdowns to a trot's, cycles, of the worst foot; 0.25 for
        random ones, and never less than the measure, which averages phases first. ``gait/duty_mean``, ``duty_spread``
        (largest less smallest foot), ``gait/load_share_min``: of the batch's mean force. ``contact/slip_share``,
        ``contact/peak_force``: mean over stances of the largest force, N. ``contact/touchdown_speed``: mean, m/s.
        ``contact/largest_force``: of all, N. ``contact/impossible``: steps with a force that physics cannot make
        (``mdp/feet.py``), each the end of an episode.
        """
        sums = dict(zip(GAIT_SUMS, self.sums.split(list(GAIT_SUMS.values())), strict=True))
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


KINDS = ("stand", "slow", "medium", "fast")
"""Commands: all zero; then by their horizontal speed. Turning on the spot is slow."""

SPEEDS = (0.5, 1.25)
"""Where medium and fast begin, m/s."""

TASK_SUMS = {
    **{"steps": 1, "errors": 3, "falls": 1, "timeouts": 1, "others": 1},
    **dict.fromkeys(("kind_steps", "kind_errors", "kind_ends", "kind_returns", "kind_lengths"), len(KINDS)),
}
"""Sums and how many numbers each of them is."""


class TaskLog(Memory):
    """How episodes end and how commands are tracked, in all and by kind of command: sums since the last ``drain``."""

    memory = ("sums",)

    def __init__(self, dt: float, device: torch.device) -> None:
        """Start with nothing; ``dt`` is the policy's period, s."""
        self._dt = dt
        self.sums = torch.zeros(sum(TASK_SUMS.values()), dtype=torch.float64, device=device)

    def add(self, s: Snapshot, ends: tuple[Tensor, Tensor, Tensor], episode: tuple[Tensor, Tensor]) -> None:
        """Take in a policy step, before ended episodes begin anew.

        Args:
            s: the moment.
            ends: whether an episode ended by a fall, at its time limit, or cut short for another reason, (N,) bool.
            episode: return and length in steps so far, (N,) each.
        """
        command = s.command
        velocity = torch.cat([s.base_lin_vel_b[:, :2], s.base_ang_vel_b[:, 2:]], -1)
        errors = (velocity - command).square()
        speed, moving = command[:, :2].norm(dim=-1), (command != 0.0).any(-1)
        medium, fast = speed >= SPEEDS[0], speed >= SPEEDS[1]
        kinds = torch.stack([~moving, moving & ~medium, medium & ~fast, fast], -1).float()
        ended = (ends[0] | ends[1] | ends[2]).float()
        one = torch.ones_like(ended)
        columns = torch.stack([one, *(each.float() for each in ends)], -1)
        # Rows: what is summed up for each kind of command.
        each = torch.stack([one, errors[:, :2].sum(-1), ended, ended * episode[0], ended * episode[1]])
        totals = columns.sum(0, dtype=torch.float64)
        by_kind = (each.double() @ kinds.double()).flatten()
        self.sums += torch.cat([totals[:1], errors.sum(0, dtype=torch.float64), totals[1:], by_kind])

    def drain(self) -> dict[str, float]:
        """Return the figures since the last call; NaN where nothing happened.

        ``task/fall_share``, ``task/timeout_share``: of the episodes that ended. ``task/falls_per_minute``: of a robot.
        ``tracking/rmse_x``, ``rmse_y``, m/s, ``rmse_yaw``, rad/s: of all steps, exploration noise included.
        ``command_KIND/return``, ``length`` (steps): mean of the episodes that ended under such a command;
        ``command_KIND/rmse_xy``: horizontal error under it, m/s.
        """
        parts = dict(zip(TASK_SUMS, self.sums.split(list(TASK_SUMS.values())), strict=True))
        ends = parts["falls"] + parts["timeouts"] + parts["others"]
        figures = {
            "task/fall_share": parts["falls"] / ends,
            "task/timeout_share": parts["timeouts"] / ends,
            "task/falls_per_minute": parts["falls"] / (parts["steps"] * self._dt / 60.0),
        }
        rmse = (parts["errors"] / parts["steps"]).sqrt()
        figures |= {f"tracking/rmse_{axis}": rmse[k] for k, axis in enumerate(("x", "y", "yaw"))}
        of_kinds = {
            "return": parts["kind_returns"] / parts["kind_ends"],
            "length": parts["kind_lengths"] / parts["kind_ends"],
            "rmse_xy": (parts["kind_errors"] / parts["kind_steps"]).sqrt(),
        }
        figures |= {f"command_{kind}/{name}": v[k] for name, v in of_kinds.items() for k, kind in enumerate(KINDS)}
        values = torch.stack([v.reshape(()) for v in figures.values()]).tolist()
        self.sums.zero_()
        return dict(zip(figures, values, strict=True))
