"""The base of protocols of constant commands, the robots of each command side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from go1exp.config.schema.registry import NonNegative, Positive
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import Cause, Length, Played, Protocol, lives, repeated
from go1exp.evaluate.protocol.plan import Constant, Motion, Plan, Velocity
from go1exp.evaluate.quantities import AXES, Column, Row, add_measures
from go1exp.mdp.measures.trace import mean_over

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.stage import Stage

ERRORS = tuple(
    Column(f"rmse_{axis}", unit, f"root mean square error of {axis}, gait included", better="lower")
    for axis, unit in zip(AXES, ("m/s", "m/s", "rad/s"), strict=True)
)


@settings
class Steady(Protocol):
    """Constant commands.

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
        robots, recorded = self.robots * len(self.commands), bool(self.terms())
        return [Length(self.seconds, robots, self.causes(), self.settle_s, recorded)]

    def causes(self) -> list[Cause]:
        """Return what says how long a batch plays."""
        return [Cause("seconds", self.seconds, least=self.settle_s)]

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

    def curves(self, motion: Motion, rows: Sequence[Row], settle: int) -> dict[str, Any]:
        """Return plain data for drawings."""
        return {}


def by_axis(command: Sequence[float]) -> dict[str, float]:
    """Return a command (3,) by the names of its axes."""
    return dict(zip(AXES, map(float, command), strict=True))


def command_text(condition: Mapping[str, Any]) -> str:
    """Write a command of one or more axes, such as x 0.5, yaw 1."""
    return ", ".join(f"{axis} {condition[axis]:g}" for axis in AXES if condition[axis]) or "stand"
