"""What a foreign policy does in simulation under its stated contract, and under others; its bundle."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.threads import one_thread
from go1exp.config.schema.history import history_columns
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.export.build import AXES, metadata, readings, versions
from go1exp.deploy.export.foreign import (
    ALIASES,
    ORDERS,
    PRESETS,
    STANCE,
    Back,
    Front,
    Observed,
    Spec,
    config_of,
    spec_of,
)
from go1exp.deploy.export.foreign_graph import Network, compose_graph
from go1exp.deploy.export.graph import ExportError
from go1exp.deploy.runtime import bundle
from go1exp.deploy.runtime.metadata import MAX_GAIN, Trained
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TrainConfig

COMMANDS = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
"""Commands of the simulation, m/s, m/s, rad/s: a robot stands, three move, two stand and are kicked."""

STANDS, WALKS = 0, 1
"""Robots of a contract whose first targets and whose trace are kept."""

MOVING, STANDING = [1, 2, 3], [0, 4, 5]
KICKS = {4: (0.6, 0.0), 5: (0.0, 0.6)}
"""Change of the trunk's velocity of robots that stand, m/s, at ``SETTLE``: it takes the attitude and the damping."""

SECONDS, SETTLE = 2.0, 0.7
"""Length of the simulation, and its beginning, in which errors do not count, s."""

BETTER, STEADIER, PART, CLOSE = 0.1, 0.05, 0.5, 0.3
"""By how much another contract must follow the commands more closely to be a likely mismatch, where 1 is perfect, or
sway less, m/s; which part of the stated contract's error may remain (chosen: a wrong attitude costs a quarter on flat
ground); and how far behind the likeliest another one is named, too."""

WALKING, STILL = 0.5, 0.1
"""A contract under which the policy neither follows the commands so closely nor sways less, m/s, is not likely."""

TURNED = {
    "all": robot.JOINTS,
    **{name: tuple(j for j in robot.JOINTS if j.endswith(f"_{name}")) for name in robot.JOINT_KINDS},
    "right hip": ("FR_hip", "RR_hip"),
    "left hip": ("FL_hip", "RL_hip"),
    "thigh and calf": tuple(j for j in robot.JOINTS if not j.endswith("_hip")),
}
"""Joints whose direction other models have reversed together."""

USUAL: dict[str, tuple[float | tuple[float, ...], ...]] = {
    "base_linear_velocity": (1.0, 2.0),
    "base_angular_velocity": (1.0, 0.25, 0.2),
    "velocity_command": (1.0, (2.0, 2.0, 0.25)),
    "joint_position": (1.0,),
    "joint_velocity": (1.0, 0.05),
    "previous_action": (1.0,),
}
"""Scales of the four frameworks, by term."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What robots under a contract do.

    Attributes:
        fall: of a robot without a kick, s; infinite if none.
        follows: how closely moving commands are followed: 1 perfect, 0 not.
        sways: velocity error of robots that should stand, two after a kick, m/s (RMS); infinite if one falls.
    """

    fall: float
    follows: float
    sways: float

    @property
    def falls(self) -> bool:
        """Whether a robot falls."""
        return bool(np.isfinite(self.fall))

    def __str__(self) -> str:
        """Return what is comparable, in words."""
        sways = f"sways {self.sways:.2f} m/s" if np.isfinite(self.sways) else "falls when kicked"
        return f"follows the commands to {self.follows:.0%}, {sways}"


class _Robots:
    """The robots of one contract: ``rows`` of an environment, which observe and act by it."""

    def __init__(self, spec: Spec, config: TrainConfig, rows: slice) -> None:
        terms = {term.key: term for term in config.task.observation}  # another contract may have another order
        ordered = tuple(terms[_name(observed)] for observed in spec.observation)
        config = dataclasses.replace(config, task=dataclasses.replace(config.task, observation=ordered))
        self.rows, self._front, self._back = rows, Front(spec, config), Back(spec, config)
        self._history, self._past = history_columns(config.task.observation), None

    def observe(self, now: Mapping[str, Tensor]) -> Tensor:
        """Return what the network reads for the readings of the environment."""
        sensed = {name: values[self.rows] for name, values in now.items()}
        if self._past is not None:
            sensed["past"] = self._past
        else:
            sensed["past"] = torch.zeros(len(sensed["joint_pos"]), len(self._history.earlier))
            if self._history.earlier:  # a history begins with its first frame repeated
                sensed["past"] = self._front(*self._inputs(sensed))[0][:, self._history.newest]
        self._given = self._inputs(sensed)
        self._observation, wanted = self._front(*self._given)
        self._past = self._observation[:, self._history.carried]
        return wanted

    def _inputs(self, sensed: Mapping[str, Tensor]) -> list[Tensor]:
        return [sensed[port.name] for port in self._front.inputs]

    def act(self, raw: Tensor) -> Tensor:
        """Return the actions for the network's output of all robots."""
        self.target, self._action = self._back(raw[self.rows])
        return self._action

    def row(self, t: float) -> dict[str, np.ndarray]:
        """Return the row of a trace at time ``t``, s: the last step of the robot that walks forward."""
        values = {f"input.{port.name}": v for port, v in zip(self._front.inputs, self._given, strict=True)}
        made = {"joint_target": self.target, "observation": self._observation, "action": self._action}
        values |= {f"output.{name}": v for name, v in made.items()}
        return {"time": np.array([t]), **{k: v[WALKS : WALKS + 1].numpy().copy() for k, v in values.items()}}


def _outcomes(errors: np.ndarray, fall: np.ndarray, commands: np.ndarray) -> list[Outcome]:
    """Return outcomes of S contracts from velocity errors (T, S, C, 3), falls (S, C), s, and commands (C, 3)."""
    sizes = np.maximum(np.linalg.norm(commands, axis=-1), 0.3)  # a command of zero is followed, too
    follows = (1.0 - np.linalg.norm(errors.mean(axis=0), axis=-1) / sizes)[:, MOVING].mean(axis=1)
    settled = errors[len(errors) // 3 :]  # the kick itself is the same for all
    sways = np.sqrt((settled**2).sum(axis=-1).mean(axis=0))
    sways = np.where(np.isfinite(fall), np.inf, sways)[:, STANDING].mean(axis=1)
    first = np.delete(fall, list(KICKS), axis=1).min(axis=1)
    return [Outcome(*map(float, values)) for values in zip(first, follows, sways, strict=True)]


def drive(
    config: TrainConfig, specs: Sequence[Spec], network: Network
) -> tuple[list[Outcome], dict[str, np.ndarray], np.ndarray]:
    """Run robots under each contract.

    Returns:
        The outcomes; of the first contract, a trace of the robot that walks forward, and the first joint targets of the
        robot that stands, rad, (12,) in the order of ``JOINTS``.
    """
    each, period = len(COMMANDS), config.task.sim.policy_dt
    sim = dataclasses.replace(config.task.sim, episode_s=2 * SECONDS, spread_starts=False)
    core = Go1Core(dataclasses.replace(config.task, sim=sim), each * len(specs), noise=False)
    core.reset()
    low, high = np.array([specs[0].command_ranges.get(axis, (-1.0, 1.0)) for axis in AXES]).T
    wanted = np.clip(COMMANDS, low, high)
    commands = torch.as_tensor(wanted, dtype=torch.float32).repeat(len(specs), 1)
    # all act in the units of the first
    groups = [_Robots(spec, config, slice(k * each, (k + 1) * each)) for k, spec in enumerate(specs)]
    fall = np.full(len(commands), np.inf)
    errors: list[np.ndarray] = []
    rows: list[dict[str, np.ndarray]] = []
    for step in range(round(SECONDS / period)):
        core.command.value.copy_(commands)
        now = readings(core)
        raw = torch.from_numpy(network(torch.cat([group.observe(now) for group in groups]).numpy()))
        actions = torch.cat([group.act(raw) for group in groups])
        if step == 0:
            rest = groups[0].target[STANDS].numpy().astype(float)
        if np.isinf(fall[WALKS]):
            rows.append(groups[0].row(step * period))
        result = core.step(actions)
        fall = np.where(result.terminated.numpy() & np.isinf(fall), (step + 1) * period, fall)
        s = core.snapshot()
        if step * period >= SETTLE:
            errors.append((torch.cat([s.base_lin_vel_b[:, :2], s.base_ang_vel_b[:, 2:]], dim=1) - commands).numpy())
        if step == round(SETTLE / period):
            for row, kick in KICKS.items():
                core.backend.qvel[row::each, :2] += torch.tensor(kick, dtype=core.backend.qvel.dtype)
    outcomes = _outcomes(np.array(errors).reshape(-1, len(specs), each, 3), fall.reshape(len(specs), each), wanted)
    return outcomes, {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}, rest


def alternatives(spec: Spec) -> Iterator[tuple[str, Spec]]:
    """Yield contracts that differ from the stated one in one respect, with its name."""

    def law(one: Spec) -> tuple[object, ...]:
        joints = (tuple(one.joints(key)) for key in ("joint_sign", "kp", "kd", "default_pose", "action_scale"))
        return one.names, one.observation, one.history_order, one.history_layout, *joints

    for name, other in _variants(spec):
        if law(other) != law(spec):
            yield name, other


def _variants(spec: Spec) -> Iterator[tuple[str, Spec]]:
    """Yield contracts that differ from the stated one in at most one respect, with its name."""
    change, scale = dataclasses.replace, spec.joints("action_scale")
    per_joint = ("kp", "kd", "default_pose", "action_scale", "joint_sign")
    by_name = {key: dict(zip(spec.names, spec.joints(key), strict=True)) for key in per_joint}
    for name in ORDERS:
        yield f"joint order: joint_order={name}", change(spec, joint_order=name, **by_name)
    for name, joints in TURNED.items():
        yield f"sign: joint_sign reversed ({name})", _turned(spec, joints)
    yield "sign: action_scale reversed", change(spec, action_scale=tuple(-scale))
    for factor in (0.5, 2.0):
        yield f"scale: action_scale x {factor:g}", change(spec, action_scale=tuple(factor * scale))
    nominal = dict(zip(robot.JOINTS, STANCE, strict=True))
    yield "default pose: the nominal stance", change(spec, default_pose=nominal)
    yield "default pose: that of preset mjlab", change(spec, default_pose=PRESETS["mjlab"]["default_pose"])
    for k, observed in enumerate(spec.observation):
        for text, values in _other_readings(observed):
            terms = [*spec.observation[:k], change(observed, **values), *spec.observation[k + 1 :]]
            yield text, change(spec, observation=tuple(terms))
    yield from _other_histories(spec)
    stated = dict(zip(map(_name, spec.observation), spec.observation, strict=True))
    for preset in ("isaaclab", "mjlab", "legged_gym"):
        theirs = spec_of(preset, {})[0]
        by_term = {_name(o): o for o in theirs.observation}
        if set(by_term) == set(stated):
            kept = [change(o, history=stated[n].history, parameters=stated[n].parameters) for n, o in by_term.items()]
            other = change(spec, observation=tuple(kept), joint_order=theirs.joint_order, **by_name)
            yield f"terms, scales and joint order of preset {preset}", other


def _turned(spec: Spec, joints: Sequence[str]) -> Spec:
    """Return a contract with the sign of some joints reversed; the pose turns with them if it is beyond the stops."""
    sign, pose = spec.joints("joint_sign"), spec.joints("default_pose")
    reverse = np.isin(spec.names, joints)
    low, high = robot.JOINT_POS_LIMITS[[robot.JOINTS.index(name) for name in spec.names]].T
    kept = reverse & np.all(~reverse | ((sign * pose >= low) & (sign * pose <= high)))
    sign, pose = np.where(reverse, -sign, sign), np.where(kept, -pose, pose)
    return dataclasses.replace(spec, joint_sign=tuple(sign.tolist()), default_pose=tuple(pose.tolist()))


def _other_histories(spec: Spec) -> Iterator[tuple[str, Spec]]:
    frames = {observed.history or spec.history for observed in spec.observation}
    if max(frames) == 1:
        return
    for layout in ("term", "frame") if len(frames) == 1 else (spec.history_layout,):
        for order in ("newest_first", "oldest_first"):
            text = f"history: history_order={order}, history_layout={layout}"
            yield text, dataclasses.replace(spec, history_order=order, history_layout=layout)


def _other_gains(spec: Spec) -> Iterator[tuple[str, Spec]]:
    """Yield contracts with a third, a half, two and three times the gains, as far as the motors take them."""
    for key in ("kp", "kd"):
        for text, factor in (("1/3", 1.0 / 3.0), ("1/2", 0.5), ("2", 2.0), ("3", 3.0)):
            gains: dict[str, Any] = {key: tuple((factor * spec.joints(key)).tolist())}
            if max(gains[key]) <= MAX_GAIN:
                yield f"gains: {key} x {text}", dataclasses.replace(spec, **gains)


def _other_readings(observed: Observed) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield what a term may be in place of what is stated: name, and attributes of ``Observed``."""
    name = _name(observed)
    if name == "projected_gravity":
        yield "gravity frame: sign", {"scale": tuple(-np.broadcast_to(observed.scale, 3))}
        for kind in sorted({"wxyz", "xyzw", "inverse"} - {observed.quaternion}):
            what = "gravity frame" if "inverse" in (kind, observed.quaternion) else "quaternion order"
            yield f"{what}: quaternion={kind}", {"quaternion": kind}
    if name == "joint_position":
        yield f"joint_position: relative={not observed.relative}", {"relative": not observed.relative}
    for scale in USUAL.get(name, ()):
        if not np.allclose(observed.scale, scale):
            yield f"scale: {name} scale={scale}", {"scale": scale}


def _name(observed: Observed) -> str:
    return ALIASES.get(observed.term, observed.term)


def build_foreign(file: Path, given: str, *, force: bool = False) -> tuple[bytes, list[str]]:
    """Return the bundle of a foreign policy, and lines on what its contract does.

    Args:
        file: ONNX or TorchScript.
        given: preset or YAML file of its contract.
        force: build it even where it falls or another contract is likelier.

    Raises:
        ConfigError: if the contract is not valid, or its sizes are not the network's.
        ExportError: if the file cannot be imported, or a mismatch is likely and ``force`` is off.
    """
    size = None
    if not file.is_file():
        raise ConfigError([f"network = {str(file)!r}: there is no such file"])
    if file.read_bytes()[:2] == b"PK":
        spec, _ = spec_of(given, {})
        size = Front(spec, config_of(spec)[1]).size
    network = Network(file, size)
    spec, lines = spec_of(given, network.props)
    container, config = config_of(spec)
    front, back = Front(spec, config), Back(spec, config)
    if network.size not in (None, front.size):
        terms = ", ".join(f"{b.key} {b.entry.traits['size']}" for b in config.task.observation)
        raise ConfigError(
            [f"observation: {front.size} numbers ({terms}); the network takes {network.size}{_hint(network, front)}"]
        )
    described = metadata(config.task, front.inputs, Trained(file.name, network.sha256, 0, 0))
    with one_thread(), torch.no_grad():
        (stated,), trace, rest = drive(config, [spec], network)
        likely, alike = _likelier(stated, config, spec, network)
        model = compose_graph(front, back, network)
    what = f"falls after {stated.fall:.2f} s" if stated.falls else f"stands {SECONDS:g} s"
    verdict = f"with the stated contract it {what} and {stated}"
    if likely:
        verdict += f"; likely mismatch, since it stands with: {'; '.join(likely)}"
    elif stated.falls:
        verdict += "; it walks under no contract that differs in one respect"
    elif alike:
        remaining = f" and {len(alike) - 5} others" if len(alike) > 5 else ""
        lines = [*lines, f"note: not checked, since it moves the same with {'; '.join(alike[:5])}{remaining}"]
    if (likely or stated.falls) and not force:
        raise ExportError(f"{file}: {verdict}; force=true imports it all the same")
    data = bundle.write(described, container, versions(file.parent), model, trace)
    bundle.loads(data, str(file))
    return data, [*lines, *at_rest(spec, rest), verdict]


def _hint(network: Network, front: Front) -> str:
    """Return what a network of another size probably reads."""
    size = network.size or 0
    if size % front.size == 0:
        return f": history={size // front.size}?"
    known = {-3: "no base_linear_velocity?", 187: "a height scan of 17 x 11, which the robot does not measure?"}
    return f": {known[size - front.size]}" if size - front.size in known else ""


def _likelier(stated: Outcome, config: TrainConfig, spec: Spec, network: Network) -> tuple[list[str], list[str]]:
    """Return contracts that are likelier than the stated one of a policy that does not work, and those that act alike.

    Of the likelier ones up to three: the policy stands, and follows more closely, or sways less and follows as closely.
    """
    if not stated.falls and stated.follows >= 1 - BETTER and stated.sways < STILL:
        return [], []
    others = list(alternatives(spec))
    outcomes, _, _ = drive(config, [other for _, other in others], network)
    for name, other in _other_gains(spec):  # robots of a batch have the same gains
        others.append((name, other))
        outcomes += drive(config_of(other)[1], [other], network)[0]
    least = -np.inf if stated.falls else max(stated.follows + BETTER, 1.0 - PART * (1.0 - stated.follows))
    calm = min(PART * stated.sways, stated.sways - STEADIER)
    likely, alike = [], []
    for (name, _), one in zip(others, outcomes, strict=True):
        # stance and gains change how a robot sways, whatever its policy reads; a sign turns the stance, too
        read = not name.startswith(("default pose", "gains", "scale: action", "sign"))
        walks = name.startswith("gains") and one.follows > max(stated.follows, WALKING)
        steadier = (read or walks) and one.sways < calm and one.follows > stated.follows - STEADIER
        works = not one.falls and (one.follows > WALKING or one.sways < STILL)
        if works and (one.follows > least or steadier):
            likely.append((round(one.follows - one.sways, 2), f"{name} ({one})"))
        elif read and np.allclose((one.follows, one.sways), (stated.follows, stated.sways), rtol=0, atol=0.01):
            alike.append(name)
    likely.sort(key=lambda scored: -scored[0])  # of equal ones the change of one key comes first
    return [text for score, text in likely[:3] if score > likely[0][0] - CLOSE], alike


def at_rest(spec: Spec, target: np.ndarray) -> list[str]:
    """Return what the first action of a standing robot asks of the joints.

    Args:
        spec: the contract.
        target: joint targets, rad, (12,) in the order of ``JOINTS``.
    """
    order = [spec.names.index(name) for name in robot.JOINTS]
    sign, pose, kp = (spec.joints(key)[order] for key in ("joint_sign", "default_pose", "kp"))
    away = target - sign * pose  # rad
    torque = kp * away  # N m
    share = np.abs(torque) / np.tile(robot.EFFORT_LIMIT, robot.NUM_LEGS)
    far, hard = int(np.argmax(np.abs(away))), int(np.argmax(share))
    lines = [
        f"first target: {robot.JOINTS[far]} {away[far]:+.2f} rad from its default pose; "
        f"largest torque: {robot.JOINTS[hard]} {torque[hard]:+.1f} N m, {share[hard]:.0%} of its limit"
    ]
    low, high = robot.JOINT_POS_LIMITS.T
    beyond = {"with torques beyond the limit": share > 1, "beyond the stops": (target < low) | (target > high)}
    for what, wrong in beyond.items():
        if wrong.any():
            lines.append(f"warning: first targets {what}: {', '.join(np.array(robot.JOINTS)[wrong])}")
    return lines
