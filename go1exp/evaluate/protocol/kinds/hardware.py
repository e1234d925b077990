"""``protocol=hardware``: acceptance of a policy for a Go1."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from itertools import takewhile
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from pydantic import Field

from go1exp.base.report import plots
from go1exp.config.schema.registry import protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import ERRORS, Length, Played, Steady, by_axis, lives
from go1exp.evaluate.protocol.claims import evaluated
from go1exp.evaluate.protocol.kinds.energy import POWER, effort
from go1exp.evaluate.protocol.kinds.rate import LATEST_MS
from go1exp.evaluate.protocol.plan import Motion, Plan
from go1exp.evaluate.quantities import AXES, FELL, Column, Derived, Row, Summary, add_measures
from go1exp.evaluate.quantities import summary as summarised

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.stage import Stage


@protocol("hardware")
@settings
class Hardware(Steady):
    """Limits of a Go1: torque, speed, power, impact, slip, delay margin, action rate.

    Attributes:
        delays_ms: further command delays, added to those of the robot, rising.
    """

    delays_ms: Annotated[tuple[Annotated[float, Field(gt=0, le=LATEST_MS)], ...], Field(min_length=1)]

    keys: ClassVar[tuple[str, ...]] = (*AXES, "delay_ms")
    derived_names: ClassVar[tuple[str, ...]] = ("delay_margin",)
    robot_columns: ClassVar[tuple[Column, ...]] = (*ERRORS, *POWER)
    always: ClassVar[tuple[str, ...]] = (
        *("torque_share_p99", "joint_speed_share_p99", "envelope_share_p99", "target_step_p99", "slip_share_all"),
        *("touchdown_speed_p95", "peak_force_p95"),
    )

    def __post_init__(self) -> None:
        Steady.__post_init__(self)
        if sorted(set(self.delays_ms)) != list(self.delays_ms):
            raise ValueError(f"delays_ms = {list(self.delays_ms)}: must rise")

    def lengths(self) -> list[Length]:
        """Return the lengths of the commands without and with further delays."""
        (usual,) = Steady.lengths(self)
        return [usual, dataclasses.replace(usual, robots=usual.robots * len(self.delays_ms), recorded=False)]

    def play(self, stage: Stage) -> Played:
        """Play the commands without further delays, and again with them, for falls alone."""
        played = Steady.play(self, stage)
        for row in played.rows:
            row["delay_ms"] = 0.0
        t = stage.times(self.seconds)
        each = len(self.commands) * self.robots
        velocities = np.repeat(np.array(self.commands), self.robots, axis=0)
        command = np.tile(velocities, (len(t), len(self.delays_ms), 1)) * (t >= self.rest_s - 1e-9)[:, None, None]
        delay = np.repeat(np.array(self.delays_ms) * 1e-3, each)
        rows = lives(stage.run(Plan(command, delay=delay)))
        for n, row in enumerate(rows):
            row |= {**by_axis(velocities[n % each]), "robot": n % self.robots}
            row["delay_ms"] = float(self.delays_ms[n // each])
        played.rows += rows
        return played

    def also(self, motion: Motion, rows: Sequence[Row], settle: int) -> None:
        """Write power and saturation."""
        assert motion.trace is not None
        figures = effort(motion.trace)
        add_measures(rows, {column.name: figures[column.name] for column in POWER})

    def derived(self, rows: Sequence[Row]) -> list[Derived]:
        """Return the delay margin."""
        text = "largest command delay up to which no robot falls"
        return [Derived("delay_margin", "ms", text, {}, "higher", _margin)]

    def details(self, played: Played, summary: Summary) -> list[plots.Drawing]:
        """Draw each item against its limit, and falls over the delay."""
        bars = (
            "Figure of the worst command over its upper limit, 95 % interval; beyond the line the limit is not met."
            " Green: met; brown: close; red: not met; grey: inconclusive."
        )
        delay = "Share of robots of all commands that fell, with Wilson's 95 % interval."
        return [
            plots.Drawing("items", "Items against their limits", bars, partial(_items, self, summary)),
            plots.Drawing("delay", "Falls with command delay", delay, partial(_falls, played.rows)),
        ]


def _margin(rows: Sequence[Row]) -> float:
    """Return the largest delay (ms) up to which none of the rows fell; 0 also if one did without any."""
    fell = {row["delay_ms"] for row in rows if row["fell"]}
    held = takewhile(lambda delay: delay not in fell, sorted({row["delay_ms"] for row in rows}))
    return float(max(held, default=0.0))


def _items(hardware: Hardware, summary: Summary) -> plots.Figure:
    verdicts = [v for v in evaluated(hardware.claims, summary) if v.claim.at_most and np.isfinite(v.figure.estimate)]
    figure, axes = plots.panels(1, height=0.5 + 0.26 * max(len(verdicts), 1))
    ax = axes[0, 0]
    tones = {"met": "#00705a", "close": "#8a5a00", "not met": "#a63f00", "inconclusive": "#59616a"}
    for k, v in enumerate(verdicts):
        limit = v.claim.at_most or 1.0
        low, high = (v.figure.estimate if np.isnan(x) else x for x in (v.figure.low, v.figure.high))
        ax.barh(k, v.figure.estimate / limit, height=0.55, color=tones[v.word], alpha=0.75)
        ax.plot([low / limit, high / limit], [k, k], color="#1d2125", lw=1.2)
    ax.axvline(1.0, color="#1d2125", lw=1.0, ls="--")
    ax.set_yticks(range(len(verdicts)), [v.name.replace("_", " ") for v in verdicts], fontsize=7)
    ax.invert_yaxis()
    ax.set_xlabel("figure over limit")
    return figure


def _falls(rows: Sequence[Row]) -> plots.Figure:
    figure, axes = plots.panels(1, height=1.9)
    entries = summarised(rows, ("delay_ms",), (FELL,))
    delays = [e["condition"]["delay_ms"] for e in entries]
    plots.intervals(axes[0, 0], delays, entries, "fell", plots.MEASURED, "")
    axes[0, 0].set(xlabel="command delay (ms)", ylabel="share that fell", ylim=(-0.03, 1.03))
    return figure
