"""``protocol=energy``: cost of transport, heat, power, saturation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from go1exp import robot
from go1exp.base.report import plots
from go1exp.config.schema.registry import protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import ERRORS, Played, Steady
from go1exp.evaluate.protocol.kinds.gait import straight
from go1exp.evaluate.protocol.plan import Motion
from go1exp.evaluate.quantities import Column, Row, Summaries, Summary, add_measures
from go1exp.mdp.measures.trace import Trace, mean_over, percentile_over

SATURATED = 0.99  # share of the peak torque from which on an actuator counts as saturated
POINTS = 1500  # most dots of one kind of joint in the scatter
PROTECTED_AT = 100.0  # power of one level of the SDK's PowerProtect, W

POWER = (
    Column("power_p99", "W", "sum over joints of |tau qd|, 99th percentile over steps", better="lower"),
    Column("power_max", "W", "the same, largest", better="lower"),
    Column("saturated", "", "share of time and joints at 99 % of peak torque or more", better="lower"),
)


@protocol("energy")
@settings
class Energy(Steady):
    """Cost of transport, heat, power, saturation, and torque over speed inside the motors' envelope, over commands."""

    robot_columns: ClassVar[tuple[Column, ...]] = (
        *ERRORS,
        Column("cost_of_transport_abs", "", "the cost with |tau qd|: what is braked is not won back", better="lower"),
        Column(
            "heat_per_way", "N m s", "sum of tau^2 over weight and way, a measure of the windings' heat", better="lower"
        ),
        *POWER,
        Column("protect_level", "", "lowest level of the SDK's PowerProtect above the largest power", better="lower"),
    )
    always: ClassVar[tuple[str, ...]] = (
        *("cost_of_transport", "torque_share_p99", "joint_speed_share_p99", "envelope_share_p99"),
    )

    def also(self, motion: Motion, rows: Sequence[Row], settle: int) -> None:
        """Write what the trace says of power and heat."""
        assert motion.trace is not None
        add_measures(rows, effort(motion.trace))

    def curves(self, motion: Motion, rows: Sequence[Row], settle: int) -> dict[str, object]:
        """Return torque and speed of some joints at some instants, by kind of joint."""
        trace = motion.trace
        assert trace is not None
        speed, torque = trace.need("joint_vel")[trace.counts], trace.need("joint_torque")[trace.counts]
        rng, dots = np.random.default_rng(0), {}
        for k, kind in enumerate(robot.JOINT_KINDS):
            both = np.stack([speed[:, k::3].ravel(), torque[:, k::3].ravel()], 1)
            sample = both[rng.permutation(len(both))[:POINTS]]
            extremes = both[np.argsort(-np.abs(both[:, 1]))[:50]]
            dots[kind] = np.concatenate([sample, extremes]).round(3).tolist()
        return {"scatter": dots}

    def compared(self, plays: Mapping[str, Played], summaries: Summaries) -> list[plots.Drawing]:
        """Draw the cost of transport over speed."""
        text = "Mechanical work over weight and distance; commands straight ahead and back; 95 % intervals."
        return [plots.Drawing("cost", "Cost of transport over speed", text, partial(_cost, summaries))]

    def details(self, played: Played, summary: Summary) -> list[plots.Drawing]:
        """Draw torque over speed."""
        text = (
            "Dots: all robots and commands, drawn at random, and the 50 largest torques."
            " Solid: peak torque and top speed. Dashed: the line from peak torque at rest to top speed, which is"
            " pessimistic."
        )
        return [plots.Drawing("scatter", "Torque over speed", text, partial(_scatter, played.curves["scatter"]))]


def effort(trace: Trace) -> dict[str, NDArray[np.float64]]:
    """Return figures (N,) of power, heat and saturation of a trace, NaN for robots without a step that counts."""
    torque, power = trace.need("joint_torque"), np.abs(trace.need("joint_torque") * trace.need("joint_vel")).sum(-1)
    speed = np.linalg.norm(trace.need("base_lin_vel_b")[..., :2], axis=-1)
    weight = trace.need("mass") * robot.GRAVITY
    way = mean_over(speed, trace.moving)
    with np.errstate(divide="ignore", invalid="ignore"):
        per_way = 1.0 / np.where(way >= 0.1, weight * way, np.nan)
    share = np.abs(torque) / robot.per_joint(robot.EFFORT_LIMIT)
    power_p99, power_max = (percentile_over(power, trace.counts, percent) for percent in (99.0, 100.0))
    return {
        "cost_of_transport_abs": mean_over(power, trace.moving) * per_way,
        "heat_per_way": mean_over((torque**2).sum(-1), trace.moving) * per_way,
        "power_p99": power_p99,
        "power_max": power_max,
        "saturated": mean_over((share >= SATURATED).mean(-1), trace.counts),
        "protect_level": np.ceil(power_max / PROTECTED_AT),
    }


def _cost(summaries: Summaries) -> plots.Figure:
    figure, axes = plots.panels(1, height=2.3)
    ax = axes[0, 0]
    for k, (who, summary) in enumerate(summaries.items()):
        at, entries = straight(summary)
        plots.intervals(ax, at, entries, "cost_of_transport", plots.COLOURS[k], who or "positive work")
        if len(summaries) == 1:
            plots.intervals(ax, at, entries, "cost_of_transport_abs", plots.COLOURS[1], "all work")
    ax.set(xlabel="commanded vx (m/s)", ylabel="cost of transport")
    ax.set_ylim(bottom=0.0)
    plots.legend(figure, ax)
    return figure


def _scatter(dots: Mapping[str, Sequence[Sequence[float]]]) -> plots.Figure:
    figure, axes = plots.panels(1, 3, height=2.2)
    limits = zip(axes[0], dots.items(), robot.EFFORT_LIMIT, robot.VELOCITY_LIMIT, strict=True)
    for ax, (kind, points), peak, top in limits:
        both = np.array(points)
        # A picture in the figure: thousands of dots would each be a shape of the page.
        ax.plot(both[:, 0], both[:, 1], ".", ms=1.6, color=plots.MEASURED, alpha=0.5, rasterized=True)
        ax.plot([-top, top, top, -top, -top], [peak, peak, -peak, -peak, peak], color=plots.COMMANDED, lw=1.0)
        ax.plot([-top, 0, top], [0, peak, 0], color=plots.ERROR, lw=1.0, ls="--")
        ax.plot([-top, 0, top], [0, -peak, 0], color=plots.ERROR, lw=1.0, ls="--")
        ax.set_title(kind)
        ax.set_xlabel("speed (rad/s)")
    axes[0, 0].set_ylabel("torque (N m)")
    return figure
