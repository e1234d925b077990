"""Protocols of constant commands, the robots of each command side by side: ``corners``, and the base of others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from go1exp.base.report import plots
from go1exp.base.report.plots import Drawing
from go1exp.config.schema.registry import NonNegative, Positive, protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import Cause, Length, Played, Protocol, bands, lives, repeated, rounded
from go1exp.evaluate.protocol.plan import Constant, Motion, Plan, Velocity
from go1exp.evaluate.quantities import Column, Row, add_measures

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.stage import Stage

AXES = ("x", "y", "yaw")

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
        error = _error(motion, settle)
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


def _error(motion: Motion, settle: int) -> np.ndarray:
    """(N, 3) root mean square errors while up, NaN for robots that were not at all."""
    up = motion.alive[settle:, :, None]
    square = np.where(up, (motion.velocity - motion.command)[settle:] ** 2, 0.0).sum(0)
    count = up.sum(0)
    return np.sqrt(np.divide(square, count, out=np.full(square.shape, np.nan), where=count > 0))


def by_axis(command: Sequence[float]) -> dict[str, float]:
    """Return a command (3,) by the names of its axes."""
    return dict(zip(AXES, map(float, command), strict=True))


def command_text(condition: Mapping[str, Any]) -> str:
    """Write a command of one or more axes, such as x 0.5, yaw 1."""
    return ", ".join(f"{axis} {condition[axis]:g}" for axis in AXES if condition[axis]) or "stand"


RISEN = 0.9  # share of the steady-state velocity at which a step has risen


@protocol("corners")
@settings
class Corners(Steady):
    """Fastest, slowest and combined commands as steps from rest: steady-state velocity, rise time, errors, falls."""

    robot_columns: ClassVar[tuple[Column, ...]] = (
        *ERRORS,
        Column("answer", "", "steady-state velocity along the command, as a share of the command", better="higher"),
        Column("rise_s", "s", "time from the step until 90 % of the steady-state velocity", better="lower"),
        Column("overshoot", "", "largest mean over 0.36 s beyond the steady-state velocity, relative", better="lower"),
    )

    def also(self, motion: Motion, rows: Sequence[Row], settle: int) -> None:
        """Write how the steps were answered."""
        step = round(self.rest_s / motion.dt)
        for n, row in enumerate(rows):
            command = np.array(self.commands[n // self.robots])
            if not motion.alive[-1, n] or not command.any():
                row |= dict.fromkeys(("answer", "rise_s", "overshoot"))
                continue
            along = motion.velocity[:, n] @ command / (command @ command)
            row |= step_answer(along, step, settle, motion.dt)

    def curves(self, motion: Motion, rows: Sequence[Row], settle: int) -> dict[str, Any]:
        """Return the mean velocity along each command, as a share of the command, over time."""
        shares = {}
        for k, command in enumerate(self.commands):
            robots, c = slice(k * self.robots, (k + 1) * self.robots), np.array(command)
            if not c.any():
                continue
            along = np.where(motion.alive[:, robots], motion.velocity[:, robots] @ c / (c @ c), np.nan)
            shares[command_text(by_axis(command))] = rounded(bands(along, np.nanmean)[0])
        return {"t": rounded(motion.t), "along": shares}

    def compared(self, plays: Mapping[str, Played], summaries: Mapping[str, Any]) -> list[Drawing]:
        """Draw the answers of all subjects."""
        text = "Share of each command that is reached, 95 % intervals over robots still standing; red: falls."
        return [Drawing("answer", "Steady-state velocity", text, partial(_answers, summaries))]

    def details(self, played: Played, summary: Sequence[Mapping[str, Any]]) -> list[Drawing]:
        """Draw the steps."""
        text = f"Mean share of the command over robots still standing, from rest at {self.rest_s:g} s."
        return [Drawing("steps", "Steps from rest", text, partial(_steps, played.curves))]


def step_answer(along: NDArray[Any], step: int, settle: int, dt: float) -> Row:
    """Return how a step of a command at row ``step`` was answered; the steady state begins at row ``settle``.

    ``along`` (T,) is the velocity along the command, as a share of it, every ``dt`` s.
    """
    reached = float(along[settle:].mean())
    stride = max(1, round(0.36 / dt))
    smooth = np.convolve(along[step:], np.ones(stride) / stride, "valid")
    risen = np.flatnonzero(along[step:] >= RISEN * reached) if reached > 0 else np.array([])
    rise = float((risen[0] + 1) * dt) if len(risen) else None
    over = max(float(smooth.max() / reached) - 1.0, 0.0) if reached > 0.1 else None
    return {"answer": reached, "rise_s": rise, "overshoot": over}


def _answers(summaries: Mapping[str, Sequence[Mapping[str, Any]]]) -> plots.Figure:
    first = next(iter(summaries.values()))
    figure, axes = plots.panels(1, height=0.35 + 0.24 * len(first) * max(1, 0.6 * len(summaries)))
    ax = axes[0, 0]
    for w, (who, summary) in enumerate(summaries.items()):
        for k, entry in enumerate(summary):
            f = entry["figures"].get("answer")
            if f is None or f["estimate"] is None:
                continue
            fell = entry["figures"]["fell"]["estimate"]
            colour = "#c1272d" if fell and len(summaries) == 1 else plots.COLOURS[w]
            low, high = (f["estimate"] if v is None else v for v in (f["low"], f["high"]))
            at = k + 0.22 * w
            ax.plot([low, high], [at, at], color=colour, lw=1.4)
            ax.plot([f["estimate"]], [at], "o", ms=4, color=colour, label=who if k == 0 else "")
    ax.axvline(1.0, color="#999999", lw=0.8)
    ax.set_yticks(range(len(first)), [command_text(e["condition"]) for e in first], fontsize=7)
    ax.invert_yaxis()
    ax.set_xlabel("share of the command")
    if len(summaries) > 1:
        plots.legend(figure, ax)
    return figure


def _steps(curves: Mapping[str, Any]) -> plots.Figure:
    names = list(curves["along"])
    columns = 3
    figure, axes = plots.panels(-(-len(names) // columns), columns, height=1.1, sharex=True, sharey=True)
    for ax, name in zip(axes.flat, names, strict=False):
        ax.axhline(1.0, color="#999999", lw=0.8)
        ax.plot(curves["t"], np.array(curves["along"][name], dtype=float), color=plots.MEASURED, lw=0.9)
        ax.set_title(name, fontsize=6.8, pad=2)
        ax.set_ylim(-0.4, 1.7)
    for ax in axes.flat[len(names) :]:
        ax.remove()
    for ax in axes[-1]:
        ax.set_xlabel("time (s)")
    return figure
