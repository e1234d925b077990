"""Policies of other frameworks (ONNX, TorchScript) as bundles: a contract between their network and this robot.

Everything of the contract is in the bundle's graph, around the network; the runtime knows nothing of its origin.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from go1exp import robot
from go1exp.config.choices import UNREADABLE
from go1exp.config.compose import compose
from go1exp.config.hydra_adapter import read_yaml
from go1exp.config.schema import settings as schema
from go1exp.config.schema.history import frame_width, frames_of, width
from go1exp.config.schema.joint_values import JointValues, spread
from go1exp.config.schema.physics import PhysicsStep
from go1exp.config.schema.registry import ConfigError, Positive, unknown_name
from go1exp.deploy.export.graph import Observing, computed
from go1exp.sim.task import TrainConfig, parse_train

ORDERS = {
    "sdk": robot.JOINTS,
    "leg_major": tuple(f"{leg}_{kind}" for leg in ("FL", "FR", "RL", "RR") for kind in robot.JOINT_KINDS),
    "joint_major": tuple(f"{leg}_{kind}" for kind in robot.JOINT_KINDS for leg in ("FL", "FR", "RL", "RR")),
}
"""Orders of the joints: of the vendor's SDK and mjlab, of legged_gym, of Isaac Lab."""

ALIASES = {
    **dict.fromkeys(("base_lin_vel", "lin_vel"), "base_linear_velocity"),
    **dict.fromkeys(("base_ang_vel", "ang_vel"), "base_angular_velocity"),
    **dict.fromkeys(("gravity",), "projected_gravity"),
    **dict.fromkeys(("velocity_commands", "commands", "command"), "velocity_command"),
    **dict.fromkeys(("joint_pos", "joint_pos_rel", "dof_pos"), "joint_position"),
    **dict.fromkeys(("joint_vel", "joint_vel_rel", "dof_vel"), "joint_velocity"),
    **dict.fromkeys(("actions", "action", "last_action"), "previous_action"),
}
"""Names of observation terms elsewhere -> the registered ones."""

STANCE = tuple(map(float, robot.NOMINAL_STANCE))
_TERMS = ("base_lin_vel", "base_ang_vel", "projected_gravity", "velocity_commands", "joint_pos", "joint_vel", "actions")
_GYM: dict[str, Any] = {
    "observation": [
        {"term": "lin_vel", "scale": 2.0},
        {"term": "ang_vel", "scale": 0.25},
        {"term": "projected_gravity"},
        {"term": "commands", "scale": [2.0, 2.0, 0.25]},
        {"term": "dof_pos"},
        {"term": "dof_vel", "scale": 0.05},
        {"term": "actions"},
    ],
    "observation_clip": 100.0,
    "joint_order": "leg_major",
}
PRESETS: dict[str, dict[str, Any]] = {
    "isaaclab": {"observation": [{"term": name} for name in _TERMS], "joint_order": "joint_major"},
    "mjlab": {
        "observation": [{"term": _TERMS[k]} for k in (0, 1, 2, 4, 5, 6, 3)],
        "joint_order": "sdk",
        "default_pose": {"FR_hip": 0.1, "RR_hip": 0.1, "FL_hip": -0.1, "RL_hip": -0.1, "thigh": 0.9, "calf": -1.8},
        "kp": [15.895, 15.895, 35.764],
        "kd": [1.012, 1.012, 2.277],
        "action_scale": [0.3728, 0.3728, 0.2485],
    },
    "legged_gym": _GYM,
    "unitree_rl": _GYM,
}
"""Contracts of the velocity tasks of Isaac Lab, mjlab, legged_gym (A1) and unitree_rl_gym (Go2)."""


@schema.settings
class Observed:
    """One term of a foreign observation: scale x clipped value.

    Attributes:
        term: name, registered here or of the other framework.
        scale: factor, one or one for each number; of joints also hip, thigh, calf.
        clip: bound of the value before the scale, or lowest and highest value, null for none.
        history: frames; null takes that of the specification.
        quaternion: how training took the attitude; inverse and xyzw are mistakes that a policy may have learnt.
        relative: joint positions are relative to the default pose.
        parameters: of the registered term.
    """

    term: str
    scale: float | tuple[float, ...] = 1.0
    clip: Positive | tuple[float | None, float | None] | None = None
    history: Annotated[int, Field(ge=1, le=64)] | None = None
    quaternion: Literal["wxyz", "xyzw", "inverse"] = "wxyz"
    relative: bool = True
    parameters: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        low, high = self.bounds
        if low is not None and high is not None and low >= high:
            raise ValueError(f"clip = {list(self.bounds)}: the lowest value must be below the highest")

    @property
    def bounds(self) -> tuple[float | None, float | None]:
        """Lowest and highest value before the scale; None where there is none."""
        if isinstance(self.clip, tuple):
            return self.clip
        return (None, None) if self.clip is None else (-self.clip, self.clip)


@schema.settings
class Spec:
    """The contract of a foreign policy. Lists of 12 are in ``joint_order``; lists of 3 are hip, thigh, calf.

    Attributes:
        observation: terms, in the order of the network's input.
        observation_clip: bound of the scaled observation.
        joint_order: sdk, leg_major, joint_major, or the 12 names.
        joint_sign: 1 or -1, of the foreign joint's direction.
        default_pose: targets of zero action, rad.
        kp: N m/rad.
        kd: N m s/rad.
        action_scale: rad per unit of action.
        action_clip: bound of an action.
        physics_dt: physics step in training, s.
        decimation: physics steps per policy step.
        history: frames of each term.
        history_order: whether the newest or the oldest frame comes first.
        history_layout: the frames of a term together, or the terms of a frame.
        command_ranges: lowest and highest command of training: lin_vel_x, lin_vel_y (m/s), ang_vel_z (rad/s).
    """

    observation: Annotated[tuple[Observed, ...], Field(min_length=1)]
    observation_clip: Positive | None = None
    joint_order: str | tuple[str, ...]
    joint_sign: JointValues = 1.0
    default_pose: JointValues = dataclasses.field(default_factory=lambda: dict(zip(robot.JOINTS, STANCE, strict=True)))
    kp: JointValues = 20.0
    kd: JointValues = 0.5
    action_scale: JointValues = 0.25
    action_clip: Positive = 100.0
    physics_dt: PhysicsStep = 0.005
    decimation: Annotated[int, Field(ge=1, le=100)] = 4
    history: Annotated[int, Field(ge=1, le=64)] = 1
    history_order: Literal["newest_first", "oldest_first"] = "oldest_first"
    history_layout: Literal["term", "frame"] = "term"
    command_ranges: dict[str, tuple[float, float]] = dataclasses.field(
        default_factory=lambda: dict.fromkeys(("lin_vel_x", "lin_vel_y", "ang_vel_z"), (-1.0, 1.0))
    )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The joints in foreign order, by their names here."""
        given = ORDERS.get(self.joint_order, ()) if isinstance(self.joint_order, str) else self.joint_order
        names = tuple(name.removesuffix("_joint") for name in given)
        if sorted(names) != sorted(robot.JOINTS):
            raise ConfigError(
                [
                    f"joint_order = {self.joint_order!r}: must be {', '.join(ORDERS)}, or the 12 names "
                    f"{', '.join(robot.JOINTS)}"
                ]
            )
        return names

    def joints(self, key: str) -> np.ndarray:
        """Return a value per joint (12,), in foreign order."""
        values, names = getattr(self, key), self.names
        try:
            if isinstance(values, tuple) and len(values) == len(names):
                given = np.array(values)
            else:
                given = spread(values, robot.JOINTS)[[robot.JOINTS.index(name) for name in names]]
        except ValueError as error:
            raise ConfigError([f"{key}: {error}"]) from None
        bad = ~np.isfinite(given) | (
            np.abs(given) != 1 if key == "joint_sign" else key == "action_scale" and given == 0
        )
        if np.any(bad) or (key in ("kp", "kd") and np.any(given < 0)):
            raise ConfigError([f"{key} = {values!r}: has no valid value for {names[int(np.argmax(bad))]}"])
        return given


def spec_of(given: str, props: Mapping[str, str]) -> tuple[Spec, list[str]]:
    """Return the contract that a preset's name or a YAML file states, and notes on the file's own metadata.

    The file's own metadata replace the preset's values; the YAML file's replace both.

    Args:
        given: a name of ``PRESETS``, or a file, whose key ``preset`` may name one.
        props: metadata of the ONNX file (``joint_names``, ``joint_stiffness``, ... as Isaac Lab and mjlab write them).
    """
    stated: dict[str, Any] = {}
    preset = given
    if given not in PRESETS:
        if not Path(given).is_file():
            hint = unknown_name("spec", given, PRESETS, "preset")
            raise ConfigError([f"{hint}; or a YAML file"])
        try:
            read = read_yaml(Path(given))
        except UNREADABLE as error:
            raise ConfigError([f"spec = {given!r}: not a YAML file ({type(error).__name__})"]) from None
        if not isinstance(read, dict):
            raise ConfigError([f"spec = {given!r}: must be a mapping"])
        stated = dict(read)
        preset = stated.pop("preset", "")
        if preset and preset not in PRESETS:
            raise ConfigError([unknown_name("preset", preset, PRESETS, "preset")])
    base = PRESETS.get(preset, {})
    in_file = _of_props(props, base.get("observation", []))
    notes = [f"note: {key} is the spec's; the file has its own, too" for key in in_file if key in stated]
    if in_file:
        notes.insert(0, f"read from the file: {', '.join(in_file)}")
    merged = {**base, **in_file, **stated}
    if isinstance(merged.get("observation"), list):
        merged["observation"] = [{"term": e} if isinstance(e, str) else e for e in merged["observation"]]
    for key in ("observation", "joint_order"):
        if key not in merged:
            raise ConfigError([f"{key}: required in {given}, or preset: {', '.join(PRESETS)}"])
    return schema.parse(Spec, merged), notes


def _of_props(props: Mapping[str, str], known: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the part of a contract that an ONNX file's metadata state."""
    keys = {"joint_stiffness": "kp", "joint_damping": "kd", "default_joint_pos": "default_pose"}
    in_file: dict[str, Any] = {}
    if "joint_names" in props:
        in_file["joint_order"] = [name.strip() for name in props["joint_names"].split(",")]
    for prop, key in {**keys, "action_scale": "action_scale"}.items():
        try:
            values = [float(v) for v in props[prop].strip("[]").split(",")] if prop in props else []
        except ValueError:
            raise ConfigError([f"{prop} = {props[prop]!r}: metadata of the file must be numbers"]) from None
        if values:
            in_file[key] = values[0] if len(values) == 1 else values
    if "observation_names" in props:
        usual = {ALIASES.get(entry["term"], entry["term"]): entry for entry in known}
        names = [name.strip() for name in props["observation_names"].split(",")]
        in_file["observation"] = [usual.get(ALIASES.get(name, name), {"term": name}) for name in names]
    return in_file


def config_of(spec: Spec) -> tuple[dict[str, Any], TrainConfig]:
    """Return a training configuration of a contract, as plain data and parsed: its robot, terms, gains and rates."""
    container = compose("train", ["actuator=pd", "command=paper", "rand=none", "event=none", "backend.threads=1"])
    inverse = [spec.names.index(name) for name in robot.JOINTS]
    names = [ALIASES.get(o.term, o.term) for o in spec.observation]
    if twice := {name for name in names if names.count(name) > 1}:
        raise ConfigError([f"observation: {', '.join(sorted(twice))} given twice"])
    container["observation"] = {
        name: {**o.parameters, "history": o.history or spec.history}
        for name, o in zip(names, spec.observation, strict=True)
    }
    container["actuator"] = {"term": "pd", **{k: spec.joints(k)[inverse].tolist() for k in ("kp", "kd")}}
    scale, period = spec.joints("action_scale"), spec.physics_dt * spec.decimation
    unit = float(np.max(np.abs(scale)))
    shift = np.abs(spec.joints("joint_sign") * spec.joints("default_pose") - _stance(spec))
    clip = float(np.max((spec.action_clip * np.abs(scale) + shift) / unit))
    container["action"] = {"scale": unit, "clip": clip}
    # contacts of MuJoCo take steps of about 2 ms, whatever the other engine's were
    container["sim"] |= {"policy_dt": period, "physics_dt": period / int(np.ceil(period / 0.002 - 1e-9))}
    container["command"] |= {axis: list(pair) for axis, pair in spec.command_ranges.items()}
    return container, parse_train(container)


def _stance(spec: Spec) -> np.ndarray:
    return np.array([STANCE[robot.JOINTS.index(name)] for name in spec.names])


class Front(Observing):
    """Sensor readings to the flat observation, a frame after the other in each term, and to the network's input."""

    def __init__(self, spec: Spec, config: TrainConfig) -> None:
        """Prepare the terms; raise ConfigError or ExportError if one does not fit."""
        super().__init__(config.task.observation)
        self._spec, unit = spec, config.task.action.scale
        order = [robot.JOINTS.index(name) for name in spec.names]
        sign, pose, stance = spec.joints("joint_sign"), spec.joints("default_pose"), _stance(spec)
        scale = spec.joints("action_scale")
        shifts = {"joint_position": sign * stance - pose, "previous_action": (sign * stance - pose) / scale}
        gains = {"previous_action": sign * unit / scale}
        self._offset = bool(np.any(shifts["previous_action"]))
        self._laws: list[tuple[list[int], Tensor, Tensor, Tensor]] = []
        for term, observed in zip(self._terms, spec.observation, strict=True):
            per_joint = term.entry.name.startswith(("joint_", "previous_action"))
            size, name = frame_width(term), term.entry.name
            factor = np.array(observed.scale, dtype=float)
            if per_joint and factor.size == len(robot.JOINT_KINDS):
                factor = spread(observed.scale, robot.JOINTS)[order]
            if factor.ndim and len(factor) != size:
                raise ConfigError([f"observation.{observed.term}.scale: {len(factor)} values for {size} numbers"])
            gain = gains.get(name, sign) if per_joint else np.ones(size)
            shift = shifts.get(name, np.zeros(size))
            if name == "joint_position" and not observed.relative:
                shift = sign * stance
            law = (torch.as_tensor(v, dtype=torch.float32) for v in (gain, shift, factor * np.ones(size)))
            self._laws.append((order if per_joint else list(range(size)), *law))  # type: ignore[arg-type]
        self._columns = self._layout()

    def _layout(self) -> list[int]:
        """Return where each number of the network's input is in the observation."""
        start, frames = 0, []
        for term in self._terms:
            steps = np.arange(width(term)).reshape(frames_of(term), -1) + start
            frames.append(steps if self._spec.history_order == "newest_first" else steps[::-1])
            start += width(term)
        if self._spec.history_layout == "term" or not any(self._earlier):
            return [int(c) for term in frames for c in term.ravel()]
        if len({len(term) for term in frames}) > 1:
            raise ConfigError(["history_layout = 'frame': every term must have as many frames"])
        return [int(c) for step in zip(*frames, strict=True) for term in step for c in term]

    def forward(self, *readings: Tensor) -> tuple[Tensor, Tensor]:
        """Return observation and network input, (N, O) each, for readings (N, size)."""
        given = self._named(readings)
        frames = []
        for term, observed, law in zip(self._terms, self._spec.observation, self._laws, strict=True):
            value = computed(term, _attitude(given, observed.quaternion))
            columns, gain, shift, factor = law
            changed = value[:, columns] * gain + shift
            if term.entry.name == "previous_action" and self._offset:  # there was none before the first step
                changed = changed * (value.abs().sum(-1, keepdim=True) > 0).to(changed.dtype)
            if observed.bounds != (None, None):
                changed = changed.clamp(*observed.bounds)
            changed = changed * factor
            bound = self._spec.observation_clip
            frames.append(changed if bound is None else changed.clamp(-bound, bound))
        observation = self._flat(frames, given)
        return observation, observation[:, self._columns]


def _attitude(given: Mapping[str, Tensor], kind: str) -> dict[str, Tensor]:
    if kind == "wxyz" or "imu_quat" not in given:
        return dict(given)
    quat = given["imu_quat"]
    conjugate = torch.cat([quat[:, :1], -quat[:, 1:]], dim=-1)
    return {**given, "imu_quat": conjugate if kind == "inverse" else quat[:, [1, 2, 3, 0]]}


class Back(nn.Module):
    """The network's output to joint targets and to the action of this project, both in the order of ``JOINTS``."""

    def __init__(self, spec: Spec, config: TrainConfig) -> None:
        super().__init__()
        self._inverse = [spec.names.index(name) for name in robot.JOINTS]
        sign, unit = spec.joints("joint_sign")[self._inverse], config.task.action.scale
        pose, scale = (spec.joints(key)[self._inverse] for key in ("default_pose", "action_scale"))
        stance = robot.NOMINAL_STANCE
        laws = (sign * scale / unit, (sign * pose - stance) / unit, stance)
        self._gain, self._shift, self._stance = (torch.as_tensor(v, dtype=torch.float32) for v in laws)
        self._clip, self._unit, self._bound = spec.action_clip, unit, config.task.action.clip

    def forward(self, *readings: Tensor) -> tuple[Tensor, Tensor]:
        """Return joint targets, rad, and actions, (N, 12) each, for the raw actions (N, 12)."""
        raw = readings[0][:, self._inverse].clamp(-self._clip, self._clip)
        action = (raw * self._gain + self._shift).clamp(-self._bound, self._bound)
        return self._stance + self._unit * action, action
