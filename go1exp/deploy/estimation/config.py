"""Settings of the filter for one robot and its sensors. Plain data, read from JSON; a bundle contains it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from go1exp.base.paths import data_root
from go1exp.config.schema.registry import STRICT, ConfigError, NonNegative, Positive, explain
from go1exp.robot import FOOT_RADIUS, HIP_OFFSET, LEGS, LINK_LENGTHS

Vector = tuple[float, float, float]
PositiveVector = tuple[Positive, Positive, Positive]

POLYNOMIAL_TERMS = 35
"""Number of monomials u0^i u1^j u2^k with i + j + k <= 4; ordered with i slowest, k fastest."""


@dataclass(frozen=True, config=STRICT)
class ChainLeg:
    """A leg whose hip turns about x, and thigh and calf about y; at zero angles it points straight down.

    Attributes:
        hip: point on the hip's axis from which the abduction offset is counted, trunk frame, m.
        lengths: abduction offset (left is positive), thigh, calf, m.
    """

    hip: Vector
    lengths: Vector
    kind: Literal["chain"] = "chain"


@dataclass(frozen=True, config=STRICT)
class PolynomialLeg:
    """A calibrated leg of any mechanism: the foot position is a polynomial of degree four in the three joint angles.

    Attributes:
        centre: angles about which it is written, rad.
        scale: u = (q - centre) / scale, rad.
        x: coefficients of the x coordinate of the foot in the trunk's frame, m.
        y: coefficients of y.
        z: coefficients of z.
    """

    centre: Vector
    scale: PositiveVector
    x: Annotated[tuple[float, ...], Field(min_length=POLYNOMIAL_TERMS, max_length=POLYNOMIAL_TERMS)]
    y: Annotated[tuple[float, ...], Field(min_length=POLYNOMIAL_TERMS, max_length=POLYNOMIAL_TERMS)]
    z: Annotated[tuple[float, ...], Field(min_length=POLYNOMIAL_TERMS, max_length=POLYNOMIAL_TERMS)]
    kind: Literal["polynomial"] = "polynomial"


LegConfig = Annotated[ChainLeg | PolynomialLeg, Field(discriminator="kind")]


@dataclass(frozen=True, config=STRICT)
class FilterConfig:
    """Settings of the filter; ``docs/estimation.md`` has the equations in which they occur.

    Noises are standard deviations per sample, except those "per root second", which grow with the time between
    samples. Below, ``kinematics`` is the position of a foot computed from the joint angles.

    Attributes:
        legs: four legs; their order is that of every array.
        imu_position: position of the accelerometer in the trunk's frame, m. The IMU has the axes of the trunk.
        foot_radius: radius of a foot that rolls, m; 0 for a point. Rolling needs ``ChainLeg`` and joint velocities.
        contact_source: ``force`` (foot sensors, N), ``torque`` (vertical force that balances the joint torques, N) or
            ``height`` (minus the height of a foot above the mean of the two lowest, trunk frame, m: for robots
            without force sensors, on flat ground).
        contact_low: value of the source below which contact is 0: the foot carries no load.
        contact_high: value above which contact is 1; between the two it grows linearly.
        contact_least: contact below which a foot counts as in the air, above 0.
        settle: time after touch-down during which a foot is not used, s (impact gating).
        acceleration_noise: noise of the accelerometer, and of gravity by attitude errors, m/s2 per root hertz.
        impact_acceleration: excess of the measured acceleration over gravity that doubles its noise, m/s2.
        bias_walk: random walk of the accelerometer's offset, m/s2 per root second.
        attitude_time: time constant with which the attitude, integrated from the gyro, follows the reported one, s; 0
            takes the reported one.
        attitude_noise: error of the attitude, rad.
        gyro_noise: rad/s.
        joint_noise: noise of a joint angle, rad.
        joint_speed_noise: noise of a joint velocity, rad/s.
        leg_noise: error of the kinematics besides that of the angles, such as flexing, m.
        foot_drift: horizontal drift of a foot on the ground, m per root second: slip too slow to detect.
        foot_speed_noise: horizontal speed of a foot on the ground, m/s; 0: joint velocities are not used.
        sinking: factor by which vertical drift and speed exceed the two above: ground and sole give way at each step.
        level_noise: difference in height between a foot just set down and the ground before, m; 0 turns the rule off.
        ground_walk: random walk of the ground's height under the robot about its slope, m per root second.
        slope_walk: random walk of the slope, per root second (also its standard deviation at the start).
        initial_speed: standard deviation of the trunk's speed at the start and after a gap, m/s.
        initial_bias: standard deviation of the accelerometer's offset at the start, m/s2.
        gate: squared Mahalanobis distance (3 degrees of freedom) beyond which a foot slips (16.3: one in a thousand).
        longest_gap: time without samples after which speed and feet are initialised again, s.
        lost_after: time for which all feet on the ground contradict the filter until its speed is made uncertain, s.
    """

    legs: tuple[LegConfig, LegConfig, LegConfig, LegConfig]
    imu_position: Vector
    foot_radius: NonNegative
    contact_source: Literal["force", "torque", "height"]
    contact_low: float
    contact_high: float
    contact_least: Annotated[float, Field(gt=0, le=1)]
    settle: NonNegative
    acceleration_noise: Positive
    impact_acceleration: Positive
    bias_walk: NonNegative
    attitude_time: NonNegative
    attitude_noise: NonNegative
    gyro_noise: NonNegative
    joint_noise: NonNegative
    joint_speed_noise: NonNegative
    leg_noise: Positive
    foot_drift: Positive
    foot_speed_noise: NonNegative
    sinking: Positive
    level_noise: NonNegative
    ground_walk: NonNegative
    slope_walk: NonNegative
    initial_speed: Positive
    initial_bias: NonNegative
    gate: Positive
    longest_gap: Positive
    lost_after: Positive

    @model_validator(mode="after")
    def _consistent(self) -> FilterConfig:
        if self.contact_low >= self.contact_high:
            raise ValueError("contact_high: must exceed contact_low")
        if self.foot_radius > 0 and any(leg.kind != "chain" for leg in self.legs):
            raise ValueError("foot_radius: only the feet of chains roll; set it to 0")
        return self


_CONFIG = TypeAdapter(FilterConfig)


def go1(**changes: Any) -> FilterConfig:
    """Return the settings of the Go1, legs in its order FR FL RR RL; keyword arguments replace some.

    Kinematics and the position of the IMU are the vendor's; joint, gyro and attitude noise are the standard deviations
    of the paper's Table II (uniform 0.05 rad, 0.1 rad/s, 0.01 rad/s and 0.05). The rest was chosen on simulated walks,
    see ``docs/estimation.md``.
    """
    (x, y), (side, thigh, calf) = HIP_OFFSET, LINK_LENGTHS
    signs = [(1.0 if leg[0] == "F" else -1.0, 1.0 if leg[1] == "L" else -1.0) for leg in LEGS]
    usual: dict[str, Any] = {
        "legs": tuple(ChainLeg((front * x, left * y, 0.0), (left * side, thigh, calf)) for front, left in signs),
        "imu_position": (-0.01592, -0.06659, -0.00617),
        "foot_radius": FOOT_RADIUS,
        "contact_source": "force",
        "contact_low": 5.0,
        "contact_high": 25.0,
        "contact_least": 0.1,
        "settle": 0.01,
        "acceleration_noise": 0.03,
        "impact_acceleration": 10.0,
        "bias_walk": 0.01,
        "attitude_time": 0.1,
        "attitude_noise": 0.029,
        "gyro_noise": 0.006,
        "joint_noise": 0.029,
        "joint_speed_noise": 0.058,
        "leg_noise": 0.002,
        "foot_drift": 0.02,
        "foot_speed_noise": 0.2,
        "sinking": 30.0,
        "level_noise": 0.03,
        "ground_walk": 0.05,
        "slope_walk": 0.1,
        "initial_speed": 0.5,
        "initial_bias": 0.2,
        "gate": 16.3,
        "longest_gap": 0.1,
        "lost_after": 0.5,
    }
    return FilterConfig(**{**usual, **changes})


def scaler(**changes: Any) -> FilterConfig:
    """Return the settings of UCLA's SCALER (legs FL FR RR RL), whose five-bar legs are calibrated polynomials."""
    return from_json(
        (data_root() / "assets/estimation/scaler.json").read_text(), "assets/estimation/scaler.json", changes
    )


def from_json(text: str, where: str, changes: dict[str, Any] | None = None) -> FilterConfig:
    """Read settings from a JSON object; ``changes`` replace some.

    Raises:
        ConfigError: if something is missing, unknown or of a wrong value; ``where`` names the text.
    """
    try:
        return _CONFIG.validate_json(json.dumps({**json.loads(text), **(changes or {})}))
    except json.JSONDecodeError as error:
        raise ConfigError([f"{where}: not JSON ({error})"]) from error
    except ValidationError as error:
        raise ConfigError(explain(error, where, FilterConfig.__dataclass_fields__)) from error


def load(path: Path) -> FilterConfig:
    """Read settings from a JSON file (see ``from_json``)."""
    return from_json(Path(path).read_text(), str(path))


def to_json(config: FilterConfig) -> str:
    """Return settings as JSON, for a bundle or a file."""
    return _CONFIG.dump_json(config, indent=1).decode()
