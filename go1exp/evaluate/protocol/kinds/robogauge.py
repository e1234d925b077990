"""``protocol=robogauge``: the assessment of RoboGauge (Wu et al., arXiv 2602.00678), written anew for the Go1.

As published: flat ground; ten levels of slopes and stairs, each forward and backward, of waves and of obstacles;
frictions of 0.2 to 1.0, command delay up to a period of the policy, sensor noise. On each ground and friction the
highest level is found by bisection, where 80 % come to the end in time. In the middle of that level robots then follow
the largest command of each axis with a stop, and eight directions turned about. Ten times a second six metrics of 0 to
1 are taken (``grading.py``); quality is their geometric mean, velocities with twice the weight, over the worse half of
the time. Level L with quality Q scores 0.09 (L - 1) + 0.19 Q, level 0 scores 0 and flat ground Q; the score is the mean
over frictions, then over the seven grounds.

The metrics are those of the first version, by which DreamWaQ, HIM and MoE-CTS were scored; a later one adds margins of
friction and of the zero-moment point. Ranges of joints are the Go1's; 100 W and 30 N m are as published. Chosen:

- plan of the blocks (that of ``terrain=steps``) and length of the waves: no readable file is published;
- what a robot that is turned over would do in the rest of a sub-task counts 0, where the published leaves it out;
- a robot keeps one delay, where the published draws one in every step; it adds to that of the robot of training;
- every level is walked, so that each has its share and interval.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from go1exp.base.report import plots
from go1exp.config.schema.registry import NonNegative, Positive, bind_list, protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import Cause, Length, Played, Protocol, repeated
from go1exp.evaluate.protocol.grading import CHANNELS, METRICS, Graded, Subtask, channels, highest_level, score
from go1exp.evaluate.protocol.ground import GroundName, Lanes, wrong_difficulties
from go1exp.evaluate.protocol.kinds.rate import LATEST_MS
from go1exp.evaluate.protocol.plan import NEVER, Array, Plan
from go1exp.evaluate.quantities import (
    FINGERPRINT,
    ROBOT,
    Column,
    Derived,
    Row,
    Summaries,
    Summary,
    about,
    by_condition,
    values,
)

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.stage import Stage

FLAT = "flat"
MOST_LEVELS = 10  # at which the published score reaches 1
LEVEL = "level_"  # first part of the names of the columns with whether a robot passed a level, 1 for the first
STEER = (1.5, 0.5)  # yaw rate with which a robot is turned back, per rad of heading and per m beside its lane
PATCH, PATCH_WIDTH = 13.0, 14.0  # length and width of the ground on which commands are followed, m: 5 m to each side
PUBLISHED = {"MoE-CTS": 0.68, "HIM": 0.52, "DreamWaQ": 0.48}  # policies for a Go2

Largest = tuple[Positive, Positive, Positive]
Share = Annotated[float, Field(gt=0, le=1)]


@settings
class Assessed:
    """One ground with levels.

    Attributes:
        lane: its kind.
        levels: difficulty of each level, rising, at most ten: degrees of slopes, metres of all others.
        course: length, m.
        speed: commanded speed along it, m/s.
        seconds: time for it, s.
        backward: robots walk backward.
    """

    lane: GroundName
    levels: Annotated[tuple[NonNegative, ...], Field(min_length=1, max_length=MOST_LEVELS)]
    course: Annotated[float, Field(gt=0, le=100)]
    speed: Annotated[float, Field(gt=0, le=100)]
    seconds: Positive
    backward: bool


@protocol("robogauge")
@settings
class RoboGauge(Protocol):
    """RoboGauge (arXiv 2602.00678): highest level passed and quality on seven grounds, one score from 0 to 1.

    Attributes:
        frictions: of the feet; as many robots for each.
        delay_ms: largest further command delay; evenly spread over the robots.
        fall_tilt: angle of the trunk to the vertical from which on a robot has fallen, whatever its training says, rad.
        pass_share: of the robots that must come to the end of a level.
        ground_seed: of the random heights.
        flat: largest commands on flat ground: x m/s, y m/s, yaw rad/s.
        uneven: the same on all other ground.
        move_s: time of the largest command of an axis, s.
        stand_s: time without a command after it, s.
        pair_s: time of a direction and its opposite, s.
        settle_s: time without a command before, s.
        grounds: those with levels; null leaves one out.
    """

    frictions: Annotated[tuple[Annotated[float, Field(gt=0, le=10)], ...], Field(min_length=1)]
    delay_ms: Annotated[float, Field(ge=0, le=LATEST_MS)]
    fall_tilt: Annotated[float, Field(gt=0, lt=NEVER)]
    pass_share: Share
    ground_seed: Annotated[int, Field(ge=0)]
    flat: Largest
    uneven: Largest
    move_s: Positive
    stand_s: NonNegative
    pair_s: Positive
    settle_s: NonNegative
    grounds: dict[str, Assessed | None]

    identical: ClassVar[bool] = False
    keys: ClassVar[tuple[str, ...]] = ("ground",)
    derived_names: ClassVar[tuple[str, ...]] = ("level", "score", "overall_level", "overall_score")
    robot_columns: ClassVar[tuple[Column, ...]] = (
        Column(
            "levels", "", "number of levels of which a robot came to the end in time, without a fall", better="higher"
        ),
        Column("quality_worst", "", "quality over the worse half of the time", better="higher"),
        Column("quality", "", "geometric mean of the six metrics over time; 0 after a fall", better="higher"),
        *(Column(name, "", f"{meaning}; until a fall", better="higher") for name, (_, meaning) in METRICS.items()),
    )

    def __post_init__(self) -> None:
        wrong = repeated("frictions", self.frictions)
        for name, one in self.assessed.items():
            wrong += wrong_difficulties(f"grounds.{name}.levels", one.lane, one.levels)
        if FLAT in self.grounds:
            wrong.append(f"grounds.{FLAT}: has no levels and is always played; choose another name")
        if wrong:
            raise ValueError("\n".join(wrong))

    @property
    def assessed(self) -> dict[str, Assessed]:
        """Return the grounds with levels that are played."""
        return {name: one for name, one in self.grounds.items() if one is not None}

    @property
    def count(self) -> int:
        """Robots of a level: ``robots`` for each friction; robot n has friction n // ``robots``."""
        return self.robots * len(self.frictions)

    def subtasks(self, largest: Sequence[float]) -> list[Subtask]:
        """Return what is commanded where ``largest`` are the largest commands."""
        x, y, yaw = largest
        axes = [(x, 0.0, 0.0), (-x, 0.0, 0.0), (0.0, y, 0.0), (0.0, -y, 0.0), (0.0, 0.0, yaw), (0.0, 0.0, -yaw)]
        pairs = [(a, b, 0.0) for a, b in product((x, -x, 0.0), (y, -y, 0.0)) if a or b]
        stop, turn = (self.move_s, 0.0, self.move_s + self.stand_s), (0.5 * self.pair_s, -1.0, self.pair_s)
        return [Subtask("axes", c, *stop) for c in axes] + [Subtask("pairs", c, *turn) for c in pairs]

    @property
    def longest(self) -> float:
        """Length of the batch of all sub-tasks, s."""
        return self.settle_s + max(self.move_s + self.stand_s, self.pair_s)

    def lengths(self) -> list[Length]:
        """Return those of the levels and of the commands on each ground, then of the commands on flat ground."""
        lengths, count = list[Length](), self.count * len(self.subtasks(self.uneven))
        causes = [
            Cause("move_s", self.move_s, fitting=lambda seconds: seconds - self.settle_s - self.stand_s),
            Cause("pair_s", self.pair_s, fitting=lambda seconds: seconds - self.settle_s),
        ]
        commands = Length(self.longest, count, causes, self.settle_s, bool(self.terms()), figures=CHANNELS)
        for name, one in self.assessed.items():
            cause = Cause(f"grounds.{name}.seconds", one.seconds)
            lengths += [Length(one.seconds, self.count * len(one.levels), [cause]), commands]
        return [*lengths, commands]

    def play(self, stage: Stage) -> Played:
        """Walk all levels of a ground, then follow the commands on the highest that was passed; flat ground last."""
        rows: list[Row] = []
        for name, one in self.assessed.items():
            walked = self._walk(stage, name, one)
            levels = _levels(walked, self.pass_share)
            followed = self._follow(stage, one, [levels[friction] for friction in self.frictions])
            rows += [row | followed.get(n, {}) for n, row in enumerate(walked)]
        rows += [self._who(FLAT, n) | row for n, row in self._follow(stage, None, [0] * len(self.frictions)).items()]
        mean_score, level = (_overall(rows, function, self.pass_share) for function in (_score, _level))
        others = ", ".join(f"{who} {value:g}" for who, value in PUBLISHED.items())
        note = f"Score {mean_score:.3f}, mean level {level:.1f}. Published for a Go2 in another simulation: {others}."
        return Played(rows, {}, [note])

    def _walk(self, stage: Stage, name: str, one: Assessed) -> list[Row]:
        """Return a row for each robot with the levels that it passed; robot i of the batch walks lane i modulo them."""
        seed, levels, along = self.ground_seed, len(one.levels), -1.0 if one.backward else 1.0
        lanes = Lanes(ground=one.lane, levels=one.levels, course=one.course, backward=one.backward, seed=seed)
        robots = np.arange(self.count * levels) // levels
        command = np.tile([along * one.speed, 0.0, 0.0], (len(stage.times(one.seconds)), len(robots), 1))
        way: dict[str, Any] = {"steer": STEER, "along": along, "finish": lanes.goal}
        motion = stage.run(Plan(command, ground=lanes, **way, **self._conditions(robots)))
        passed = ((motion.way >= lanes.goal) & motion.alive).any(0).reshape(self.count, levels)
        marks = motion.fingerprint.reshape(self.count, levels).sum(1)
        rows = []
        for n, each in enumerate(passed.tolist()):
            row = self._who(name, n) | {f"{LEVEL}{k}": of_level for k, of_level in enumerate(each, 1)}
            nothing: Row = {"fell": None, "left_map": None, "moving_s": 0.0, FINGERPRINT: float(marks[n])}
            rows.append(row | nothing | {"levels": sum(each)})
        return rows

    def _follow(self, stage: Stage, one: Assessed | None, levels: Sequence[int]) -> dict[int, Row]:
        """Return by robot a row over all sub-tasks, where its friction has a level; on flat ground of every robot."""
        taken = [k for k, level in enumerate(levels) if level or one is None]
        if not taken:
            return {}
        largest = self.uneven if one else self.flat
        subtasks = self.subtasks(largest)
        # Robot i of the batch has patch, and friction, i modulo their number.
        task, number, patch = (v.ravel() for v in np.indices((len(subtasks), self.robots, len(taken))))
        robots = np.array(taken)[patch] * self.robots + number
        command = np.stack([self._signal(stage, s) for s in subtasks], 1)[:, task]
        ground: dict[str, Any] = {"ground": self._patches(one, [levels[k] for k in taken])} if one else {}
        listen = stage.steps(self.settle_s) if self.terms() else None
        ways: dict[str, Any] = {"figures": channels, "listen_from": listen, **ground, **self._conditions(robots)}
        motion = stage.run(Plan(command, **ways))
        graded, measured = Graded(motion, largest, self.settle_s), [Row() for _ in robots]
        self.measure(motion, measured)
        rows = {}
        for n in np.unique(robots).tolist():
            parts = [(int(i), subtasks[task[i]]) for i in np.flatnonzero(robots == n)]
            rows[n] = graded.row(parts) | measured[parts[0][0]]
        return rows

    def _who(self, ground: str, n: int) -> Row:
        return {"ground": ground, ROBOT: n, "friction": self.frictions[n // self.robots]}

    def _conditions(self, robots: NDArray[np.intp]) -> dict[str, Any]:
        friction = np.array(self.frictions)[robots // self.robots]
        delay = 1e-3 * self.delay_ms * (robots % self.robots + 0.5) / self.robots
        fall = bind_list("termination", [{"tilt": {"max_angle": self.fall_tilt}}], "fall_tilt")
        return {"friction": (friction, friction), "delay": delay, "terminations": tuple(fall)}

    def _patches(self, one: Assessed, levels: Sequence[int]) -> Lanes:
        """Return ground with its start in the middle of the difficulty, one patch for each of the ``levels``."""
        shape: dict[str, Any] = {"course": PATCH, "start": 0.5 * PATCH, "width": PATCH_WIDTH}
        difficulties = tuple(one.levels[level - 1] for level in levels)
        return Lanes(ground=one.lane, levels=difficulties, backward=one.backward, seed=self.ground_seed, **shape)

    def _signal(self, stage: Stage, subtask: Subtask) -> Array:
        """Return the command (T, 3) of a sub-task: none while settling."""
        t = (stage.times(self.longest) - self.settle_s + 1e-9)[:, None]
        return np.where(t < 0.0, 0.0, np.where(t < subtask.until, 1.0, subtask.then)) * np.array(subtask.command)

    def derived(self, rows: Sequence[Row]) -> list[Derived]:
        """Return level and score of each ground and of all."""
        level, of_score = partial(_level, share=self.pass_share), partial(_score, share=self.pass_share)
        figures = []
        for name in (*self.assessed, FLAT):
            if name != FLAT:
                text = "highest level passed, mean over frictions"
                figures.append(Derived("level", "", text, {"ground": name}, "higher", level))
            text = "score of the ground, mean over frictions"
            figures.append(Derived("score", "", text, {"ground": name}, "higher", of_score))
        for key, text, function in (
            ("overall_level", "mean of the grounds' levels", _level),
            ("overall_score", "mean of the grounds' scores", _score),
        ):
            of_all = partial(_overall, function=function, share=self.pass_share)
            figures.append(Derived(key, "", text, {}, "higher", of_all))
        return figures

    def compared(self, plays: Mapping[str, Played], summaries: Summaries) -> list[plots.Drawing]:
        """Draw the scores of all subjects."""
        text = "Score of each ground, 95 % interval by the bootstrap over robots."
        return [plots.Drawing("score", "Score by ground", text, partial(_draw_scores, summaries))]

    def details(self, played: Played, summary: Summary) -> list[plots.Drawing]:
        """Draw who passed which level, and the levels over friction."""
        of_grounds = {name: about(played.rows, {"ground": name}) for name in self.assessed}
        text = "Left: share of all robots that passed. Right: highest level passed, over the friction of the feet."
        levels = plots.Drawing("levels", "Levels", text, partial(_draw_levels, of_grounds, self.pass_share))
        return [levels] if of_grounds else []


def _passes(rows: Sequence[Row]) -> NDArray[np.float64]:
    """Return which levels (L) the robots (N) of one ground passed, (N, L) of 0 and 1; no levels on flat ground."""
    names = [name for name in rows[0] if name.startswith(LEVEL)] if rows else []
    return np.array([[row[name] for name in names] for row in rows], dtype=np.float64).reshape(len(rows), len(names))


def _levels(rows: Sequence[Row], share: float) -> dict[float, int]:
    """Return the highest level passed by friction, of one ground's rows; nothing of flat ground."""
    groups = {float(k[0]): _passes(those) for k, those in by_condition(rows, ("friction",)).items()}
    return {k: highest_level(passed.mean(0).tolist(), share) for k, passed in groups.items() if passed.size}


def _level(rows: Sequence[Row], share: float) -> float:
    levels = _levels(rows, share)
    return float(np.mean(list(levels.values()))) if levels else np.nan


def _score(rows: Sequence[Row], share: float) -> float:
    """Return the score of one ground, mean over frictions; that of flat ground is its quality."""
    levels, scores = _levels(rows, share), []
    for (friction,), those in by_condition(rows, ("friction",)).items():
        worst = values(those, "quality_worst")
        known = float(np.nanmean(worst)) if np.isfinite(worst).any() else 0.0
        scores.append(score(levels[float(friction)], known) if levels else known)
    return float(np.mean(scores)) if scores else np.nan


def _overall(rows: Sequence[Row], function: Callable[..., float], share: float) -> float:
    figures = [function(those, share) for those in by_condition(rows, ("ground",)).values()]
    known = [figure for figure in figures if np.isfinite(figure)]
    return float(np.mean(known)) if known else np.nan


def _draw_scores(summaries: Summaries) -> plots.Figure:
    figure, axes = plots.panels(1, height=2.4)
    ax = axes[0, 0]
    names: list[str] = []
    for k, (who, summary) in enumerate(summaries.items()):
        entries = [e for e in summary if "score" in e["figures"]]
        names = [str(e["condition"]["ground"]).replace("_", " ") for e in entries]
        at = [n + 0.12 * k for n in range(len(names))]
        plots.intervals(ax, at, entries, "score", plots.COLOURS[k % len(plots.COLOURS)], who, ls="none")
    ax.set_xticks(range(len(names)), [name.replace(" ", "\n") for name in names])
    ax.set(ylabel="score", ylim=(-0.02, 1.02))
    plots.legend(figure, ax)
    return figure


def _draw_levels(of_grounds: Mapping[str, Sequence[Row]], share: float) -> plots.Figure:
    figure, axes = plots.panels(1, 2, height=2.4)
    left, right = axes[0]
    for k, (name, rows) in enumerate(of_grounds.items()):
        shares, levels = _passes(rows).mean(0), _levels(rows, share)
        style = {"color": plots.COLOURS[k % len(plots.COLOURS)], "label": name.replace("_", " "), "ms": 3}
        left.plot(range(1, len(shares) + 1), shares, "o-", **style)
        right.plot(list(levels), list(levels.values()), "o-", **style)
    left.set(xlabel="level", ylabel="share that passed", ylim=(-0.04, 1.04))
    right.set(xlabel="friction of the feet", ylabel="highest level passed")
    right.set_ylim(bottom=-0.3)
    plots.legend(figure, left)
    return figure
