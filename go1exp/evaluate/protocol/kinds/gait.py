"""``protocol=gait``: how the feet go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np

from go1exp import robot
from go1exp.base.report import plots
from go1exp.config.schema.registry import protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import ERRORS, Played, Steady, by_axis, command_text, rounded
from go1exp.evaluate.protocol.plan import Motion
from go1exp.evaluate.quantities import Column, Row, Summaries, Summary, SummaryEntry
from go1exp.mdp.measures.gait import touchdown_phase
from go1exp.mdp.measures.trace import find_runs

SHOWN = 1.5  # time of the gait diagram, s


@protocol("gait")
@settings
class Gait(Steady):
    """Phases, duty, stride rate, clearance, loads, impacts and slip of the feet, over commands; gait diagrams."""

    robot_columns: ClassVar[tuple[Column, ...]] = (
        *ERRORS,
        Column("stride_length", "m", "way of the trunk in a stride"),
        Column("symmetry", "", "largest difference of duty between left and right, over their mean", better="lower"),
    )
    always: ClassVar[tuple[str, ...]] = (
        *("touchdown_phase", "phase_consistency", "trot_error", "gait", "duty_factor", "stride_rate", "clearance"),
        *("flight_share", "load_share", "touchdown_speed_p95", "peak_force_p95", "slip_share_all", "slip_distance"),
    )

    def also(self, motion: Motion, rows: Sequence[Row], settle: int) -> None:
        """Write stride length and symmetry."""
        speed = np.linalg.norm(motion.velocity[settle:, :, :2], axis=-1)
        for n, row in enumerate(rows):
            up, rate = motion.alive[settle:, n], row.get("stride_rate")
            row["stride_length"] = float(speed[up, n].mean() / rate) if rate and up.any() else None
            duty = [row.get(f"duty_factor_{leg}") for leg in robot.LEGS]
            row["symmetry"] = _asymmetry(duty)

    def curves(self, motion: Motion, rows: Sequence[Row], settle: int) -> dict[str, object]:
        """Return stances of the first robot of each command, and the phases of all."""
        trace = motion.trace
        assert trace is not None
        phases, feet = touchdown_phase(trace), {}
        samples = round(SHOWN / trace.contact_dt)
        for k, command in enumerate(self.commands):
            robots = slice(k * self.robots, (k + 1) * self.robots)
            up = np.flatnonzero(motion.alive[-1, robots])
            n = k * self.robots + (int(up[0]) if len(up) else 0)
            touching = trace.touching[-samples:, n].T.astype(np.int8)
            runs = find_runs(np.ascontiguousarray(touching)).where(1, whole=False)
            stances = [
                [int(c), round(a * trace.contact_dt, 4), round(b * trace.contact_dt, 4)]
                for c, a, b in zip(runs.column, runs.start, runs.stop, strict=True)
            ]
            feet[command_text(by_axis(command))] = {"stances": stances, "phases": rounded(phases[robots])}
        return {"feet": feet}

    def compared(self, plays: Mapping[str, Played], summaries: Summaries) -> list[plots.Drawing]:
        """Draw the gait of all subjects over speed."""
        text = "Commands straight ahead, with 95 % intervals over robots."
        return [plots.Drawing("speed", "Gait over speed", text, partial(_over_speed, summaries))]

    def details(self, played: Played, summary: Summary) -> list[plots.Drawing]:
        """Draw gait diagrams, and phases on the circle."""
        feet = played.curves["feet"]
        diagram = f"Bars: stance of one robot that does not fall, the last {SHOWN:g} s. Commands: m/s, rad/s."
        circle = (
            "Touchdowns in the stride of FR (cycles), a dot for each robot; up is 0, clockwise. In a trot FL and RR"
            " are opposite, RL is with FR. Commands: m/s, rad/s."
        )
        return [
            plots.Drawing("diagram", "Gait diagram", diagram, partial(_diagram, feet)),
            plots.Drawing("circle", "Phases of the feet", circle, partial(_circle, feet)),
        ]


def _asymmetry(duty: Sequence[float | None]) -> float | None:
    if any(d is None for d in duty):
        return None
    d = [float(v) for v in duty if v is not None]
    pairs = [(d[k], d[m]) for k, m in enumerate(robot.MIRROR_LEGS) if k < m]
    return max(abs(a - b) / (0.5 * (a + b)) for a, b in pairs) if all(a + b for a, b in pairs) else None


def _diagram(feet: Mapping[str, Any]) -> plots.Figure:
    figure, axes = plots.panels(len(feet), height=0.75, sharex=True)
    for ax, (name, shown) in zip(axes[:, 0], feet.items(), strict=True):
        for foot, start, stop in shown["stances"]:
            ax.barh(foot, stop - start, left=start, height=0.72, color=plots.COLOURS[foot])
        ax.set_yticks(range(robot.NUM_LEGS), robot.LEGS, fontsize=6.5)
        ax.set(xlim=(0.0, SHOWN), ylim=(robot.NUM_LEGS - 0.4, -0.6))
        ax.set_title(name, loc="left", pad=2)
        ax.grid(False, axis="y")
    axes[-1, 0].set_xlabel("time (s)")
    return figure


def _circle(feet: Mapping[str, Any]) -> plots.Figure:
    columns = 3
    rows = -(-len(feet) // columns)
    figure, axes = plots.panels(rows, columns, height=1.75, subplot_kw={"projection": "polar"})
    for ax, (name, shown) in zip(axes.flat, feet.items(), strict=False):
        for foot in range(robot.NUM_LEGS):
            turn = [2.0 * np.pi * p[foot] for p in shown["phases"] if p[foot] is not None]
            radius = np.full(len(turn), 1.0 - 0.12 * foot)
            ax.plot(turn, radius, "o", ms=3, color=plots.COLOURS[foot], label=robot.LEGS[foot])
        ax.set_theta_zero_location("N")
        ax.set_theta_direction(-1)
        ax.set_ylim(0.0, 1.1)
        ax.set_yticks([])
        ax.set_xticks(np.arange(4) * np.pi / 2, ["0", "¼", "½", "¾"], fontsize=7)
        ax.set_title(name, fontsize=7)
    for ax in axes.flat[len(feet) :]:
        ax.remove()
    plots.legend(figure, axes[0, 0], columns=4)
    return figure


SPEED = (
    ("stride_rate", "stride rate (Hz)"),
    ("stride_length", "stride length (m)"),
    ("duty_factor_FR", "duty of FR"),
    ("clearance_FR", "clearance of FR (m)"),
    ("touchdown_speed_p95", "touchdown (m/s)"),
    ("slip_share_all", "slipping share"),
)


def _over_speed(summaries: Summaries) -> plots.Figure:
    figure, axes = plots.panels(3, 2, sharex=True)
    for k, (who, summary) in enumerate(summaries.items()):
        at, entries = straight(summary)
        for ax, (name, _) in zip(axes.flat, SPEED, strict=True):
            plots.intervals(ax, at, entries, name, plots.COLOURS[k], who)
    for ax, (_, text) in zip(axes.flat, SPEED, strict=True):
        ax.set_ylabel(text)
    for ax in axes[-1]:
        ax.set_xlabel("commanded vx (m/s)")
    plots.legend(figure, axes[0, 0])
    return figure


def straight(summary: Summary) -> tuple[list[float], list[SummaryEntry]]:
    """Return the conditions whose command is straight ahead or back, by rising velocity, m/s; the velocities first."""
    ahead = [e for e in summary if "x" in e["condition"] and not any(e["condition"].get(k) for k in ("y", "yaw"))]
    ahead.sort(key=lambda e: e["condition"]["x"])
    return [e["condition"]["x"] for e in ahead], ahead
