"""What a user may say about the next recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import ConfigDict, Field

from go1exp.config.schema.registry import STRICT, NonNegative, Positive
from go1exp.gap.result import Count

Part = Annotated[float, Field(gt=0, le=1)]


@dataclass(frozen=True)
class Safety:
    """How much of the robot a design may use.

    Attributes:
        angle: share of the range of each joint, about its middle.
        speed: share of the top speed.
        torque: share of the peak torque.
        power: sum of |torque x speed| over the joints, W; 500 is where the runtime of a Go1 stops.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    angle: Part = 0.95
    speed: Part = 0.8
    torque: Part = 0.9
    power: Positive = 500.0


@dataclass(frozen=True)
class DesignSettings:
    """How the next recording is designed.

    Attributes:
        seconds: length of the recording, s.
        designs: recordings that are tried first, at most.
        refine: rounds in which neighbours of the best one are tried.
        gains: pairs of factors on kp and kd of the recordings at hand; [[1,1]] leaves them as they are.
        hang: pairs of roll and pitch at which a Go1's trunk may hang, rad; other robots stay as they were recorded.
        limits: how much of the robot a motion may use.
        seed: of motions and of what is tried.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    seconds: Annotated[float, Field(ge=2, le=60)] = 6.0
    designs: Count = 120
    refine: Annotated[int, Field(ge=0)] = 2
    gains: Annotated[tuple[tuple[Positive, NonNegative], ...], Field(min_length=1)] = (
        *((1.0, 1.0), (1.0, 2.0), (0.5, 1.0), (1.5, 1.0)),
    )
    hang: Annotated[tuple[tuple[float, float], ...], Field(min_length=1)] = (
        *((0.0, 0.0), (0.0, 0.26), (0.26, 0.0), (0.0, 0.5)),
    )
    limits: Safety = Safety()
    seed: Annotated[int, Field(ge=0)] = 0
