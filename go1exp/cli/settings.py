"""The settings of the verbs other than ``train``, checked as strictly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
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
    randomize: bool
    push: bool
    train_ground: bool
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
    velocity: tuple[float, float, float]
    seconds: Positive
    viewer: Literal["auto", "clip", "live"]
    fps: Annotated[int, Field(ge=1, le=50)]
    noise: bool
    randomize: bool
    push: bool
    train_ground: bool
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


def run_folder(path: str, key: str = "run") -> Path:
    """Return the run folder ``path``; raise ConfigError if it is none, before anything heavy is imported."""
    folder = Path(path)
    if not (folder / "config.yaml").is_file():
        raise ConfigError([f"{key} = {path!r}: not a run folder (it has no config.yaml)"])
    return folder


def checkpoint_file(run: Path, name: str | None) -> Path | None:
    """Return the checkpoint ``name``, looked for in the run folder, its ``checkpoints/`` and as it stands."""
    if name is None:
        return None
    places = [run / name, run / "checkpoints" / name, Path(name)]
    found = next((p for p in places if p.is_file()), None)
    if found is None:
        there = ", ".join(p.name for p in sorted((run / "checkpoints").glob("*.pt"))) or "none"
        raise ConfigError([f"checkpoint = {name!r}: no such file in {run}; it has {there}"])
    return found


def parse(kind: type[T], container: Mapping[str, Any]) -> T:
    """Validate a composed configuration as ``kind``; raise ConfigError with every problem."""
    if container.get("run") == "???":
        raise ConfigError(["run: required, such as run=runs/NAME"])
    try:
        return TypeAdapter(kind).validate_json(as_json(dict(container)))
    except ValidationError as error:
        raise ConfigError(explain(error, "", [f.name for f in fields(kind)])) from None  # type: ignore[arg-type]
