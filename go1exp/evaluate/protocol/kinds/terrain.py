"""``protocol=terrain``: success against difficulty of the ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from pydantic import Field

from go1exp.base.report import plots
from go1exp.config.schema.registry import NonNegative, PositiveRange, Speed, protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import Cause, Length, Played, Protocol, lives, repeated
from go1exp.evaluate.protocol.ground import GOAL, UNITS, GroundName, Lanes, wrong_difficulties
from go1exp.evaluate.protocol.plan import Motion, Plan
from go1exp.evaluate.quantities import Column, Derived, Row, Summaries, Summary, values
from go1exp.evaluate.statistics.intervals import Logistic, logistic_fit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from go1exp.evaluate.protocol.stage import Stage

SHARES = {"at_half": 0.5, "at_95": 0.95}
LEAST_SLACK = 1.0  # of the time at the commanded speed: less is too little for every robot
START_S = 1.0  # time that a robot has beside it, to begin, s


@protocol("terrain")
@settings
class OnTerrain(Protocol):
    """Success against difficulty on slopes, gravel, waves, stairs, boxes, blocks; where half and where 95 % succeed.

    Attributes:
        grounds: difficulties of each ground, rising: degrees of slopes, metres of all others; null leaves one out.
        speeds: commanded velocities straight ahead, m/s.
        slack: time that a robot has for its lane, over that at the commanded speed; at least 1.
        steer: yaw rate with which it is turned back, per rad of heading and per m beside its lane.
        gravel_friction: range of the feet's friction on gravel.
        ground_seed: of the random heights.
    """

    grounds: dict[GroundName, Annotated[tuple[NonNegative, ...], Field(min_length=2)] | None]
    speeds: Annotated[tuple[Annotated[Speed, Field(gt=0)], ...], Field(min_length=1)]
    slack: Annotated[float, Field(ge=LEAST_SLACK)]
    steer: tuple[NonNegative, NonNegative]
    gravel_friction: PositiveRange
    ground_seed: Annotated[int, Field(ge=0)]

    identical: ClassVar[bool] = False
    keys: ClassVar[tuple[str, ...]] = ("ground", "speed", "difficulty")
    derived_names: ClassVar[tuple[str, ...]] = tuple(SHARES)
    robot_columns: ClassVar[tuple[Column, ...]] = (
        Column("passed", "", "came to the end of its lane in time, without a fall", "share", "higher"),
        Column(
            "speed_kept", "", "mean speed along the lane over the commanded one, of those that passed", better="higher"
        ),
    )

    def __post_init__(self) -> None:
        ladders = self.ladders.items()
        wrong = [line for name, levels in ladders for line in wrong_difficulties(f"grounds.{name}", name, levels)]
        wrong += repeated("speeds", self.speeds)
        if not self.ladders:
            wrong = ["grounds: at least one is needed"]
        if wrong:
            raise ValueError("\n".join(wrong))

    @property
    def ladders(self) -> dict[GroundName, tuple[float, ...]]:
        """Return the grounds that are played."""
        return {name: levels for name, levels in self.grounds.items() if levels is not None}

    def duration(self, speed: float) -> float:
        """Return the time that a robot has, s."""
        return self.slack * (GOAL + 0.5) / speed + START_S

    def lengths(self) -> list[Length]:
        """Return that of each ground at each speed, all difficulties as one batch."""
        recorded = bool(self.terms())
        return [
            Length(self.duration(speed), len(levels) * self.robots, self._causes(speed), recorded=recorded)
            for levels in self.ladders.values()
            for speed in self.speeds
        ]

    def _causes(self, speed: float) -> list[Cause]:
        way, slack = GOAL + 0.5, self.slack

        def pace(seconds: float) -> float:
            return slack * way / (seconds - START_S) if seconds > START_S else -1.0  # at no speed

        return [
            Cause("slack", slack, LEAST_SLACK, lambda seconds: (seconds - START_S) * speed / way, unit=""),
            Cause("speeds", speed, 0.0, pace, " m/s", falling=True),
        ]

    def play(self, stage: Stage) -> Played:
        """Play each ground at each speed, all difficulties as one batch."""
        rows: list[Row] = []
        for name, levels in self.ladders.items():
            lanes = Lanes(ground=name, levels=levels, seed=self.ground_seed)
            friction = self.gravel_friction if name == "gravel" else None
            for speed in self.speeds:
                t = stage.times(self.duration(speed))
                command = np.tile(np.array([speed, 0.0, 0.0]), (len(t), len(levels) * self.robots, 1))
                listen = 0 if self.terms() else None
                plan = Plan(command, ground=lanes, friction=friction, steer=self.steer, listen_from=listen, finish=GOAL)
                motion = stage.run(plan)
                those = self._rows(motion, name, speed, levels)
                self.measure(motion, those)
                rows += those
        return Played(rows)

    def _rows(self, motion: Motion, name: str, speed: float, levels: Sequence[float]) -> list[Row]:
        """Return a row for each robot: robot i walks lane i modulo the number of lanes."""
        arrived = (motion.way >= GOAL) & motion.alive
        passed, first = np.asarray(arrived.any(0)), np.asarray(arrived.argmax(0))
        rows = lives(motion)
        for n, row in enumerate(rows):
            row |= {"ground": name, "speed": float(speed), "difficulty": float(levels[n % len(levels)])}
            row |= {"robot": n // len(levels), "passed": bool(passed[n]), "speed_kept": None}
            if passed[n]:  # what it does behind the end of its lane does not count
                way, took = float(motion.way[first[n], n]), float(motion.t[first[n]])
                row |= {"fell": False, "left_map": False, "moving_s": round(took, 4), "speed_kept": way / took / speed}
        return rows

    def derived(self, rows: Sequence[Row]) -> list[Derived]:
        """Return where half and where 95 % succeed, of each ground and speed."""
        figures = []
        for name, levels in self.ladders.items():
            for speed in self.speeds:
                for key, share in SHARES.items():
                    text = f"difficulty that {share:.0%} pass, at the ladder's end where all or none do"
                    function = partial(_where, share=share, top=float(levels[-1]))
                    condition = {"ground": name, "speed": float(speed)}
                    figures.append(Derived(key, UNITS[name], text, condition, "higher", function))
        return figures

    def compared(self, plays: Mapping[str, Played], summaries: Summaries) -> list[plots.Drawing]:
        """Draw the curves of all subjects."""
        text = "Share that reached the end of its lane, Wilson's 95 % interval and logistic fit; slopes in degrees."
        return [plots.Drawing("success", "Success against difficulty", text, partial(_success, plays, summaries))]


def _fit(rows: Sequence[Row]) -> Logistic | None:
    return logistic_fit(values(rows, "difficulty"), values(rows, "passed"))


def _where(rows: Sequence[Row], share: float, top: float) -> float:
    """Return the difficulty that ``share`` pass, within 0 and the ladder's ``top``."""
    passed = values(rows, "passed")
    if not len(passed):
        return np.nan
    fit = _fit(rows)
    if fit is None:
        return top if passed.all() else 0.0
    return float(np.clip(fit.where(share), 0.0, top))


def _success(plays: Mapping[str, Played], summaries: Summaries) -> plots.Figure:
    grounds = list(dict.fromkeys(e["condition"]["ground"] for e in next(iter(summaries.values()))))
    columns = 2 if len(grounds) > 1 else 1
    figure, axes = plots.panels(-(-len(grounds) // columns), columns, height=1.6, sharey=True)
    for w, (who, played) in enumerate(plays.items()):
        for ax, ground in zip(axes.flat, grounds, strict=False):
            _curve(ax, [r for r in played.rows if r["ground"] == ground], summaries[who], ground, who, w)
    for ax, ground in zip(axes.flat, grounds, strict=False):
        ax.set_title(ground.replace("_", " "), loc="left")
        ax.set(xlabel=f"difficulty ({UNITS[ground]})", ylim=(-0.04, 1.04))
    for ax in axes.flat[len(grounds) :]:
        ax.remove()
    for ax in axes[:, 0]:
        ax.set_ylabel("share")
    plots.legend(figure, axes[0, 0])
    return figure


def _curve(ax: Axes, rows: Sequence[Row], summary: Summary, ground: str, who: str, colour_from: int) -> None:
    """Draw the success of one subject on one ground, a line for each speed."""
    for k, speed in enumerate(dict.fromkeys(r["speed"] for r in rows)):
        condition = {"ground": ground, "speed": speed}
        entries = [e for e in summary if "passed" in e["figures"] and condition.items() <= e["condition"].items()]
        at = [e["condition"]["difficulty"] for e in entries]
        colour = plots.COLOURS[(colour_from + k) % len(plots.COLOURS)]
        text = f"{who} {speed:g} m/s".strip()
        plots.intervals(ax, at, entries, "passed", colour, text, ls="none")
        fit = _fit([r for r in rows if r["speed"] == speed])
        if fit is not None:
            x = np.linspace(min(at), max(at), 60)
            ax.plot(x, fit(x), color=colour, lw=1.0)
