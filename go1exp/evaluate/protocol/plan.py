"""What robots are to do, and what they did, over time."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from go1exp.evaluate.observed import TrunkVelocity
from go1exp.sim.terrain import TerrainConfig

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.disturbances import Impulses
    from go1exp.mdp.measures.trace import Trace

Array = NDArray[np.float64]

STEP_BYTES = 8 * (3 + 3 + 3 + 3) + 1
"""What a robot's policy step takes in a plan (``command``) and its motion, without a trace."""


@dataclass(frozen=True)
class Plan:
    """What N robots are to do.

    Attributes:
        command: (T, N, 3) commanded velocity of each policy step.
        impulses: kicks, or None.
        ground: what they walk on.
        friction: range of the feet's friction on it, in place of the randomisation's; None keeps that.
        delay: (N,) s by which targets come late, beside what the robot has; None for none.
        policy_dt: period of the policy, s; None keeps that of the stage.
        listen_from: policy step from which contacts, torques and the like are recorded; None records none.
        steer: turn the robots back into their lanes: yaw rate per rad of heading and per m beside the lane; None
            does not.
        trunk_velocity: what the policy sees of it; None keeps that of the stage.
        finish: way along the world's x, m, after which a robot is done: when all are, or are down, it ends; None plays
            all steps.
    """

    command: Array
    impulses: Impulses | None = None
    ground: TerrainConfig = dataclasses.field(default_factory=TerrainConfig)
    friction: tuple[float, float] | None = None
    delay: Array | None = None
    policy_dt: float | None = None
    listen_from: int | None = None
    steer: tuple[float, float] | None = None
    trunk_velocity: TrunkVelocity | None = None
    finish: float | None = None

    @property
    def robots(self) -> int:
        """N."""
        return self.command.shape[1]


@dataclass(frozen=True)
class Motion:
    """What N robots did in T policy steps; values are those at the end of a step.

    Attributes:
        dt: period of the policy, s.
        t: (T,) s since the start.
        command: (T, N, 3) as it was given; x, y in m/s, yaw rate in rad/s.
        velocity: (T, N, 3) of the trunk in its frame: x, y in m/s, yaw rate in rad/s.
        height: (T, N) of the trunk's origin over the ground below it, m.
        way: (T, N) m along the world's x from the start.
        alive: (T, N) bool, not fallen and on the map so far.
        fell: (N,) bool.
        left_map: (N,) bool.
        front_right: (T, N) time for which the foot FR has been on the ground, 0 in the air, s.
        trace: contacts and the like of the recorded steps, or None.
    """

    dt: float
    t: Array
    command: Array
    velocity: Array
    height: Array
    way: Array
    alive: NDArray[np.bool_]
    fell: NDArray[np.bool_]
    left_map: NDArray[np.bool_]
    front_right: Array
    trace: Trace | None = None

    @property
    def moving_s(self) -> Array:
        """(N,) time under a command that is not zero, until a fall, s."""
        moving = self.alive & np.any(self.command != 0.0, axis=-1)
        return np.asarray(moving.sum(0) * self.dt, dtype=np.float64)

    @property
    def fingerprint(self) -> Array:
        """(N,) sums over what each robot did, which are equal to the bit only if that is."""
        did = np.abs(self.velocity).sum(-1) + self.height
        return np.asarray(np.where(self.alive, did, 0.0).sum(0), dtype=np.float64)
