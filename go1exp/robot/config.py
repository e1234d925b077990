"""Settings of the Go1: the values on which published models differ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import ConfigDict

from go1exp.config.schema.registry import STRICT, NonNegative, Positive


@dataclass(frozen=True)
class RobotConfig:
    """The variant of the Go1: every value on which published models differ. Triples are hip, thigh, calf.

    Attributes:
        inertia: ``merged`` (12.743 kg) or ``rotor_complete`` (13.099 kg, with the four hip rotors).
        effort_limit: peak torque, N m; the actuator and the model clip there.
        velocity_limit: top speed, rad/s; used by the joint velocity limit penalty and motor models.
        armature: reflected rotor inertia, kg m2.
        damping: viscous joint friction, N m s/rad.
        friction_loss: dry joint friction, N m.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    inertia: Literal["merged", "rotor_complete"]
    effort_limit: tuple[Positive, Positive, Positive]
    velocity_limit: tuple[Positive, Positive, Positive]
    armature: tuple[NonNegative, NonNegative, NonNegative]
    damping: tuple[NonNegative, NonNegative, NonNegative]
    friction_loss: tuple[NonNegative, NonNegative, NonNegative]
