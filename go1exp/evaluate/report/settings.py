"""Settings of ``go1exp report``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from go1exp.config.schema.registry import Duration, NonNegative
from go1exp.config.schema.settings import settings

Name = Annotated[str, Field(min_length=1)]
Count = Annotated[int, Field(ge=1)]


@settings
class Evaluation:
    """How runs without an evaluation are evaluated: on the grid of commands of ``go1exp eval``.

    Of these settings, seed and checkpoint are those of other protocols too.

    Attributes:
        x: forward velocities, m/s.
        y: velocities to the left, m/s.
        yaw: turning rates, rad/s.
        episodes: robots of each command.
        duration_s: length of an episode, s.
        settle_s: time at its start that does not count for tracking, s.
        noise: add the observation noise of training.
        randomize: randomise robots and starts as in training.
        push: push the robots as in training.
        measures: gait and contact measures by name (go1exp list measure), [] for none.
        seed: seed of everything random.
        checkpoint: newest, or best, the one that eval.every kept; of runs without it, the newest.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    yaw: tuple[float, ...]
    episodes: Count
    duration_s: Duration
    settle_s: NonNegative
    noise: bool
    randomize: bool
    push: bool
    measures: tuple[str, ...]
    seed: Annotated[int, Field(ge=0)]
    checkpoint: Literal["newest", "best"]

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.settle_s >= self.duration_s:
            raise ValueError(f"settle_s = {self.settle_s}: must be shorter than duration_s = {self.duration_s}")


@settings
class ReportSettings:
    """``conf/report.yaml`` without the groups.

    Attributes:
        folders: run folders, sweep folders, or folders with any of them below.
        baseline: group that all others are compared with, by its name or a part of it that no other has, or by settings
            such as reward.gait.weight=10; null takes that with most runs, of several the first.
        curves: columns of metrics.csv whose learning curves are drawn.
        figures: figures of the evaluation that are compared; null takes error_xy, error_yaw and fell of the grid, and
            of other protocols those of its claims.
        correction: holm makes at most one study in twenty with any false word; none words each figure by itself.
        paired: pair runs by their seed in comparisons; needs six pairs to tell anything.
        unfinished: count running, stopped and failed runs as well, as far as they came.
        eval: evaluate runs that lack an evaluation, by ``protocol``: the grid as ``evaluation`` says.
        evaluation: how.
        points: times at which a learning curve is drawn.
        wandb: Weights & Biases to log the tables to, offline or online; null for none.
        project: its project.
        folder: for report.html, report.json and the CSV files; null takes report in the first of folders.
    """

    folders: Annotated[tuple[Name, ...], Field(min_length=1)]
    baseline: str | None
    curves: tuple[Name, ...]
    figures: tuple[Name, ...] | None
    correction: Literal["holm", "none"]
    paired: bool
    unfinished: bool
    eval: bool
    evaluation: Evaluation
    points: Annotated[int, Field(ge=2, le=2000)]
    wandb: Literal["offline", "online"] | None
    project: Name
    folder: Name | None
