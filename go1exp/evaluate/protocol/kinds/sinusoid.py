"""``protocol=sinusoid``: sines of all three velocities (paper, Fig. 4 and 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from go1exp.base.report import plots
from go1exp.config.schema.registry import Positive, protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import ERRORS, Cause, Length, Played, Protocol, bands, lives, repeated, rounded
from go1exp.evaluate.protocol.plan import Motion, Plan, Sine, response
from go1exp.evaluate.quantities import AXES, Column, Row, Summaries, Summary

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.stage import Stage

EVERY = 4  # of so many steps one is kept for drawings

FIGURES = tuple(
    column
    for axis, error in zip(AXES, ERRORS, strict=True)
    for column in (
        Column(f"gain_{axis}", "", f"amplitude of {axis} over that of its command"),
        Column(f"lag_{axis}", "s", f"time by which {axis} comes after its command", better="lower"),
        Column(f"coherence_{axis}", "", f"how alike the periods of {axis} are", better="higher"),
        error,
    )
)


@protocol("sinusoid")
@settings
class Sinusoid(Protocol):
    """Sines of all three velocities at once: gain and lag by projection, coherence, error (paper, Fig. 4 and 5).

    Attributes:
        seconds: length, s; the first period does not count.
        ladder: sines, one after the other harder.
    """

    seconds: Positive
    ladder: Annotated[tuple[Sine, ...], Field(min_length=1)]

    keys: ClassVar[tuple[str, ...]] = ("amplitude", "period")
    robot_columns: ClassVar[tuple[Column, ...]] = FIGURES

    def __post_init__(self) -> None:
        if self.seconds < 2.0 * self.longest:
            raise ValueError(f"seconds = {self.seconds}: must be at least two periods, {2 * self.longest:g}")
        if wrong := repeated("ladder", [f"{label(sine)} at {sine.period:g} s" for sine in self.ladder]):
            raise ValueError(wrong[0])

    @property
    def longest(self) -> float:
        """Longest period, s."""
        return max(sine.period for sine in self.ladder)

    def lengths(self) -> list[Length]:
        """Return that of all sines as one batch."""
        causes = [Cause("seconds", self.seconds, least=2.0 * self.longest)]
        return [Length(self.seconds, self.robots * len(self.ladder), causes, self.longest, bool(self.terms()))]

    def play(self, stage: Stage) -> Played:
        """Play all sines as one batch: the robots of one are neighbours."""
        t = stage.times(self.seconds)
        command = np.concatenate([np.repeat(s.at(t)[:, None], self.robots, 1) for s in self.ladder], 1)
        listen = round(self.longest / stage.policy_dt) if self.terms() else None
        motion = stage.run(Plan(command, listen_from=listen))
        rows = lives(motion)
        curves = {}
        for k, sine in enumerate(self.ladder):
            robots = slice(k * self.robots, (k + 1) * self.robots)
            condition = {"amplitude": label(sine), "period": sine.period}
            self._answers(motion, robots, sine, rows[robots], condition)
            curves[f"{label(sine)} at {sine.period:g} s"] = _curve(motion, robots)
        self.measure(motion, rows)
        return Played(rows, {"sines": curves})

    def _answers(self, motion: Motion, robots: slice, sine: Sine, rows: Sequence[Row], condition: Row) -> None:
        """Write what became of the robots of one sine into their rows."""
        command, velocity = motion.command[:, robots], motion.velocity[:, robots]
        gain, lag, coherence = response(velocity, command, motion.t, sine.period)
        lag = lag + motion.dt  # a command is that of a step's start, a velocity that of its end
        rmse = np.sqrt(((velocity - command)[motion.t > sine.period] ** 2).mean(0))
        for n, row in enumerate(rows):
            row |= {**condition, "robot": n}
            up = not (row["fell"] or row["left_map"])
            for a, axis in enumerate(AXES):
                asked = sine.amplitude[a] != 0.0
                figures = {"gain": gain, "lag": lag, "coherence": coherence}
                row |= {f"{name}_{axis}": float(v[n, a]) if up and asked else None for name, v in figures.items()}
                row[f"rmse_{axis}"] = float(rmse[n, a]) if up else None

    def compared(self, plays: Mapping[str, Played], summaries: Summaries) -> list[plots.Drawing]:
        """Draw gain and lag of all subjects over frequency."""
        text = (
            "Gain 1 and lag 0 are perfect. 95 % intervals over robots; one line for each amplitude: x (m/s), y (m/s),"
            " yaw (rad/s), shifted sideways; colours of several subjects are theirs."
        )
        return [plots.Drawing("bode", "Gain and lag over frequency", text, partial(_bode, summaries))]

    def details(self, played: Played, summary: Summary) -> list[plots.Drawing]:
        """Draw the rows of the paper for each sine."""
        text = (
            "Black: commanded; blue: measured, thin of one robot, thick the mean of those still standing with the 10th"
            " to 90th percentile; orange: error of the mean."
        )
        return [
            plots.Drawing(f"sine{k}", f"Velocity, amplitude {name}", text, partial(_rows, curve))
            for k, (name, curve) in enumerate(played.curves["sines"].items())
        ]


def label(sine: Sine) -> str:
    """Return the amplitude as text, such as 1 0.5 1."""
    return " ".join(f"{v:g}" for v in sine.amplitude)


def _curve(motion: Motion, robots: slice) -> dict[str, object]:
    """Return the velocities of some robots for a drawing; of robots while they are up."""
    up = motion.alive[::EVERY, robots, None]
    velocity = np.where(up, motion.velocity[::EVERY, robots], np.nan)
    mean, low, high = bands(velocity, np.nanmean)
    named = {"mean": mean, "low": low, "high": high, "one": velocity[:, 0]}
    named["command"] = motion.command[::EVERY, robots.start]
    return {"t": rounded(motion.t[::EVERY]), **{name: rounded(values) for name, values in named.items()}}


def _rows(curve: Mapping[str, ArrayLike]) -> plots.Figure:
    figure, axes = plots.panels(3, sharex=True)
    t = curve["t"]
    mean, low, high, one, command = (
        np.array(curve[name], dtype=np.float64) for name in ("mean", "low", "high", "one", "command")
    )
    for a, name in enumerate(plots.AXES):
        ax = axes[a, 0]
        plots.band(ax, t, low[:, a], high[:, a], plots.MEASURED)
        ax.plot(t, one[:, a], color=plots.MEASURED, lw=0.4, alpha=0.6)
        ax.plot(t, mean[:, a], color=plots.MEASURED, lw=1.2, label="measured")
        ax.plot(t, command[:, a], color=plots.COMMANDED, lw=1.0, ls="--", label="commanded")
        ax.plot(t, mean[:, a] - command[:, a], color=plots.ERROR, lw=0.8, label="error")
        ax.set_ylabel(name)
    axes[2, 0].set_xlabel("time (s)")
    plots.legend(figure, axes[0, 0])
    return figure


LOOKS = (("o", "-"), ("s", "--"), ("^", ":"), ("D", "-."))
"""Marker and line style of each amplitude; colours are the subjects'."""


def _bode(summaries: Summaries) -> plots.Figure:
    figure, axes = plots.panels(3, 2, sharex=True)
    lines = [(who, a) for who, s in summaries.items() for a in dict.fromkeys(e["condition"]["amplitude"] for e in s)]
    amplitudes = list(dict.fromkeys(amplitude for _, amplitude in lines))
    for k, (who, amplitude) in enumerate(lines):
        entries = [e for e in summaries[who] if e["condition"]["amplitude"] == amplitude]
        entries.sort(key=lambda e: -e["condition"]["period"])
        colour = plots.COLOURS[(list(summaries).index(who) if len(summaries) > 1 else k) % len(plots.COLOURS)]
        look = dict(zip(("marker", "ls"), LOOKS[amplitudes.index(amplitude) % len(LOOKS)], strict=True))
        frequency = [(1.0 + 0.012 * k) / e["condition"]["period"] for e in entries]
        for a, axis in enumerate(AXES):
            text = f"{who} {amplitude}".strip() if a == 0 else ""
            plots.intervals(axes[a, 0], frequency, entries, f"gain_{axis}", colour, text, **look)
            plots.intervals(axes[a, 1], frequency, entries, f"lag_{axis}", colour, "", **look)
    for a, axis in enumerate(AXES):
        axes[a, 0].set_ylabel(f"{axis}: gain")
        axes[a, 1].set_ylabel("lag (s)")
        axes[a, 0].axhline(1.0, color="#999999", lw=0.7)
        axes[a, 1].axhline(0.0, color="#999999", lw=0.7)
    for ax in axes[2]:
        ax.set_xlabel("frequency (Hz)")
    plots.legend(figure, axes[0, 0], columns=2)
    return figure
