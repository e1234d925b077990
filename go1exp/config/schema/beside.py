"""Settings of what goes on beside a training: evaluation, films, and the rule by which it ends early."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field

from go1exp.config.schema.registry import STRICT, NonNegative, Positive

CountOrZero = Annotated[int, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]

ROWS = "evals.csv"
"""File of a run folder: a row for each evaluation."""

EVALUATED = "eval/"
"""Begin of metrics that are columns of ``ROWS``, as trainings log them."""


@dataclass(frozen=True)
class EvalDuring:
    """Evaluation in a process of its own, on the CPU engine, while training goes on; the best policy is kept.

    Attributes:
        every: iterations from evaluation to evaluation; 0 for none.
        x: forward velocities that robots are told, m/s.
        y: velocities to the left, m/s.
        yaw: turning rates, rad/s.
        episodes: robots of each command.
        duration_s: length of an episode, s.
        settle_s: time at its start that does not count for tracking, s.
        noise: add the observation noise of training.
        randomize: randomise robots and starts as in training.
        seed: seed of everything random, the same each time.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    every: CountOrZero = 0
    x: tuple[float, ...] = (-0.5, 0.5, 1.0)
    y: tuple[float, ...] = (0.5,)
    yaw: tuple[float, ...] = (1.0,)
    episodes: Count = 8
    duration_s: Positive = 8.0
    settle_s: NonNegative = 2.0
    noise: bool = True
    randomize: bool = True
    seed: CountOrZero = 1


@dataclass(frozen=True)
class VideoDuring:
    """Films in the same process.

    Attributes:
        every: iterations from film to film; 0 for none.
        seconds: length of a film, s.
        velocity: commanded velocity in it, x m/s, y m/s, yaw rad/s.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    every: CountOrZero = 0
    seconds: Positive = 6.0
    velocity: tuple[float, float, float] = (1.0, 0.0, 0.0)


@dataclass(frozen=True)
class StopRule:
    """When a training ends before its last iteration.

    Attributes:
        figure: metric that decides, such as rollout/return, or eval/score with eval.every; null for none.
        better: whether higher or lower values of it are better.
        at: value that is good enough; null for none.
        patience: iterations without a better value than before after which training ends; null for none.
        least: by how much a value must be better to count.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    figure: str | None = None
    better: Literal["higher", "lower"] = "higher"
    at: float | None = None
    patience: Count | None = None
    least: NonNegative = 0.0

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.figure is None and not (self.at is None and self.patience is None):
            raise ValueError("figure = None: at and patience need one, such as rollout/return")
        if self.figure is not None and self.at is None and self.patience is None:
            raise ValueError(f"figure = {self.figure!r}: needs at or patience, or both")


BESIDE: dict[str, Any] = {"eval": EvalDuring(), "video": VideoDuring(), "stop": StopRule()}
"""Sections of the configuration, as they are where a run does not have them."""
