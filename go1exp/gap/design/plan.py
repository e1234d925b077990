"""What may be recorded next: the user's settings, safe limits of the joints, and the library of motions and gains."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from pydantic import ConfigDict, Field

import go1exp.logs.excitations  # noqa: F401  (registers every excitation)
from go1exp.base.errors import Expected
from go1exp.config.schema.registry import STRICT, Count, CountOrZero, NonNegative, Positive, Term, bind, members
from go1exp.gap.data.windows import Windows
from go1exp.logs.excitations import ExcitationError, Motion

if TYPE_CHECKING:
    from go1exp.gap.robots.protocol import Robot

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
    refine: CountOrZero = 2
    gains: Annotated[tuple[tuple[Positive, NonNegative], ...], Field(min_length=1)] = (
        *((1.0, 1.0), (1.0, 2.0), (0.5, 1.0), (1.5, 1.0)),
    )
    hang: Annotated[tuple[tuple[float, float], ...], Field(min_length=1)] = (
        *((0.0, 0.0), (0.0, 0.26), (0.26, 0.0), (0.0, 0.5)),
    )
    limits: Safety = Safety()
    seed: Annotated[int, Field(ge=0)] = 0


class DesignError(Expected):
    """A recording that cannot be designed; the message says what is missing."""


@runtime_checkable
class Movable(Protocol):
    """A robot on a base that is held, whose model says how far and how fast its joints may go."""

    @property
    def top_speed(self) -> tuple[float, ...]:
        """Speed without load (J,), rad/s."""

    @property
    def angle_range(self) -> np.ndarray:
        """Lowest and highest angle (J, 2), rad; NaN where the model has no stops."""


@dataclass(frozen=True)
class Used:
    """Largest share of each limit that a motion uses; above 1 it is beyond. Power in W."""

    angle: float
    speed: float
    torque: float
    power: float


@dataclass(frozen=True)
class Limits:
    """Limits of motions."""

    centre: np.ndarray  # angles to move about (J,), rad
    angle: np.ndarray  # lowest and highest (J, 2), rad
    speed: np.ndarray  # (J,) rad/s
    torque: np.ndarray  # (J,) N m
    power: float  # of all joints together, W

    def used(self, q: np.ndarray, qd: np.ndarray, torque: np.ndarray) -> Used:
        """Return how much of the limits a motion uses: angles (T, J), speeds (T, J) and torques (T, J)."""
        middle, half = self.angle.mean(axis=1), 0.5 * np.ptp(self.angle, axis=1)
        return Used(
            float((np.abs(q - middle) / half).max()),
            float((np.abs(qd) / self.speed).max()),
            float((np.abs(torque) / self.torque).max()),
            float(np.abs(torque * qd).sum(axis=1).max()),
        )

    def allow(self, used: Used) -> bool:
        """Return whether a motion stays within all limits."""
        return max(used.angle, used.speed, used.torque, used.power / self.power) <= 1.0


def limits_of(robot: Robot, windows: Windows, targets: Sequence[np.ndarray], safety: Safety) -> Limits:
    """Return the limits of a robot, by targets (T, J), rad, of each of the recordings at hand and the user's shares.

    Motions are about the middle of the targets at hand, in which the robot has been. A joint whose model has no stops
    may go where it has been in the recordings. DesignError if the robot's base is not held.
    """
    if not isinstance(robot, Movable):
        raise DesignError(
            "gap next designs motions of a robot whose base is held; record it suspended (support=suspended)"
        )
    been = windows.y[:, :, 0][windows.valid]
    sent = np.concatenate(targets)
    reach = np.stack([np.minimum(been.min(0), sent.min(0)), np.maximum(been.max(0), sent.max(0))], axis=1)
    angles = np.where(np.isfinite(robot.angle_range), robot.angle_range, reach)
    middle = angles.mean(axis=1, keepdims=True)
    angles = middle + safety.angle * (angles - middle)
    centre = np.median(sent, axis=0).clip(angles[:, 0], angles[:, 1])
    speed, torque = np.array(robot.top_speed) * safety.speed, np.array(robot.effort) * safety.torque
    return Limits(centre, angles, speed, torque, safety.power)


SIZES = ("amplitude", "large", "stride", "lift", "sway")  # parameters of excitations that say how far the joints go

MOTIONS: tuple[tuple[str, Mapping[str, float | Sequence[float]]], ...] = (
    ("chirp", {"band": (0.1, 4.0)}),
    ("chirp", {"band": (0.5, 10.0)}),
    ("multisine", {"band": (0.15, 8.0)}),
    ("multisine", {"band": (0.5, 15.0)}),
    ("steps", {}),
    ("slow_ramps", {}),
    ("slow_ramps", {"speed": 0.8, "hold": 0.3}),
    ("torque_off", {}),
    ("gait", {}),
)
"""Kinds of motion in the library."""

SCALES = (1.0, 0.5)  # sizes of motion in the library, as shares of what the excitation does by itself
CARRIED = 0.3  # highest frequency of a band over the rate of commands


@dataclass(frozen=True)
class Attitude:
    """How a base is held: ``roll`` and ``pitch``, rad, None for as it was; ``quat`` w-x-y-z."""

    roll: float | None
    pitch: float | None
    quat: tuple[float, float, float, float]


@dataclass(frozen=True)
class Design:
    """A recording that could be made."""

    excitation: str  # kind of motion
    parameters: Mapping[str, Any]  # of the excitation
    scale: float  # size of the motion, 1 is the excitation's own
    gains: tuple[float, float]  # factors on kp and kd of the recordings at hand
    attitude: Attitude  # of the base
    seed: int  # of the motion

    def term(self, rate_hz: float) -> Term:
        """Return the excitation, its size and band as they are played at a rate of commands, Hz."""
        defaults = {name: p.default for name, p in members("excitation")[self.excitation].parameters.items()}
        given = dict(self.parameters)
        for name in SIZES:
            if name in defaults:
                value = given.get(name, defaults[name])
                scaled = [float(f"{self.scale * v:.4g}") for v in np.atleast_1d(value)]
                given[name] = scaled if np.ndim(value) else scaled[0]
        if "band" in defaults:
            low, high = given.get("band", defaults["band"])
            high = min(high, CARRIED * rate_hz)
            given["band"] = [float(f"{min(low, 0.5 * high):.4g}"), float(f"{high:.4g}")]
        term, problems = bind("excitation", self.excitation, given, self.excitation)
        assert term is not None, problems  # of this file's own tables
        return term

    def motion(self, seconds: float, period: float, limits: Limits) -> Motion | None:
        """Return the motion, commanded every ``period`` s; None if the excitation cannot be made for this robot."""
        t = np.arange(round(seconds / period)) * period
        try:
            made: Motion = self.term(1.0 / period)(t, limits.centre, limits.angle, np.random.default_rng(self.seed))
        except ExcitationError:
            return None
        # Seen from the drive there is no difference between this and the file that it is written to.
        return replace(made, target=made.target.round(5).clip(limits.angle[:, 0], limits.angle[:, 1]), soft_start=0.0)

    def about(self, rate_hz: float) -> dict[str, Any]:
        """Return what it is, as JSON can hold it."""
        plain = json.loads(json.dumps(dict(self.term(rate_hz).parameters)))
        return {"motion": self.excitation, "parameters": plain, "gain_factors": self.gains, "seed": self.seed} | {
            "attitude": asdict(self.attitude)
        }


def library(
    count: int, gains: Sequence[tuple[float, float]], attitudes: Sequence[Attitude], rng: np.random.Generator
) -> list[Design]:
    """Return up to ``count`` designs, drawn evenly from all combinations, in the order of attitudes."""
    seed = int(rng.integers(1 << 16))
    every = [
        Design(name, parameters, scale, pair, attitude, seed)
        for attitude in attitudes
        for name, parameters in MOTIONS
        for scale in SCALES
        for pair in gains
    ]
    if len(every) <= count:
        return every
    return [every[k] for k in np.sort(rng.permutation(len(every))[:count])]


def neighbours(
    best: Design,
    count: int,
    gains: Sequence[tuple[float, float]],
    attitudes: Sequence[Attitude],
    rng: np.random.Generator,
) -> list[Design]:
    """Return designs near one: another size, band, gain (between those allowed), attitude or seed."""
    designs = []
    factors = np.array(gains)
    low, high = factors.min(axis=0), factors.max(axis=0)
    for _ in range(count):
        tried = replace(best, scale=float(np.clip(best.scale * rng.uniform(0.7, 1.5), 0.1, 2.0)))
        if "band" in best.parameters:
            stretch = np.exp(rng.uniform(-0.5, 0.5, 2))
            band = np.sort(np.array(best.parameters["band"]) * stretch)
            tried = replace(tried, parameters={**best.parameters, "band": tuple(float(v) for v in band)})
        if rng.uniform() < 0.5:
            pair = (np.array(best.gains) * np.exp(rng.uniform(-0.3, 0.3, 2))).clip(low, high)
            tried = replace(tried, gains=(float(pair[0]), float(pair[1])))
        if rng.uniform() < 0.3:
            tried = replace(tried, attitude=attitudes[int(rng.integers(len(attitudes)))])
        if rng.uniform() < 0.5:
            tried = replace(tried, seed=int(rng.integers(1 << 16)))
        designs.append(tried)
    return designs
