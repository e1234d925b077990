"""``protocol=corners``: how a robot answers steps of the command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from go1exp.base.report import plots
from go1exp.config.schema.registry import protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import ERRORS, Played, Steady, bands, by_axis, command_text, rounded
from go1exp.evaluate.protocol.plan import Motion
from go1exp.evaluate.quantities import Column, Row, Summaries, Summary

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

    def curves(self, motion: Motion, rows: Sequence[Row], settle: int) -> dict[str, object]:
        """Return the mean velocity along each command, as a share of the command, over time."""
        shares = {}
        for k, command in enumerate(self.commands):
            robots, c = slice(k * self.robots, (k + 1) * self.robots), np.array(command)
            if not c.any():
                continue
            along = np.where(motion.alive[:, robots], motion.velocity[:, robots] @ c / (c @ c), np.nan)
            shares[command_text(by_axis(command))] = rounded(bands(along, np.nanmean)[0])
        return {"t": rounded(motion.t), "along": shares}

    def compared(self, plays: Mapping[str, Played], summaries: Summaries) -> list[plots.Drawing]:
        """Draw the answers of all subjects."""
        text = "Share of each command that is reached, 95 % intervals over robots still standing; red: falls."
        return [plots.Drawing("answer", "Steady-state velocity", text, partial(_answers, summaries))]

    def details(self, played: Played, summary: Summary) -> list[plots.Drawing]:
        """Draw the steps."""
        text = f"Mean share of the command over robots still standing, from rest at {self.rest_s:g} s."
        return [
            plots.Drawing("steps", "Steps from rest", text, partial(_steps, played.curves["t"], played.curves["along"]))
        ]


def step_answer(along: NDArray[np.float64], step: int, settle: int, dt: float) -> Row:
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


def _answers(summaries: Summaries) -> plots.Figure:
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
    plots.legend(figure, ax)
    return figure


def _steps(t: Sequence[float], along: Mapping[str, Sequence[float | None]]) -> plots.Figure:
    columns = 3
    figure, axes = plots.panels(-(-len(along) // columns), columns, height=1.1, sharex=True, sharey=True)
    for ax, (name, share) in zip(axes.flat, along.items(), strict=False):
        ax.axhline(1.0, color="#999999", lw=0.8)
        ax.plot(t, np.array(share, dtype=float), color=plots.MEASURED, lw=0.9)
        ax.set_title(name, fontsize=6.8, pad=2)
        ax.set_ylim(-0.4, 1.7)
    for ax in axes.flat[len(along) :]:
        ax.remove()
    for ax in axes[-1]:
        ax.set_xlabel("time (s)")
    return figure
