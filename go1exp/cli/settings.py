"""The settings of the verbs other than ``train``, checked as strictly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from go1exp import data_root
from go1exp.deploy.controller import Stages
from go1exp.gap.result import GapSettings
from go1exp.record.plan import Wishes
from go1exp.schema.registry import STRICT, ConfigError, NonNegative, Positive, as_json, explain
from go1exp.sim_robot.settings import SimConfig

T = TypeVar("T")

REQUIRED = {
    "run": "run=runs/NAME",
    "files": "go1exp record audit recordings/NAME.parquet",
    "file": "go1exp export check runs/NAME/bundle.zip",
    "source": "go1exp record import go2_in_air PATH",
    "path": "go1exp record import go2_in_air PATH",
    "recordings": "recordings=recordings",
    "logs": "logs=recordings",
    "bundle": "go1exp deploy runs/NAME/bundle.zip",
}
"""Settings without a default, and how they are given."""

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

    run: RunFolder | None
    policy: str | None
    checkpoint: str | None
    grid: Grid
    episodes: Count
    duration_s: Positive
    settle_s: NonNegative
    noise: bool
    randomize: bool
    push: bool
    train_ground: bool
    trunk_velocity: Literal["exact", "estimated"]
    policy_dt: Annotated[float, Field(gt=0, le=0.1)] | None
    physics_dt: Annotated[float, Field(gt=0, le=0.02)] | None
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

    run: RunFolder | None
    policy: str | None
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
class RecordSettings(Wishes):
    """``conf/record.yaml`` without the groups and the excitations."""

    run: str | None
    policy: str | None
    episodes: Count
    physics_dt: Annotated[float, Field(gt=0, le=0.002)]
    out: str

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        lists = ("gains", "seeds", "hang")
        wrong = [f"{name} = []: at least one is needed" for name in lists if not getattr(self, name)]
        ratio = 1.0 / (self.sensors.rate_hz * self.physics_dt)
        if ratio < 1 - 1e-9 or abs(ratio - round(ratio)) > 1e-6:
            period = 1 / self.sensors.rate_hz
            wrong.append(f"physics_dt = {self.physics_dt}: 1 / sensors.rate_hz = {period:g} must be a multiple of it")
        if wrong:
            raise ValueError("\n".join(wrong))


@dataclass(frozen=True)
class AuditSettings:
    """``conf/record_audit.yaml``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    files: Annotated[tuple[str, ...], Field(min_length=1)]
    out: str | None


@dataclass(frozen=True)
class ImportSettings:
    """``conf/record_import.yaml``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    source: str
    path: str
    options: dict[str, Any] | None
    out: str


@dataclass(frozen=True)
class ExportSettings:
    """``conf/export.yaml``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    run: RunFolder | None
    policy: str | None
    checkpoint: str | None
    seconds: Annotated[float, Field(gt=0, le=600)]
    seed: Annotated[int, Field(ge=0)]
    out: str | None


@dataclass(frozen=True)
class ExportCheckSettings:
    """``conf/export_check.yaml``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    file: Annotated[str, Field(min_length=1)]


@dataclass(frozen=True)
class SinusoidSettings:
    """Sines of all three velocities: amplitudes m/s, m/s, rad/s, and their period, s."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    amplitude: tuple[float, float, float]
    period: Positive


@dataclass(frozen=True)
class DeploySettings(Stages):
    """``conf/deploy.yaml`` without the groups; the times of the stages are those of the runtime."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    bundle: Annotated[str, Field(min_length=1)]
    link: Literal["sim", "go1"]
    commands: tuple[float, float, float] | str
    sinusoid: SinusoidSettings
    rate: Annotated[float, Field(ge=10, le=1000)] | None
    seconds: Positive | None
    keep: Annotated[float, Field(gt=0, le=3600)]
    stale: Positive
    spin: Annotated[float, Field(ge=0, le=0.01)]
    sim: SimConfig
    truth: bool
    out: str


@dataclass(frozen=True)
class FitActuatorSettings:
    """``conf/fit-actuator.yaml``; what they mean and further rules are in ``go1exp.fit.FitSettings``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    recordings: str | tuple[str, ...]
    inputs: tuple[str, ...]
    history: Count
    period: Positive | None
    hidden: tuple[Count, ...]
    skip: bool
    share: Literal["all", "kind", "none"]
    target: Literal["tau_est", "joint_torque"]
    smoothing: Positive | None
    epochs: Count
    batch: Count
    learning_rate: Positive
    patience: Count
    epoch_rows: Count
    holdout: float | tuple[str, ...]
    validation: float | tuple[str, ...]
    half_net: bool
    seed: Annotated[int, Field(ge=0)]
    plots: bool
    out: str


@dataclass(frozen=True)
class GapVerb:
    """``conf/gap.yaml``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    logs: str | tuple[str, ...]
    stage: Literal["all", "check", "localise", "replay", "explain", "apply", "report"]
    out: str
    train_dt: Annotated[float, Field(gt=0, le=0.02)]
    search: GapSettings


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

    suite: Literal["env", "train", "actuator", "deploy", "gpu"]
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


def shipped_policies() -> dict[str, Path]:
    """Return the run folders of the policies that come with the package, by name."""
    return {f.parent.name: f.parent for f in sorted((data_root() / "assets" / "policies").glob("*/config.yaml"))}


def trained(run: str | None, policy: str | None, file: str, out: str | None) -> tuple[Path, Path]:
    """Return the folder of the run or of the shipped policy that is meant, and the file that results go to.

    Args:
        run: run folder.
        policy: name of a shipped policy, in its place.
        file: what the results are called, in the run folder; those of a shipped policy go to the present one.
        out: the user's own file.

    Raises:
        ConfigError: unless there is exactly one of the two.
    """
    if run is None and policy is None:
        raise ConfigError([f"run: required, such as {REQUIRED['run']}, or a shipped policy, such as policy=paper"])
    if run is not None and policy is not None:
        raise ConfigError([f"run = {run!r} and policy = {policy!r}: only one of them"])
    if policy is None:
        assert run is not None
        folder = run_folder(run)
        return folder, Path(out or folder / file)
    there = shipped_policies()
    if policy not in there:
        raise ConfigError([f"policy = {policy!r}: no such policy; there are {', '.join(there) or 'none'}"])
    return there[policy], Path(out or f"{policy}_{file}")


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
    missing = [key for key, value in container.items() if value == "???"]
    if missing:
        raise ConfigError([f"{key}: required, such as {REQUIRED[key]}" for key in missing])
    try:
        return TypeAdapter(kind).validate_json(as_json(dict(container)))
    except ValidationError as error:
        raise ConfigError(explain(error, "", [f.name for f in fields(kind)])) from None  # type: ignore[arg-type]
