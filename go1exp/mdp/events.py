"""What happens to the robot during an episode, and what ends it in failure.

An event is a class called once a policy step on the live state. A termination takes a Snapshot and returns ``(N,)``
bool. The time limit is none: it truncates, and belongs to ``sim.episode_s``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import torch
from pydantic import Field

from go1exp.base.tensors.memory import Memory
from go1exp.base.tensors.randomness import Stream
from go1exp.config.schema.registry import PositiveRange, SpeedRange, event, termination
from go1exp.mdp.kinematics import KinematicState
from go1exp.mdp.types import Snapshot

if TYPE_CHECKING:
    from torch import Tensor


@event("push")
class Push(Memory):
    """Now and then the trunk's horizontal velocity is set to a random value (paper, section II-B.1).

    The paper sets the velocity where its peers add to it; it does not say for which axes: x and y of the world here.
    A wait goes on from one episode to the next, so that episodes shorter than it have pushes, too.
    """

    memory = ("time_left",)

    def __init__(
        self, stream: Stream, *, interval: PositiveRange = (10.0, 15.0), velocity: SpeedRange = (-1.0, 1.0)
    ) -> None:
        """Keep the ranges: ``interval`` between pushes in s, ``velocity`` per axis in m/s."""
        self._stream, self._interval, self._velocity = stream, interval, velocity
        self.time_left = torch.zeros(len(stream.key), device=stream.key.device)

    def advance(self, state: KinematicState, dt: float, restart: Tensor) -> None:
        """Let ``dt`` s pass; push where it is time, but not where an episode begins (``restart``, (N,))."""
        self.time_left -= dt
        over = self.time_left <= 1e-6
        due = over & ~restart
        velocity = self._stream.uniform(2, low=self._velocity[0], high=self._velocity[1])
        live = state.base_lin_vel_w[:, :2]
        live.copy_(torch.where(due.unsqueeze(1), velocity.to(live.dtype), live))
        wait = self._stream.uniform(1, low=self._interval[0], high=self._interval[1]).squeeze(1)
        self.time_left.copy_(torch.where(over, wait, self.time_left))

    def renew(self) -> None:
        """Forget the waits."""
        self.time_left.zero_()


@termination("trunk_contact")
def trunk_contact(s: Snapshot) -> Tensor:
    """Trunk, head or a hip touched the ground during this policy step."""
    return s.trunk_contact


@termination("tilt")
def tilt(s: Snapshot, *, max_angle: Annotated[float, Field(gt=0, lt=math.pi)] = 1.2) -> Tensor:
    """The trunk's z axis is more than ``max_angle`` rad off the vertical."""
    return s.projected_gravity_b[:, 2] > -torch.cos(torch.as_tensor(max_angle))
