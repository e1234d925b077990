"""The settings of the group ``controller``: what moves a robot, as ``conf/controller`` writes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from go1exp.config.schema.registry import STRICT, ConfigError, NonNegative, Positive, as_json, explain, unknown_name

Share = Annotated[float, Field(gt=0, lt=1)]
Phase = Annotated[float, Field(ge=0, lt=1)]
Weights = tuple[NonNegative, NonNegative, NonNegative]


@dataclass(frozen=True)
class GaitSettings:
    """When the feet stand.

    Attributes:
        offsets: phases of FR, FL, RR, RL, in cycles.
        duty: share of a cycle in which a foot stands.
        period: of a cycle, s.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    offsets: tuple[Phase, Phase, Phase, Phase]
    duty: Annotated[float, Field(ge=0.4, le=0.9)]
    period: Annotated[float, Field(ge=0.1, le=2.0)]


@dataclass(frozen=True)
class WeightSettings:
    """Weights of squared errors, each as x, y, z (roll, pitch, yaw).

    Attributes:
        attitude: of roll, pitch, yaw, 1/rad2.
        position: of the centre of mass, 1/m2.
        angular_velocity: s2/rad2.
        velocity: s2/m2.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    attitude: Weights
    position: Weights
    angular_velocity: Weights
    velocity: Weights


@dataclass(frozen=True)
class ForceSettings:
    """The programme for the forces of the feet.

    Attributes:
        every: time between two plans, s.
        steps: intervals of the horizon.
        dt: length of an interval, s.
        friction: coefficient of friction that the forces keep to.
        max_force: largest normal force of a foot, N.
        effort: weight of squared forces, counted from an even share of the weight, 1/N2.
        weights: of the errors.
        max_lag: largest distance between the wanted and the present place, m.
        max_turn_lag: largest angle between the wanted and the present heading, rad.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    every: Annotated[float, Field(ge=0.002, le=0.1)]
    steps: Annotated[int, Field(ge=2, le=30)]
    dt: Annotated[float, Field(ge=0.005, le=0.1)]
    friction: Annotated[float, Field(gt=0, le=2)]
    max_force: Annotated[float, Field(ge=20, le=1000)]
    effort: Positive
    weights: WeightSettings
    max_lag: NonNegative
    max_turn_lag: NonNegative


@dataclass(frozen=True)
class SwingSettings:
    """The feet in the air.

    Attributes:
        height: of the foot above its straight way, m.
        depth: how far below the ground it is aimed, m.
        velocity_gain: shift of the foothold per error of velocity, s.
        kp: of the drives of a swinging leg, N m/rad.
        kd: N m s/rad.
        reach: how far a foot that finds no ground is extended downward, m.
        reach_speed: how fast, m/s.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    height: Annotated[float, Field(gt=0, le=0.2)]
    depth: Annotated[float, Field(ge=0, le=0.05)]
    velocity_gain: NonNegative
    kp: Annotated[float, Field(gt=0, le=200)]
    kd: Annotated[float, Field(ge=0, le=10)]
    reach: Annotated[float, Field(ge=0, le=0.2)]
    reach_speed: NonNegative


@dataclass(frozen=True)
class StanceSettings:
    """The feet on the ground.

    Attributes:
        kd: of the drives of a standing leg, N m s/rad.
        contact_force: force from which a foot counts as standing, N.
        slope: lean with the ground, whose slope is that of a plane through the feet.
        slope_time: time constant of that plane, s.
        max_slope: steepest ground that it may follow, rad.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    kd: Annotated[float, Field(ge=0, le=10)]
    contact_force: Positive
    slope: bool
    slope_time: Positive
    max_slope: Annotated[float, Field(ge=0, le=0.6)]


@dataclass(frozen=True)
class RampSettings:
    """How fast the command may change; an episode begins with a command to stand.

    Attributes:
        speed: of x and y each, m/s2.
        turn: of the yaw rate, rad/s2.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    speed: Positive
    turn: Positive


@dataclass(frozen=True)
class SmoothingSettings:
    """How readings are smoothed: rates carry them on, readings correct with a time constant.

    Attributes:
        attitude: time constant of the attitude, s; 0 takes readings as they are.
        joints: of the joint angles, s.
        height: of the height above ground, s.
        velocity: of the velocity, s.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    attitude: NonNegative
    joints: NonNegative
    height: NonNegative
    velocity: NonNegative


@dataclass(frozen=True)
class MpcSettings:
    """``conf/controller/mpc.yaml``.

    Attributes:
        name: ``mpc``.
        stand: time for which the robot first stands, its drives at the nominal stance, s: it may begin in any pose.
        period: time between two ticks, s.
        height: of the trunk's origin above the ground, m.
        ramp: how fast the command may change.
        gait: when the feet stand.
        force: the programme for their forces.
        swing: the feet in the air.
        stance: the feet on the ground.
        smoothing: of the readings.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    name: Literal["mpc"]
    stand: Annotated[float, Field(ge=0.0, le=5.0)]
    period: Annotated[float, Field(ge=0.0005, le=0.02)]
    height: Annotated[float, Field(ge=0.15, le=0.4)]
    ramp: RampSettings
    gait: GaitSettings
    force: ForceSettings
    swing: SwingSettings
    stance: StanceSettings
    smoothing: SmoothingSettings


@dataclass(frozen=True)
class PolicySettings:
    """``conf/controller/policy.yaml``.

    Attributes:
        name: ``policy``: the one that the verb's own settings name.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    name: Literal["policy"]


CONTROLLERS: dict[str, type] = {"policy": PolicySettings, "mpc": MpcSettings}
"""By their names, which are also the choices of the group ``controller``."""


def parse_controller(given: Any) -> MpcSettings | PolicySettings:
    """Validate the group ``controller``; raise ConfigError with every problem."""
    if not isinstance(given, Mapping) or given.get("name") not in CONTROLLERS:
        name = given.get("name") if isinstance(given, Mapping) else given
        raise ConfigError([unknown_name("controller.name", str(name), CONTROLLERS, "controller")])
    kind = CONTROLLERS[given["name"]]
    try:
        checked: MpcSettings | PolicySettings = TypeAdapter(kind).validate_json(as_json(given))
    except ValidationError as error:
        raise ConfigError(explain(error, "controller", [f.name for f in fields(kind)])) from None
    return checked
