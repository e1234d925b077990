"""The metadata of a bundle: one schema, written by the export and read by the runtime."""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from go1exp.deploy.runtime.commands import AXES

T = TypeVar("T")

MAX_GAIN = 1023.0
"""Largest gain that the Go1's packets carry, N m/rad and N m s/rad."""


MAX_LIMIT = 100.0
"""Largest limit of a joint's torque, N m, and speed, rad/s: several times those of a Go1."""


@dataclass(frozen=True)
class Port:
    """One input or output of the graph, float32 (rows, ``size``), with its unit, frame and meaning."""

    name: str
    size: int
    unit: str
    frame: str
    meaning: str


@dataclass(frozen=True)
class Block:
    """One term of the flat observation: ``size`` columns from ``start`` on; half-width of its noise in training.

    They are ``history`` frames of it, one training period apart, the newest first.
    """

    key: str
    term: str
    start: int
    size: int
    noise: float
    history: int = 1


@dataclass(frozen=True)
class Trained:
    """Origin of the policy: name and SHA-256 of the checkpoint, learner iterations and robot steps."""

    checkpoint: str
    sha256: str
    iteration: int
    num_timesteps: int


@dataclass(frozen=True)
class Metadata:
    """Everything besides the graph that the runtime needs. SI units; joints in the order of ``joints``.

    Attributes:
        robot: its name.
        joints: the J actuated joints, in the order of every joint quantity.
        legs: order of quantities per leg.
        inputs: inputs of the graph.
        outputs: outputs of the graph.
        observation: the terms in the flat observation.
        nominal_stance: (J,) rad, the targets of zero action.
        action_scale: rad per unit of action.
        action_clip: largest absolute value of an action; larger ones are clipped.
        kp: (J,) N m/rad, position gains of the actuator in training; None if it has none.
        kd: (J,) N m s/rad.
        joint_limits: (J, 2) rad, the hard stops.
        torque_limit: (J,) N m.
        velocity_limit: (J,) rad/s.
        policy_dt: period of the policy in training, s.
        physics_dt: physics step of evaluations, s; ppo.coarse_physics may have made that of the training longer.
        command_ranges: lowest and highest command in training by name (m/s, m/s, rad/s); empty if there are none.
        conventions: description of frames, quaternions and signs.
        estimator: settings of the state estimator (``deploy.estimation.FilterConfig`` as JSON); empty: those of a Go1.
        trained: the policy's origin.
        action_max_step: largest difference of two targets within ``policy_dt``, rad; None for any.
    """

    robot: str
    joints: tuple[str, ...]
    legs: tuple[str, ...]
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    observation: tuple[Block, ...]
    nominal_stance: tuple[float, ...]
    action_scale: float
    action_clip: float
    kp: tuple[float, ...] | None
    kd: tuple[float, ...] | None
    joint_limits: tuple[tuple[float, float], ...]
    torque_limit: tuple[float, ...]
    velocity_limit: tuple[float, ...]
    policy_dt: float
    physics_dt: float
    command_ranges: dict[str, tuple[float, float]]
    conventions: dict[str, str]
    estimator: dict[str, Any]
    trained: Trained
    action_max_step: float | None = None  # bundles of older versions have none

    def __post_init__(self) -> None:
        """Check relations between values; raise ValueError with the name of one of them."""
        per_joint = ("nominal_stance", "kp", "kd", "joint_limits", "torque_limit", "velocity_limit")
        for name in per_joint:
            values = getattr(self, name)
            if values is not None and len(values) != len(self.joints):
                raise ValueError(f"{name}: {len(values)} values for {len(self.joints)} joints")
        sizes = {port.name: port.size for port in self.outputs}
        wanted = {"joint_target": len(self.joints), "action": len(self.joints)}
        wanted["observation"] = sum(block.size for block in self.observation)
        if sizes != wanted:
            raise ValueError(f"outputs: their sizes are {sizes} instead of {wanted}")
        # Terms follow one another without a gap, from column 0.
        ends = [block.start + block.size for block in self.observation]
        if [block.start for block in self.observation] != [0, *ends[:-1]]:
            raise ValueError("observation: its terms are not contiguous")
        if wrong := [block.key for block in self.observation if block.history < 1 or block.size % block.history]:
            raise ValueError(f"observation: {wrong[0]} has a size that is not that of its history")
        earlier = sum(block.size - block.size // block.history for block in self.observation)
        if earlier != sum(port.size for port in self.inputs if port.name == "past"):
            raise ValueError(f"inputs: past must have the {earlier} numbers of the observation's earlier frames")
        for name in ("action_scale", "action_clip", "action_max_step", "policy_dt", "physics_dt"):
            if (value := getattr(self, name)) is not None and not value > 0:
                raise ValueError(f"{name}: must be greater than 0")
        self._check_joints()
        for name, (low, high) in self.command_ranges.items():
            if name not in AXES:
                raise ValueError(f"command_ranges.{name}: unknown axis; those of a command are {', '.join(AXES)}")
            if low > high:
                raise ValueError(f"command_ranges.{name}: the lowest, {low:g}, is above the highest, {high:g}")

    def _check_joints(self) -> None:
        """Raise ValueError with the key of an impossible value of a joint."""
        if twice := {name for name in self.joints if self.joints.count(name) > 1}:
            raise ValueError(f"joints: {', '.join(sorted(twice))} duplicate")
        for name in ("kp", "kd"):
            for k, value in enumerate(getattr(self, name) or ()):
                if not 0 <= value <= MAX_GAIN:
                    limits = f"must be 0 to {MAX_GAIN:g}"
                    raise ValueError(f"{name}.{k} = {value:g}: {limits}, as the gain of {self.joints[k]}")
        for name in ("torque_limit", "velocity_limit"):
            for k, value in enumerate(getattr(self, name)):
                if not 0 < value <= MAX_LIMIT:
                    limits = f"must be greater than 0 and at most {MAX_LIMIT:g}"
                    raise ValueError(f"{name}.{k} = {value:g}: {limits}, as the limit of {self.joints[k]}")
        for k, (low, high) in enumerate(self.joint_limits):
            if max(abs(low), abs(high)) > 2 * math.pi:
                raise ValueError(f"joint_limits.{k}: the stops of {self.joints[k]} are more than a turn from its zero")
            if low >= high:
                raise ValueError(
                    f"joint_limits.{k}: the lower stop of {self.joints[k]}, {low:g}, is not below {high:g}"
                )

    def as_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, content: Any) -> Metadata:
        """Build from plain data, as read from JSON; raise ValueError that starts with the wrong key."""
        return _built(cls, content, "")


def _built(kind: type[T], content: Any, path: str) -> T:
    """Build a dataclass from a mapping with exactly its fields."""
    if not isinstance(content, Mapping):
        raise ValueError(f"{path or 'content'}: must be a mapping")
    kinds = get_type_hints(kind)
    optional = {field.name for field in dataclasses.fields(kind) if field.default is not dataclasses.MISSING}  # type: ignore[arg-type]
    for name in kinds:
        if name not in content and name not in optional:  # optional: what files of older versions do not have
            raise ValueError(f"{path}{name}: missing")
    for name in content:
        if name not in kinds:
            raise ValueError(f"{path}{name}: unknown key")
    return kind(**{name: _value(kinds[name], content[name], f"{path}{name}") for name in kinds if name in content})


def _value(kind: Any, given: Any, path: str) -> Any:
    """Return ``given`` as the annotated type; lists stand for tuples."""
    if kind is Any:
        return given
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (types.UnionType, Union):  # only "or None" occurs
        return None if given is None else _value(inner[0], given, path)
    if dataclasses.is_dataclass(kind):
        return _built(kind, given, f"{path}.")  # type: ignore[arg-type]  # a class, not an instance
    if origin is dict:
        if not isinstance(given, Mapping) or not all(isinstance(key, str) for key in given):
            raise ValueError(f"{path}: must be a mapping")
        return {key: _value(inner[1], value, f"{path}.{key}") for key, value in given.items()}
    if origin is tuple:
        if not isinstance(given, list | tuple):
            raise ValueError(f"{path}: must be a list")
        each = [inner[0]] * len(given) if inner[-1] is Ellipsis else list(inner)
        if len(each) != len(given):
            raise ValueError(f"{path}: must be a list of {len(each)}")
        return tuple(_value(k, value, f"{path}.{i}") for i, (k, value) in enumerate(zip(each, given, strict=True)))
    if kind is float and isinstance(given, int | float) and not isinstance(given, bool) and math.isfinite(given):
        return float(given)
    if kind in (int, str) and type(given) is kind:
        return given
    raise ValueError(f"{path} = {given!r}: must be a {'finite number' if kind is float else kind.__name__}")
