"""Settings of ``go1exp report``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from go1exp.config.schema.registry import Count, Duration, NonNegative
from go1exp.config.schema.settings import settings

Name = Annotated[str, Field(min_length=1)]


@settings
class EvaluationSettings:
    """How runs without an evaluation are evaluated: on the grid of commands of ``go1exp eval``.

    Of these settings, seed and checkpoint are those of other protocols too.

    Attributes:
        x: forward velocities, m/s.
        y: velocities to the left, m/s.
        yaw: yaw rates, rad/s.
        episodes: robots of each command.
        seconds: length of an episode, s.
        settle_s: initial time excluded from tracking errors, s.
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
    seconds: Duration
    settle_s: NonNegative
    noise: bool
    randomize: bool
    push: bool
    measures: tuple[str, ...]
    seed: Annotated[int, Field(ge=0)]
    checkpoint: Literal["newest", "best"]

    def __post_init__(self) -> None:
        if self.settle_s >= self.seconds:
            raise ValueError(f"settle_s = {self.settle_s}: must be shorter than seconds = {self.seconds}")


@settings
class ReportSettings:
    """``conf/report.yaml`` without the groups.

    Attributes:
        folders: run folders, sweep folders, or folders with any of them below.
        baseline: group that all others are compared with, by its name or a unique part of it, or by settings such as
            reward.gait.weight=10; null takes the first of those with most runs.
        curves: columns of metrics.csv whose learning curves are drawn.
        figures: quantities to compare; null takes error_xy, error_yaw and fell of the grid, and the claims of other
            protocols.
        correction: holm bounds the chance of any false positive in a study by 5 %; none corrects nothing.
        paired: pair runs by their seed in comparisons; at least six pairs are needed for significance.
        unfinished: include running, stopped and failed runs.
        eval: evaluate runs without an evaluation, by ``protocol``: the grid as ``evaluation`` says.
        evaluation: how.
        points: number of points of a learning curve.
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
    evaluation: EvaluationSettings
    points: Annotated[int, Field(ge=2, le=2000)]
    wandb: Literal["offline", "online"] | None
    project: Name
    folder: Name | None
