"""Figures of the task for the log of a training: how episodes end, how commands are followed, and both by command."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.base.tensors.memory import Memory

if TYPE_CHECKING:
    from torch import Tensor

    from go1exp.mdp.types import Snapshot

KINDS = ("stand", "slow", "medium", "fast")
"""Commands: all zero; then by their horizontal speed. Turning on the spot is slow."""

SPEEDS = (0.5, 1.25)
"""Where medium and fast begin, m/s."""

WIDTHS = {
    **{"steps": 1, "errors": 3, "falls": 1, "timeouts": 1, "others": 1},
    **dict.fromkeys(("kind_steps", "kind_errors", "kind_ends", "kind_returns", "kind_lengths"), len(KINDS)),
}
"""Sums and how many numbers each of them is."""


class TaskLog(Memory):
    """Sums over steps and robots since the last ``drain``; nothing branches on data, nothing waits for the device."""

    memory = ("sums",)

    def __init__(self, dt: float, device: torch.device) -> None:
        """Start with nothing; ``dt`` is the policy's period, s."""
        self._dt = dt
        self.sums = torch.zeros(sum(WIDTHS.values()), dtype=torch.float64, device=device)

    def add(self, s: Snapshot, ends: tuple[Tensor, Tensor, Tensor], episode: tuple[Tensor, Tensor]) -> None:
        """Take in a policy step, before ended episodes begin anew.

        Args:
            s: the moment.
            ends: whether an episode ended by a fall, at its time limit, or cut short for another reason, (N,) bool.
            episode: return and length in steps so far, (N,) each.
        """
        assert s.base_lin_vel_b is not None
        assert s.base_ang_vel_b is not None
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
        parts = dict(zip(WIDTHS, self.sums.split(list(WIDTHS.values())), strict=True))
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
