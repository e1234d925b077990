"""``conf/model``: what a robot other than the Go1 says about itself, checked before anything is built."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import ConfigDict, Field, ValidationError

import go1exp.sim.effects  # noqa: F401  (registers every effect)
from go1exp.base.paths import data_root
from go1exp.config.schema.joint_values import JointValues, each_within, spread
from go1exp.config.schema.registry import STRICT, ConfigError, NonNegative, Positive, as_json, explain
from go1exp.config.schema.settings import adapter
from go1exp.sim.effects.tolerances import problems as tolerance_problems

Name = Annotated[str, Field(min_length=1)]
Limit = Annotated[JointValues, each_within(1e-9)]
Gain = Annotated[JointValues, each_within(0.0)]


@dataclass(frozen=True)
class Firmware:
    """Gains in a unit of the drive's own, which recordings only tell in their notes.

    Attributes:
        note: regular expression with one group, the number.
        kp: N m/rad for each of that unit.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    note: Name
    kp: Positive

    def __post_init__(self) -> None:
        """Check the expression."""
        try:
            groups = re.compile(self.note).groups
        except re.error as error:
            raise ValueError(f"note = {self.note!r}: no regular expression ({error})") from None
        if groups != 1:
            raise ValueError(f"note = {self.note!r}: must have one group, the number")


@dataclass(frozen=True)
class SearchDefaults:
    """What suits the robot better than the defaults of ``search``; the command line still beats it. Units as there."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    window_s: Positive | None = None
    burn_s: NonNegative | None = None
    stride_s: Positive | None = None
    physics_dt: Positive | None = None
    clock_s: NonNegative | None = None


@dataclass(frozen=True)
class ModelConfig:
    """A robot of hinges on a fixed base. Per-joint values are a number, a list or a mapping (``joint_values.py``).

    Attributes:
        mjcf: MuJoCo file; in a file of your own, relative to that file.
        robots: names that recordings of it may carry.
        base: body that is fixed.
        joints: driven hinges, in the order of the MuJoCo file; all others are held at zero.
        groups: joints that feel each other, equally many in each group; all in one if null.
        drive: ``position``: torque = kp (target - q) - kd qd, clipped; ``voltage``: that clipped, then less the back
            EMF (stall_torque / speed_limit) qd, as in servos; ``torque``: ``tau_cmd`` played open loop.
        kp: position gain of recordings that say none, N m/rad.
        kd: speed gain of recordings that say none, N m s/rad.
        firmware: how to read the position gain from a recording's notes instead; null for not at all.
        torque_limit: peak torque, N m; with ``drive: voltage`` what the current limit allows.
        stall_torque: with ``drive: voltage``, torque at rest with full duty, N m; the peak torque if null.
        speed_limit: top speed without load, rad/s.
        speeds: ``checked``: recorded speeds are compared unless the audit finds them wrong; ``ignored``: never.
        clock: ``recorded``: times are those of the recording; ``speeds``: it has none worth the name, and the time
            between two rows is what it takes the recorded speeds to make the change of the angles; ``compare``: the
            two compete, and held-out windows decide (``gap/search/clocks.py``).
        tolerances: effect -> parameter -> tolerance that replaces the declared one (unit as there).
        search: settings that suit it.
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    mjcf: Name
    robots: Annotated[tuple[Name, ...], Field(min_length=1)]
    base: Name
    joints: Annotated[tuple[Name, ...], Field(min_length=1)]
    torque_limit: Limit
    speed_limit: Limit
    stall_torque: Limit | None = None
    groups: tuple[Annotated[tuple[Name, ...], Field(min_length=1)], ...] | None = None
    drive: Literal["position", "voltage", "torque"] = "position"
    kp: Gain | None = None
    kd: Gain | None = None
    firmware: Firmware | None = None
    speeds: Literal["checked", "ignored"] = "checked"
    clock: Literal["recorded", "speeds", "compare"] = "recorded"
    tolerances: dict[str, dict[str, Positive]] = field(default_factory=dict)
    search: SearchDefaults = field(default_factory=SearchDefaults)

    def __post_init__(self) -> None:
        """Check what concerns several keys."""
        wrong = [*_joint_problems(self), *tolerance_problems(self.tolerances, "tolerances")]
        if self.drive == "torque" and (self.kp is not None or self.kd is not None or self.firmware is not None):
            wrong.append("drive = 'torque': takes no kp, kd or firmware")
        if self.drive != "voltage" and self.stall_torque is not None:
            wrong.append(f"drive = {self.drive!r}: takes no stall_torque; drive: voltage does")
        if wrong:
            raise ValueError("\n".join(wrong))

    @property
    def joint_groups(self) -> tuple[tuple[str, ...], ...]:
        """The groups, by name."""
        return self.groups or (self.joints,)

    def per_joint(self, name: str) -> np.ndarray:
        """Return a per-joint value (J,); NaN where it is not given."""
        values = getattr(self, name)
        return np.full(len(self.joints), np.nan) if values is None else spread(values, self.joints)


@dataclass(frozen=True)
class Go1Model:
    """The Go1 of the group ``robot``: ``mjcf`` is null, and only how well it is known can be said here.

    Attributes:
        mjcf: null.
        tolerances: effect -> parameter -> tolerance that replaces the declared one (unit as there).
    """

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    mjcf: None = None
    tolerances: dict[str, dict[str, Positive]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the names."""
        if wrong := tolerance_problems(self.tolerances, "tolerances"):
            raise ValueError("\n".join(wrong))


def _joint_problems(config: ModelConfig) -> list[str]:
    wrong = []
    if len(set(config.joints)) < len(config.joints):
        wrong.append("joints: must be different")
    everyone = [name for group in config.joint_groups for name in group]
    if sorted(everyone) != sorted(config.joints):
        wrong.append("groups: must have every joint once")
    if len({len(group) for group in config.joint_groups}) > 1:
        wrong.append("groups: must be of equal size")
    for name in ("torque_limit", "speed_limit", "stall_torque", "kp", "kd"):
        if getattr(config, name) is None:
            continue
        try:
            missing = np.isnan(config.per_joint(name))
        except ValueError as error:
            wrong.append(f"{name}: {error}")
            continue
        if missing.any():
            left_out = ", ".join(j for j, m in zip(config.joints, missing, strict=True) if m)
            wrong.append(f"{name}: gives {left_out} no value")
    return wrong


def parse_model(settings: object, path: str = "model") -> ModelConfig | Go1Model:
    """Validate a choice of ``conf/model``; the Go1's ``mjcf`` is null.

    A relative path of a MuJoCo file counts from the project's root. The file itself is not opened here. ConfigError
    with every problem, each naming its key.
    """
    if not isinstance(settings, Mapping):
        raise ConfigError([f"{path} = {settings!r}: must be a choice of conf/model or a FILE.yaml"])
    if settings.get("mjcf", "") is None:
        others = [f.name for f in fields(ModelConfig) if f.name in settings and f.name not in ("mjcf", "tolerances")]
        if others:
            raise ConfigError([f"{path}.mjcf: is null, which is the Go1; {', '.join(others)} would do nothing"])
        return _checked(Go1Model, settings, path)
    config = _checked(ModelConfig, settings, path)
    return dataclasses.replace(config, mjcf=str(data_root() / config.mjcf))


Kind = TypeVar("Kind", ModelConfig, Go1Model)


def _checked(kind: type[Kind], settings: Mapping[str, object], path: str) -> Kind:
    try:
        return adapter(kind).validate_json(as_json(dict(settings)))
    except ValidationError as error:
        raise ConfigError(explain(error, path, [f.name for f in fields(kind)])) from None
