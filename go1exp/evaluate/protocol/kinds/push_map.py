"""``protocol=push_map``: the largest kick that a walking robot survives, by direction and gait phase."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from go1exp.base.report import plots
from go1exp.config.schema.registry import Count, Positive, protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import Cause, Length, Played, Protocol, lives
from go1exp.evaluate.protocol.plan import Array, Impulse, Impulses, Motion, Plan, Point, Signal
from go1exp.evaluate.quantities import Column, Derived, Row, Summaries, Summary, by_condition, values

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.stage import Stage

LONGEST_STRIDE = 0.6  # time after the start in which two touchdowns of FR are looked for, twice, s
LOOK_S = 2 * LONGEST_STRIDE  # time after settling in which the latest kick begins, s
LEAST_SWING = 0.05  # s
GUESS = 0.36  # stride of a robot that shows none, s
LEAST_SETTLE, LEAST_WATCH = 1.0, 0.5  # shortest times before and after a kick, s


@protocol("push_map")
@settings
class PushMap(Protocol):
    """Largest kick that is survived, by direction and gait phase, found by bisection; area of the region.

    Attributes:
        command: commanded velocity.
        directions: of the force, evenly around the robot.
        phases: instants of the kick, evenly in the stride of the foot FR.
        settle_s: time before, s.
        push_s: duration of the half-sine force, s.
        point: where it acts, from the trunk's origin in its frame, m.
        largest: of the kicks, N s.
        halvings: of the interval in which the threshold lies, from ``largest`` on.
        watch_s: time after the start of the kick without a fall, s.
    """

    command: Signal
    directions: Annotated[int, Field(ge=3)]
    phases: Count
    settle_s: Annotated[float, Field(ge=LEAST_SETTLE)]
    push_s: Positive
    point: Point
    largest: Impulse
    halvings: Count
    watch_s: Annotated[float, Field(ge=LEAST_WATCH)]

    identical: ClassVar[bool] = False
    keys: ClassVar[tuple[str, ...]] = ("direction_deg",)
    derived_names: ClassVar[tuple[str, ...]] = ("impulse_median", "impulse_p10", "area", "weakest")
    robot_columns: ClassVar[tuple[Column, ...]] = (
        Column("impulse", "N s", "largest impulse without a fall", better="higher"),
    )

    def __post_init__(self) -> None:
        if self.push_s > self.watch_s:
            raise ValueError(f"push_s = {self.push_s}: must be at most watch_s = {self.watch_s}")

    @property
    def count(self) -> int:
        """All robots: ``robots`` in each direction and phase."""
        return self.directions * self.phases * self.robots

    def lengths(self) -> list[Length]:
        """Return that of the walk and one kick: those that follow begin where the first did."""
        settle, watch = self.settle_s, self.watch_s
        causes = [
            Cause("settle_s", settle, LEAST_SETTLE, lambda seconds: seconds - LOOK_S - watch),
            Cause("watch_s", watch, LEAST_WATCH, lambda seconds: seconds - LOOK_S - settle),
        ]
        return [Length(settle + LOOK_S + watch, self.count, causes)]

    def steps(self, stage: Stage) -> float:
        """Return policy steps times robots."""
        trial = stage.steps(LOOK_S + self.watch_s)
        return (stage.steps(self.settle_s) + (2 + self.halvings) * trial) * self.count

    def play(self, stage: Stage) -> Played:
        """Let all walk once; from where they are then, kick them again and again, each in its own phase."""
        t = stage.times(self.settle_s + LOOK_S + self.watch_s)
        command = np.repeat(self.command.at(t)[:, None], self.count, 1)
        nothing = np.zeros((self.count, 1))
        session = stage.session(Plan(command, impulses=Impulses(nothing, nothing, nothing, self.push_s, self.point)))
        settle = stage.steps(self.settle_s)
        walked = session.run(settle)
        state = session.save()
        unkicked = session.run(len(t) - settle)
        robot = np.arange(self.count)
        direction, phase = robot // (self.phases * self.robots), robot // self.robots % self.phases
        stride = [touchdowns(unkicked, n) for n in range(self.count)]
        start = np.array([a + (b - a) * phase[n] / self.phases for n, (a, b) in enumerate(stride)])
        angle = 2.0 * np.pi * direction / self.directions

        def survives(impulse: Array) -> NDArray[np.bool_]:
            session.load(state, settle)
            session.use(Impulses(start[:, None], impulse[:, None], angle[:, None], self.push_s, self.point))
            motion = session.run(len(t) - settle)
            end = np.round((start + self.watch_s - motion.t[0]) / motion.dt).astype(int)
            return motion.alive[np.clip(end, 0, len(motion.alive) - 1), robot]

        figures = largest_survived(survives, self.count, self.largest, self.halvings)
        rows, later = lives(walked), lives(unkicked)
        for n, row in enumerate(rows):
            up = bool(unkicked.alive[-1, n])
            number = int(phase[n] * self.robots + n % self.robots)
            row |= {"direction_deg": float(np.degrees(angle[n])), "robot": number}
            row |= {"phase": float(phase[n] / self.phases), "fell": not up and not unkicked.left_map[n]}
            row["moving_s"] += later[n]["moving_s"]
            row["impulse"] = float(figures[n]) if up else None
        censored = int((figures >= self.largest).sum())
        notes = [f"{censored} robots withstood the largest impulse of {self.largest:g} N s: their limit may be larger."]
        return Played(rows, {}, notes if censored else [])

    def derived(self, rows: Sequence[Row]) -> list[Derived]:
        """Return median and 10th percentile of each direction, and the area within the medians."""
        angles = sorted({row["direction_deg"] for row in rows})
        figures = [
            Derived(name, "N s", meaning, {"direction_deg": angle}, "higher", partial(_percentile, percent=percent))
            for angle in angles
            for name, percent, meaning in (
                ("impulse_median", 50.0, "median of the largest impulse without a fall"),
                ("impulse_p10", 10.0, "its 10th percentile: nine of ten robots and phases survive it"),
            )
        ]
        area = Derived("area", "(N s)^2", "area within the medians of all directions", {}, "higher", _area)
        return [*figures, area, Derived("weakest", "N s", "smallest median of all directions", {}, "higher", _weakest)]

    def compared(self, plays: Mapping[str, Played], summaries: Summaries) -> list[plots.Drawing]:
        """Draw the maps of all subjects."""
        text = "Largest impulse without a fall, N s; up is forward: median with 95 % interval; dotted: 10th percentile."
        return [plots.Drawing("map", "Impulse map", text, partial(_map, summaries))]

    def details(self, played: Played, summary: Summary) -> list[plots.Drawing]:
        """Draw the impulse over the phase of the gait."""
        text = (
            "Median over robots and directions, 10th to 90th percentile, by the phase in the stride of FR at which the"
            " kick begins; FR touches down at 0."
        )
        return [plots.Drawing("phase", "By gait phase", text, partial(_phases, played.rows))]


def largest_survived(
    survives: Callable[[Array], NDArray[np.bool_]], count: int, largest: float, halvings: int
) -> Array:
    """Return for each of ``count`` robots the largest impulse that it survives, by bisection, all at once.

    ``survives`` says which robots survive the impulses (count,). Zero counts as survived; a robot that survives
    ``largest`` has that. The answer is at most ``largest`` / 2^``halvings`` too small, where more is never easier.
    """
    low, high = np.zeros(count), np.full(count, largest)
    top = survives(high)
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        held = survives(middle)
        low, high = np.where(held, middle, low), np.where(held, high, middle)
    return np.where(top, largest, low)


def touchdowns(motion: Motion, n: int) -> tuple[float, float]:
    """Return the times of the first two touchdowns of robot ``n``'s foot FR, s; guesses where it has none."""
    on = motion.front_right[:, n]
    steps = max(1, round(LEAST_SWING / motion.dt))
    # Shorter times in the air are bounces and no swings.
    in_air = np.convolve(on == 0.0, np.ones(steps), "full")[: len(on)] > steps - 0.5
    landed = 1 + np.flatnonzero((on[1:] > 0.0) & in_air[:-1])
    times = motion.t[landed] - on[landed]
    first = float(times[0]) if len(times) else float(motion.t[0])
    if first > motion.t[0] + LONGEST_STRIDE:
        first = float(motion.t[0])
    stride = float(times[1]) - first if len(times) > 1 else GUESS
    return first, first + (stride if 0.1 < stride < LONGEST_STRIDE else GUESS)


def _percentile(rows: Sequence[Row], percent: float) -> float:
    each = values(rows, "impulse")
    return float(np.nanpercentile(each, percent)) if np.isfinite(each).any() else np.nan


def _medians(rows: Sequence[Row]) -> Array:
    directions = by_condition(rows, ("direction_deg",))
    return np.array([_percentile(directions[angle], 50.0) for angle in sorted(directions)])


def _area(rows: Sequence[Row]) -> float:
    radius = _medians(rows)
    return float(0.5 * np.sin(2.0 * np.pi / len(radius)) * (radius * np.roll(radius, -1)).sum())


def _weakest(rows: Sequence[Row]) -> float:
    return float(_medians(rows).min())


def _map(summaries: Summaries) -> plots.Figure:
    figure, axes = plots.panels(1, height=4.0, subplot_kw={"projection": "polar"})
    ax = axes[0, 0]
    for k, (who, summary) in enumerate(summaries.items()):
        for name, style in (("impulse_median", "-"), ("impulse_p10", ":")):
            figures = [(e["condition"]["direction_deg"], e["figures"][name]) for e in summary if name in e["figures"]]
            shown = [(np.radians(a), f) for a, f in figures if f["estimate"] is not None]
            if not shown or (style == ":" and len(summaries) > 1):
                continue
            angle = np.array([a for a, _ in shown] + [shown[0][0] + 2 * np.pi])
            closed = [f for _, f in shown] + [shown[0][1]]
            points = np.array([(f["estimate"], f["low"], f["high"]) for f in closed], dtype=np.float64)
            middle, low, high = np.where(np.isnan(points), points[:, :1], points).T
            text = {"impulse_median": "median", "impulse_p10": "10th percentile"}[name]
            ax.plot(angle, middle, style, color=plots.COLOURS[k], lw=1.4, label=f"{who} {text}".strip())
            if style == "-":
                plots.band(ax, angle, low, high, plots.COLOURS[k])
    ax.set_theta_zero_location("N")
    ax.set_ylim(bottom=0.0)
    ax.set_rlabel_position(112.5)
    ax.tick_params(labelsize=7)
    ax.set_xticks(np.arange(8) * np.pi / 4, ["forward", "45°", "left", "135°", "back", "-135°", "right", "-45°"])
    plots.legend(figure, ax, columns=2)
    return figure


def _phases(rows: Sequence[Row]) -> plots.Figure:
    figure, axes = plots.panels(1, height=2.0)
    phases = sorted({row["phase"] for row in rows})
    each = [values([r for r in rows if r["phase"] == p], "impulse") for p in phases]
    each = [e[np.isfinite(e)] for e in each]
    at = [p for p, e in zip(phases, each, strict=True) if len(e)]
    defined = [e for e in each if len(e)]
    ax = axes[0, 0]
    if defined:
        low, high = ([np.quantile(e, share) for e in defined] for share in (0.1, 0.9))
        plots.band(ax, at, low, high, plots.MEASURED)
        ax.plot(at, [np.median(e) for e in defined], "-o", ms=3.5, color=plots.MEASURED)
    ax.set(xlabel="phase of FR (cycles)", ylabel="impulse (N s)")
    ax.set_ylim(bottom=0.0)
    return figure
