"""Settings of the group ``controller``: the policy, or a model predictive controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field

from go1exp.config.schema.registry import ConfigError, NonNegative, Positive, unknown_name
from go1exp.config.schema.settings import parse, settings

Phase = Annotated[float, Field(ge=0, lt=1)]
Weights = tuple[NonNegative, NonNegative, NonNegative]


@settings
class GaitSettings:
    """Schedule of the feet.

    Attributes:
        offsets: phases of FR, FL, RR, RL, in cycles.
        duty: stance share of a cycle.
        period: of a cycle, s.
    """

    offsets: tuple[Phase, Phase, Phase, Phase]
    duty: Annotated[float, Field(ge=0.4, le=0.9)]
    period: Annotated[float, Field(ge=0.1, le=2.0)]


@settings
class WeightSettings:
    """Weights of squared errors, each as x, y, z (roll, pitch, yaw).

    Attributes:
        attitude: of roll, pitch, yaw, 1/rad2.
        position: of the centre of mass, 1/m2.
        angular_velocity: s2/rad2.
        velocity: s2/m2.
    """

    attitude: Weights
    position: Weights
    angular_velocity: Weights
    velocity: Weights


@settings
class ForceSettings:
    """The quadratic programme of the foot forces.

    Attributes:
        every: time between two plans, s.
        steps: intervals of the horizon.
        dt: length of an interval, s.
        friction: coefficient of friction of the constraints.
        max_force: largest normal force of a foot, N.
        effort: weight of squared deviations of forces from an even share of the weight, 1/N2.
        weights: of the errors.
        max_lag: largest distance between the wanted and the present place, m.
        max_turn_lag: largest angle between the wanted and the present heading, rad.
    """

    every: Annotated[float, Field(ge=0.002, le=0.1)]
    steps: Annotated[int, Field(ge=2, le=30)]
    dt: Annotated[float, Field(ge=0.005, le=0.1)]
    friction: Annotated[float, Field(gt=0, le=2)]
    max_force: Annotated[float, Field(ge=20, le=1000)]
    effort: Positive
    weights: WeightSettings
    max_lag: NonNegative
    max_turn_lag: NonNegative


@settings
class SwingSettings:
    """The feet in the air.

    Attributes:
        height: of the foot above the straight line, m.
        depth: of its target below the ground, m.
        velocity_gain: shift of the foothold per error of velocity, s.
        kp: of a swinging leg, N m/rad.
        kd: N m s/rad.
        reach: downward extension of a foot that finds no ground, m.
        reach_speed: its speed, m/s.
    """

    height: Annotated[float, Field(gt=0, le=0.2)]
    depth: Annotated[float, Field(ge=0, le=0.05)]
    velocity_gain: NonNegative
    kp: Annotated[float, Field(gt=0, le=200)]
    kd: Annotated[float, Field(ge=0, le=10)]
    reach: Annotated[float, Field(ge=0, le=0.2)]
    reach_speed: NonNegative


@settings
class StanceSettings:
    """The feet on the ground.

    Attributes:
        kd: of a standing leg, N m s/rad.
        contact_force: force from which a foot counts as standing, N.
        slope: tilt the trunk with the ground, a plane through the feet.
        slope_time: time constant of that plane, s.
        max_slope: steepest ground that it may follow, rad.
    """

    kd: Annotated[float, Field(ge=0, le=10)]
    contact_force: Positive
    slope: bool
    slope_time: Positive
    max_slope: Annotated[float, Field(ge=0, le=0.6)]


@settings
class RampSettings:
    """Largest rate of change of the command; an episode begins with zero.

    Attributes:
        speed: of x and y each, m/s2.
        turn: of the yaw rate, rad/s2.
    """

    speed: Positive
    turn: Positive


@settings
class SmoothingSettings:
    """Time constants of the complementary filters of readings.

    Attributes:
        attitude: of the attitude, s; 0 takes the readings.
        joints: of the joint angles, s.
        height: of the height above ground, s.
        velocity: of the velocity, s.
    """

    attitude: NonNegative
    joints: NonNegative
    height: NonNegative
    velocity: NonNegative


@settings
class MpcSettings:
    """``conf/controller/mpc.yaml``.

    Attributes:
        name: ``mpc``.
        stand: initial time at the nominal stance, s: the robot may begin in any pose.
        period: time between two ticks, s.
        height: of the trunk's origin above the ground, m.
        ramp: rate limits of the command.
        gait: schedule of the feet.
        force: programme of their forces.
        swing: the feet in the air.
        stance: the feet on the ground.
        smoothing: of the readings.
    """

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


@settings
class PolicySettings:
    """``conf/controller/policy.yaml``.

    Attributes:
        name: ``policy``: the one that the verb's own settings name.
    """

    name: Literal["policy"]


CONTROLLERS: dict[str, type] = {"policy": PolicySettings, "mpc": MpcSettings}
"""By their names, which are also the choices of the group ``controller``."""


def parse_controller(given: object) -> MpcSettings | PolicySettings:
    """Validate the group ``controller``; raise ConfigError with every problem."""
    if not isinstance(given, Mapping) or given.get("name") not in CONTROLLERS:
        name = given.get("name") if isinstance(given, Mapping) else given
        raise ConfigError([unknown_name("controller.name", str(name), CONTROLLERS, "controller")])
    return parse(CONTROLLERS[given["name"]], given, path="controller")
