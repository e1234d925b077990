"""What a user of the window may ask of a robot that walks: plain data from the panels to the session."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Velocity = tuple[float, float, float]
"""x and y, m/s, and yaw rate, rad/s, in the trunk's frame."""


@dataclass(frozen=True)
class Steer:
    """Walk at another velocity from now on."""

    velocity: Velocity


@dataclass(frozen=True)
class Push:
    """Push the trunk once: a half sine over ``session.PUSH_S``.

    Attributes:
        impulse: N s.
        direction: of the force, from the robot's heading counter-clockwise, rad.
    """

    impulse: float
    direction: float


@dataclass(frozen=True)
class Hand:
    """Give the legs to another policy, run, bundle or controller, by its label; the robot walks on."""

    label: str


@dataclass(frozen=True)
class Effects:
    """Let exactly these effects act.

    Attributes:
        sizes: by name; 1 is the effect as its choice or the run has it, 0 its absence.
    """

    sizes: dict[str, float]


@dataclass(frozen=True)
class Walk:
    """Start again on another ground.

    Attributes:
        ground: its name.
        level: how hard; of graded tiles the row, of a lane its difficulty in its own unit.
        tile: kind of tile, of graded tiles.
    """

    ground: str
    level: float = 0.0
    tile: str | None = None


@dataclass(frozen=True)
class Conditions:
    """What stands between the controller and the robot.

    Attributes:
        noise: add sensor noise to what the controller sees.
        delay: by which targets come later than they do anyhow, s.
        physics_dt: physics step, s; None takes that of training.
        trunk_velocity: the true one, or that of the Kalman filter.
    """

    noise: bool = False
    delay: float = 0.0
    physics_dt: float | None = None
    trunk_velocity: Literal["exact", "estimated"] = "exact"


@dataclass(frozen=True)
class Pace:
    """How fast time passes.

    Attributes:
        paused: whether it stands still.
        speed: simulated seconds per second.
    """

    paused: bool
    speed: float = 1.0


@dataclass(frozen=True)
class Step:
    """Pass one period of the policy while time stands still."""


@dataclass(frozen=True)
class Reset:
    """Put the robot back to the start."""


class Ended(Exception):
    """What is shown is over."""


Request = Steer | Push | Hand | Effects | Walk | Conditions | Pace | Step | Reset
