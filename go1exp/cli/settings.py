"""The settings of the verbs other than ``train``, checked as strictly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from go1exp.registry import STRICT, ConfigError, NonNegative, Positive, as_json, explain

T = TypeVar("T")
Count = Annotated[int, Field(ge=1)]
RunFolder = Annotated[str, Field(min_length=1)]


@dataclass(frozen=True)
class Grid:
    """Commanded values per axis, m/s and rad/s; ``cross`` for every combination."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    x: tuple[float, ...]
    y: tuple[float, ...]
    yaw: tuple[float, ...]
    cross: bool


@dataclass(frozen=True)
class EvalSettings:
    """``conf/eval.yaml``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    run: RunFolder
    checkpoint: str | None
    grid: Grid
    episodes: Count
    duration_s: Positive
    settle_s: NonNegative
    noise: bool
    rand: bool
    push: bool
    terrain: bool
    policy_dt: Annotated[float, Field(gt=0, le=0.1)] | None
    seed: Annotated[int, Field(ge=0)]
    out: str | None

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.settle_s >= self.duration_s:
            raise ValueError(f"settle_s = {self.settle_s}: must be shorter than duration_s = {self.duration_s}")


@dataclass(frozen=True)
class PlaySettings:
    """``conf/play.yaml``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    run: RunFolder
    checkpoint: str | None
    command: tuple[float, float, float]
    seconds: Positive
    viewer: Literal["auto", "clip", "live"]
    fps: Annotated[int, Field(ge=1, le=50)]
    noise: bool
    rand: bool
    push: bool
    terrain: bool
    seed: Annotated[int, Field(ge=0)]
    out: str | None


@dataclass(frozen=True)
class ListSettings:
    """``conf/list.yaml``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    what: Literal["all", "terms", "groups"]
    group: str | None


@dataclass(frozen=True)
class BenchSettings:
    """``conf/bench.yaml``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    suite: Literal["env", "train"]
    num_envs: Count
    rounds: Count
    seconds: Positive
    threads: Annotated[int, Field(ge=0)]
    overrides: tuple[str, ...]
    out: str | None


def parse(kind: type[T], container: Mapping[str, Any]) -> T:
    """Validate a composed configuration as ``kind``; raise ConfigError with every problem."""
    if container.get("run") == "???":
        raise ConfigError(["run: required, such as run=runs/NAME"])
    try:
        return TypeAdapter(kind).validate_json(as_json(dict(container)))
    except ValidationError as error:
        raise ConfigError(explain(error, "", [f.name for f in fields(kind)])) from None  # type: ignore[arg-type]
