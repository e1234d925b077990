"""Velocity commands: a class holds ``value`` (N, 3), x and y in m/s and yaw rate in rad/s, body frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from go1exp.base.tensors.memory import Memory
from go1exp.base.tensors.randomness import Stream
from go1exp.config.schema.registry import Fraction, Positive, PositiveRange, Speed, SpeedRange, command

if TYPE_CHECKING:
    from torch import Tensor

AXES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
"""Parameters that are ranges of velocities: m/s, m/s, rad/s."""
SLOW = 0.2
"""Share of the ranges that slow commands are drawn from."""


@command("uniform_velocity")
class UniformVelocity(Memory):
    """Velocities drawn uniformly per axis, held for a random time, sometimes zero (paper, section II-B.1)."""

    memory: tuple[str, ...] = ("value", "time_left")

    ground: tuple[Tensor, Tensor] | None = None
    """Level of each robot's tile (N,), which changes, and the difficulty that a level adds there (N,); None is flat."""

    def __init__(
        self,
        stream: Stream,
        *,
        lin_vel_x: SpeedRange = (-2.0, 3.0),
        lin_vel_y: SpeedRange = (-1.5, 1.5),
        ang_vel_z: SpeedRange = (-1.5, 1.5),
        hold_time: PositiveRange = (0.3, 10.0),
        standing_fraction: Fraction = 0.1,
        zero_fraction: Fraction = 0.0,
        slow_fraction: Fraction = 0.0,
        hard_share: Fraction = 1.0,
    ) -> None:
        """Keep the ranges (m/s, m/s, rad/s, s).

        Args:
            stream: where draws come from.
            lin_vel_x: range, m/s.
            lin_vel_y: range, m/s.
            ang_vel_z: range, rad/s.
            hold_time: range of the time that a command is held, s.
            standing_fraction: share of the commands that are exactly zero.
            zero_fraction: probability that an axis of another command is zero, each axis by itself: without it a
                pure command along one axis is rare.
            slow_fraction: share of the commands whose axes are all drawn from a fifth of their ranges: without it these
                are 1 in 125, and a robot that is commanded 0.2 m/s stands still.
            hard_share: share of the ranges on the hardest tiles of a height field, from 1 on flat ones; linear in
                difficulty. Source: go2_rl_gym.
        """
        device = stream.key.device
        ranges = torch.tensor([lin_vel_x, lin_vel_y, ang_vel_z, hold_time], device=device)
        self._low, self._high = ranges.unbind(1)
        self._standing_fraction = standing_fraction
        shares = {"zero_fraction": zero_fraction, "slow_fraction": slow_fraction}
        self._shares = {name: torch.tensor(share, device=device) for name, share in shares.items() if share}
        self._hard_share, self._stream = hard_share, stream
        self.value = torch.zeros(len(stream.key), 3, device=device)
        self.time_left = torch.zeros(len(stream.key), device=device)

    def advance(self, dt: float, restart: Tensor) -> None:
        """Let ``dt`` s pass; draw anew where the time is up or ``restart`` (N,) bool is set."""
        self.time_left -= dt
        due = (self.time_left <= 1e-6) | restart
        draw = self._stream.uniform(4, low=self._low, high=self._high)
        asked = self._stream.uniform(1) >= self._standing_fraction
        if "zero_fraction" in self._shares:
            asked = asked & (self._stream.uniform(3) >= self._shares["zero_fraction"])
        if "slow_fraction" in self._shares:
            asked = asked * torch.where(self._stream.uniform(1) < self._shares["slow_fraction"], SLOW, 1.0)
        self.value.copy_(torch.where(due.unsqueeze(1), draw[:, :3] * asked * self._in_force(), self.value))
        self.time_left.copy_(torch.where(due, draw[:, 3], self.time_left))

    def change(self, name: str, value: float | tuple[float, float]) -> None:
        """Change ``zero_fraction`` or ``slow_fraction``, which must not have been 0, or a range of velocities."""
        if isinstance(value, tuple):
            axis = AXES.index(name)
            self._low[axis], self._high[axis] = value
        else:
            self._shares[name].fill_(value)

    def share(self) -> Tensor | float:
        """Share of the ranges that velocities are drawn from."""
        return 1.0

    def _in_force(self) -> Tensor | float:
        """That share on the ground of each robot."""
        if self.ground is None or self._hard_share == 1.0:
            return self.share()
        level, grade = self.ground
        return self.share() * (1.0 - (1.0 - self._hard_share) * level * grade).unsqueeze(1)


@command("widening_velocity")
class WideningVelocity(UniformVelocity):
    """Uniform velocities whose ranges grow with the time that an environment has been trained: slow commands first.

    A robot that cannot walk yet earns next to nothing for trying to reach 2 m/s, and learns to ignore the command.
    """

    memory = ("value", "time_left", "age")

    def __init__(
        self,
        stream: Stream,
        *,
        start: Fraction = 0.35,
        over: Positive = 500.0,
        lin_vel_x: SpeedRange = (-2.0, 3.0),
        lin_vel_y: SpeedRange = (-1.5, 1.5),
        ang_vel_z: SpeedRange = (-1.5, 1.5),
        hold_time: PositiveRange = (0.3, 10.0),
        standing_fraction: Fraction = 0.1,
        zero_fraction: Fraction = 0.0,
        slow_fraction: Fraction = 0.0,
        hard_share: Fraction = 1.0,
    ) -> None:
        """Keep the ranges; velocities are drawn from the share ``start`` of them first, from all after ``over`` s."""
        super().__init__(
            stream,
            lin_vel_x=lin_vel_x,
            lin_vel_y=lin_vel_y,
            ang_vel_z=ang_vel_z,
            hold_time=hold_time,
            standing_fraction=standing_fraction,
            zero_fraction=zero_fraction,
            slow_fraction=slow_fraction,
            hard_share=hard_share,
        )
        self._start, self._over = start, over
        self.age = torch.zeros(len(stream.key), device=stream.key.device)

    def advance(self, dt: float, restart: Tensor) -> None:
        """Let ``dt`` s pass; draw anew where the time is up or ``restart`` (N,) bool is set."""
        self.age += dt
        super().advance(dt, restart)

    def renew(self) -> None:
        """Begin with slow commands again."""
        self.age.zero_()

    def share(self) -> Tensor:
        """(N, 1) of the ranges that velocities are drawn from."""
        return (self._start + (1.0 - self._start) * self.age / self._over).clamp(max=1.0).unsqueeze(1)


@command("fixed_velocity")
class FixedVelocity(Memory):
    """One velocity for all time; evaluation writes a row per environment into ``value``."""

    memory = ("value",)

    def __init__(
        self, stream: Stream, *, lin_vel_x: Speed = 0.5, lin_vel_y: Speed = 0.0, ang_vel_z: Speed = 0.0
    ) -> None:
        """Keep the velocity (m/s, m/s, rad/s); ``stream`` gives the number of environments alone."""
        velocity = torch.tensor([lin_vel_x, lin_vel_y, ang_vel_z], device=stream.key.device)
        self.value = velocity.repeat(len(stream.key), 1)

    def advance(self, dt: float, restart: Tensor) -> None:
        """Nothing changes with time."""
