"""Base of protocols: settings of a file, what is played, rows, figures and drawings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, cast

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from go1exp.base.report.plots import Drawing
from go1exp.config.schema.registry import (
    ConfigError,
    Count,
    NonNegative,
    Positive,
    Term,
    bind_list,
    find,
    members,
    unknown_name,
)
from go1exp.config.schema.settings import parse, settings
from go1exp.evaluate.controller.types import TrunkVelocity
from go1exp.evaluate.protocol.claims import Claim
from go1exp.evaluate.protocol.plan import Array, Constant, Motion, Plan, Velocity
from go1exp.evaluate.quantities import AXES, FINGERPRINT, LIFE, Column, Derived, Row, add_measures, columns_of, finite
from go1exp.evaluate.statistics.intervals import SummaryEntry
from go1exp.mdp.measures import measured
from go1exp.mdp.measures.trace import mean_over

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.stage import Stage


@dataclass(frozen=True)
class Cause:
    """A setting that determines the length of a batch."""

    key: str  # its name
    value: float  # its value
    least: float = 0.0  # its lower bound
    # length, s -> the value that makes the batch so long, all other settings unchanged
    fitting: Callable[[float], float] = lambda seconds: seconds
    unit: str = " s"  # of the value
    falling: bool = False  # whether the length falls as the value grows

    def limit(self, seconds: float) -> str | None:
        """Return the limit of the value for a length of ``seconds`` as text; None if that is out of bounds."""
        most = self.fitting(seconds)
        if most < self.least:
            return None
        if self.falling:  # rounded to the side that fits
            return f"{1.006 * most:.3g}{self.unit} at least"
        return f"{0.994 * most:.3g}{self.unit} at most"


@dataclass(frozen=True)
class Length:
    """Length of one batch of robots."""

    seconds: float  # the length, s
    robots: int  # number of robots
    causes: Sequence[Cause]  # settings that determine the length, the likeliest to be wrong first
    settle_s: float = 0.0  # time at its start that does not count, s
    recorded: bool = False  # whether the channels of measures are recorded after it
    policy_dt: float | None = None  # period of their policy, s; None is that of the stage
    figures: int = 0  # further figures of each policy step


@dataclass
class Played:
    """Rows and curves of a protocol."""

    rows: list[Row]  # one for each robot in each condition
    curves: dict[str, Any] = field(default_factory=dict)  # plain data for drawings, by name
    notes: list[str] = field(default_factory=list)  # remarks for the reader of the report


@settings
class Protocol:
    """Settings and hooks of every protocol.

    Attributes:
        robots: number of robots in each condition, each with random numbers of its own.
        noise: add the observation noise of training.
        randomize: randomise robots and starts as in training; false takes the nominal robot, which counts once.
        trunk_velocity: velocity that the policy observes: exact, or estimated from the sensors by the filter.
        measures: further measures of gait and contact by name (go1exp list measure), [] for none.
        claims: limits of figures by name, and what counts as close.
    """

    robots: Count
    noise: bool
    randomize: bool
    trunk_velocity: TrunkVelocity
    measures: tuple[Any, ...]
    claims: dict[str, Claim]

    keys: ClassVar[tuple[str, ...]] = ()  # columns that identify the condition of a row
    robot_columns: ClassVar[tuple[Column, ...]] = ()  # further figures of a robot
    identical: ClassVar[bool] = True  # whether the robots of a condition move identically where nothing is random
    always: ClassVar[tuple[str, ...]] = ()  # measures that are always computed
    derived_names: ClassVar[tuple[str, ...]] = ()  # names of the figures of all robots together

    def terms(self) -> list[Term]:
        """Return the measures; raise ConfigError naming those that do not exist."""
        named = [m if isinstance(m, str) else next(iter(m), "") for m in self.measures]
        return bind_list("measure", [*(m for m in self.always if m not in named), *self.measures], "measures")

    def columns(self) -> tuple[Column, ...]:
        """Return every figure of a robot."""
        return (*LIFE, *self.robot_columns, *columns_of(self.terms()))

    def policy_velocities(self) -> dict[str, TrunkVelocity]:
        """Return the trunk velocity that policies observe, by the key that chooses it."""
        return {"trunk_velocity": self.trunk_velocity}

    def derived(self, rows: Sequence[Row]) -> list[Derived]:
        """Return the figures of all robots together."""
        return []

    def play(self, stage: Stage) -> Played:
        """Play the protocol and return its rows."""
        raise NotImplementedError

    def lengths(self) -> list[Length]:
        """Return the lengths of its batches; without any the memory is not checked."""
        return []

    def steps(self, stage: Stage) -> float:
        """Return the approximate number of policy steps times robots."""
        return sum(stage.steps(length.seconds, length.policy_dt) * length.robots for length in self.lengths())

    def drawings(self, played: Played, summary: Sequence[SummaryEntry]) -> list[Drawing]:
        """Return the figures of the report of one subject."""
        return [*self.compared({"": played}, {"": summary}), *self.details(played, summary)]

    def compared(self, plays: Mapping[str, Played], summaries: Mapping[str, Sequence[SummaryEntry]]) -> list[Drawing]:
        """Return the figures that compare subjects, by their labels; the label of a single one is empty."""
        return []

    def details(self, played: Played, summary: Sequence[SummaryEntry]) -> list[Drawing]:
        """Return the figures that show one subject only."""
        return []

    def measure(self, motion: Motion, rows: Sequence[Row]) -> None:
        """Write the measures of a recorded motion into the rows of its robots."""
        if motion.trace is not None and self.terms():
            add_measures(rows, measured(motion.trace, self.terms()))


def repeated(name: str, values: Sequence[object]) -> list[str]:
    """Return a message about a setting with a repeated value: its robots would be one condition."""
    twice = [v for k, v in enumerate(values) if v in values[:k]]
    return [f"{name}: has {twice[0]} twice"] if twice else []


def rounded(values: ArrayLike) -> Any:
    """Return values of any shape as plain data with four decimals; NaN as None."""
    return finite(np.asarray(values, dtype=np.float64).round(4).tolist())


def bands(values: Array, middle: Callable[..., Array]) -> Array:
    """Return ``middle``, 10th and 90th percentile over robots of values (T, N, ...), (3, T, ...); NaNs are ignored."""
    known = np.isfinite(values).reshape(len(values), -1).any(1)
    over = np.full((3, len(values), *values.shape[2:]), np.nan)
    if known.any():
        over[0, known] = middle(values[known], axis=1)
        over[1:, known] = np.nanpercentile(values[known], (10.0, 90.0), axis=1)
    return over


def lives(motion: Motion) -> list[Row]:
    """Return one row for each robot: falls, time under a command, fingerprint."""
    lives_of_robots = zip(motion.fell, motion.left_map, motion.moving_s, motion.fingerprint, strict=True)
    return [
        {"fell": bool(fell), "left_map": bool(left), "moving_s": round(float(s), 4), FINGERPRINT: float(mark)}
        for fell, left, s, mark in lives_of_robots
    ]


ERRORS = tuple(
    Column(f"rmse_{axis}", unit, f"root mean square error of {axis}, gait included", better="lower")
    for axis, unit in zip(AXES, ("m/s", "m/s", "rad/s"), strict=True)
)


@settings
class Steady(Protocol):
    """Base of protocols of constant commands, the robots of each command side by side.

    Attributes:
        commands: each as x m/s, y m/s, yaw rad/s.
        seconds: length, s.
        settle_s: time at its start that counts for falls alone, s.
        rest_s: time at its start, within ``settle_s``, with a zero command, s.
    """

    commands: Annotated[tuple[Velocity, ...], Field(min_length=1)]
    seconds: Positive
    settle_s: NonNegative
    rest_s: NonNegative

    keys: ClassVar[tuple[str, ...]] = AXES

    def __post_init__(self) -> None:
        if not self.rest_s <= self.settle_s < self.seconds:
            order = f"rest_s = {self.rest_s} and seconds = {self.seconds}"
            raise ValueError(f"settle_s = {self.settle_s}: must lie between {order}")
        if wrong := repeated("commands", self.commands):
            raise ValueError(wrong[0])

    def lengths(self) -> list[Length]:
        """Return that of all commands as one batch."""
        causes, robots = [Cause("seconds", self.seconds, least=self.settle_s)], self.robots * len(self.commands)
        return [Length(self.seconds, robots, causes, self.settle_s, bool(self.terms()))]

    def play(self, stage: Stage) -> Played:
        """Play all commands as one batch."""
        t = stage.times(self.seconds)
        signals = [Constant(velocity=c, rest=self.rest_s).at(t) for c in self.commands]
        command = np.repeat(np.stack(signals, 1), self.robots, axis=1)
        settle = round(self.settle_s / stage.policy_dt)
        motion = stage.run(Plan(command, listen_from=settle if self.terms() else None))
        rows = lives(motion)
        error = np.sqrt(mean_over((motion.velocity - motion.command)[settle:] ** 2, motion.alive[settle:]))
        for n, row in enumerate(rows):
            row |= {**by_axis(self.commands[n // self.robots]), "robot": n % self.robots}
        add_measures(rows, {f"rmse_{axis}": error[:, k] for k, axis in enumerate(AXES)})
        self.measure(motion, rows)
        self.also(motion, rows, settle)
        return Played(rows, self.curves(motion, rows, settle))

    def also(self, motion: Motion, rows: Sequence[Row], settle: int) -> None:
        """Write further figures into the rows; ``settle`` is the step from which they count."""

    def curves(self, motion: Motion, rows: Sequence[Row], settle: int) -> dict[str, object]:
        """Return plain data for drawings."""
        return {}


def by_axis(command: Sequence[float]) -> dict[str, float]:
    """Return a command (3,) by the names of its axes."""
    return dict(zip(AXES, map(float, command), strict=True))


def command_text(condition: Mapping[str, float]) -> str:
    """Write a command of one or more axes, such as x 0.5, yaw 1."""
    return ", ".join(f"{axis} {condition[axis]:g}" for axis in AXES if condition[axis]) or "stand"


GRID = "grid"  # the protocol that is the grid of ``go1exp eval`` itself and has no keys here


@dataclass(frozen=True)
class Chosen:
    """A protocol as a configuration chooses it: its key there, the name of its kind, its settings."""

    key: str
    kind: str
    protocol: Protocol


def chosen(given: object) -> tuple[list[Chosen], bool]:
    """Return the protocols of the group ``protocol``, and whether the grid is one; raise ConfigError of problems."""
    if not isinstance(given, Mapping) or not given:
        raise ConfigError([f"protocol = {given!r}: choose at least one, such as protocol=sinusoid"])
    selected, problems = [], list[str]()
    for key, value in given.items():
        if key == GRID and value in ({}, None):
            continue
        try:
            selected.append(_one(str(key), value))
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(problems)
    return selected, GRID in given


def kinds(given: Mapping[str, object]) -> dict[str, type]:
    """Return the classes of the protocols of a configuration by their keys there, for the help."""
    names = {key: value.get("term", key) if isinstance(value, Mapping) else key for key, value in given.items()}
    known = members("protocol")
    return {key: cast(type, known[name].target) for key, name in names.items() if name in known}


def _one(key: str, value: object) -> Chosen:
    path = f"protocol.{key}"
    if not isinstance(value, Mapping):
        raise ConfigError([f"{path} = {value!r}: must be a mapping of settings"])
    rest = dict(value)
    name = str(rest.pop("term", key))
    entry = find("protocol", name)
    if entry is None:
        raise ConfigError([unknown_name(path, name, [GRID, *members("protocol")], "protocol")])
    protocol: Protocol = parse(cast(type, entry.target), rest, path=path)
    _check_claims(protocol, path)
    return Chosen(key, name, protocol)


def _check_claims(protocol: Protocol, path: str) -> None:
    """Refuse measures, and claims about figures, that do not exist; raise ConfigError."""
    try:
        columns = protocol.columns()
    except ConfigError as error:
        raise ConfigError([f"{path}.{problem}" for problem in error.problems]) from None
    known = [*(c.name for c in columns), "falls_per_minute", *protocol.derived_names]
    wrong = [
        unknown_name(f"{path}.claims.{name}.quantity", claim.quantity, known, "figure")
        for name, claim in protocol.claims.items()
        if claim.quantity not in known
    ]
    if wrong:
        raise ConfigError(wrong)
