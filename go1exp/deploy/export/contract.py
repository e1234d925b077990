"""What a foreign policy does in simulation under its stated contract, and under others; its bundle."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from go1exp import robot
from go1exp.base.tensors.threads import one_thread
from go1exp.config.schema.history import HistoryColumns, history_columns
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.export.build import _versions, metadata, readings
from go1exp.deploy.export.foreign import (
    ALIASES,
    ORDERS,
    PRESETS,
    STANCE,
    Back,
    Front,
    Spec,
    config_of,
    spec_of,
)
from go1exp.deploy.export.foreign_graph import Network, compose_graph
from go1exp.deploy.export.graph import OUTPUTS, ExportError
from go1exp.deploy.runtime import bundle
from go1exp.deploy.runtime.metadata import Trained
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TrainConfig

COMMANDS = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, 0.5))
"""Commands of the simulation, m/s, m/s, rad/s."""

SECONDS, SETTLE = 2.0, 0.7
"""Length of the simulation, and its beginning, in which errors do not count, s."""

BETTER = 0.4
"""By how much another contract must follow the commands more closely to be a likely mismatch; 1 is perfect."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Seconds to the first fall, infinite if none, and how closely moving commands are followed: 1 perfect, 0 not."""

    fall: float
    follows: float


def _look(
    front: Front, sensed: dict[str, torch.Tensor], past: torch.Tensor | None, history: HistoryColumns
) -> tuple[list[torch.Tensor], torch.Tensor, torch.Tensor]:
    """Return the inputs of a front, its observation, and what the network reads; ``past`` is None in the first step."""
    if past is None or history.earlier:
        empty = torch.zeros(len(next(iter(sensed.values()))), len(history.earlier))
        sensed["past"] = empty if past is None else past
    given = [sensed[port.name] for port in front.inputs]
    if past is None and history.earlier:  # a history begins with its first frame repeated
        sensed["past"] = front(*given)[0][:, history.newest]
        given = [sensed[port.name] for port in front.inputs]
    return (given, *front(*given))


def _outcomes(errors: np.ndarray, fall: np.ndarray) -> list[Outcome]:
    """Return the outcomes of S contracts from mean velocity errors (S, C, 3) and times of falls (S, C), s."""
    sizes = np.linalg.norm(np.array(COMMANDS[1:]), axis=-1)
    follows = (1.0 - np.linalg.norm(errors[:, 1:], axis=-1) / sizes).mean(axis=1)
    return [Outcome(float(first), float(share)) for first, share in zip(fall.min(axis=1), follows, strict=True)]


def drive(
    config: TrainConfig, specs: Sequence[Spec], network: Network, seconds: float = SECONDS
) -> tuple[list[Outcome], dict[str, np.ndarray], np.ndarray]:
    """Run robots under each contract.

    Returns:
        The outcomes; of the first contract, a trace of the robot that walks forward, and the first joint targets of the
        robot that stands, rad, (12,) in the order of ``JOINTS``.
    """
    each, period = len(COMMANDS), config.task.sim.policy_dt
    sim = dataclasses.replace(config.task.sim, episode_s=2 * seconds, spread_starts=False)
    core = Go1Core(dataclasses.replace(config.task, sim=sim), each * len(specs), noise=False)
    core.reset()
    commands = torch.tensor(COMMANDS).repeat(len(specs), 1)
    # all act in the units of the first
    fronts, backs = [Front(s, config) for s in specs], [Back(s, config) for s in specs]
    history, past = history_columns(config.task.observation), None
    fall, steps = np.full(len(commands), np.inf), round(seconds / period)
    errors: list[np.ndarray] = []
    rows: list[dict[str, np.ndarray]] = []
    for step in range(steps):
        core.command.value.copy_(commands)
        now, parts, observations = readings(core), [], []
        for k, front in enumerate(fronts):
            sensed = {name: values[k * each : (k + 1) * each] for name, values in now.items()}
            given, observation, wanted = _look(front, sensed, None if past is None else past[k], history)
            observations.append(observation)
            parts.append(wanted)
            if k == 0 and np.isinf(fall[1]):
                inputs = {f"input.{p.name}": v[1:2] for p, v in zip(front.inputs, given, strict=True)}
        raw = torch.from_numpy(network(torch.cat(parts).numpy()))
        out = [back(raw[k * each : (k + 1) * each]) for k, back in enumerate(backs)]
        if step == 0:
            rest = out[0][0][0].numpy().astype(float)
        if np.isinf(fall[1]):
            made = dict(
                zip(("joint_target", "observation", "action"), (out[0][0], observations[0], out[0][1]), strict=True)
            )
            row = {**inputs, **{f"output.{name}": values[1:2] for name, values in made.items()}}
            rows.append({"time": np.array([step * period]), **{k: v.numpy().copy() for k, v in row.items()}})
        past = [o[:, history.carried] for o in observations]
        result = core.step(torch.cat([action for _, action in out]))
        fall = np.where(result.terminated.numpy() & np.isinf(fall), (step + 1) * period, fall)
        s = core.snapshot()
        velocity = torch.cat([s.base_lin_vel_b[:, :2], s.base_ang_vel_b[:, 2:]], dim=1)
        if step * period >= SETTLE:
            errors.append((velocity - commands).numpy())
    outcomes = _outcomes(np.mean(errors, axis=0).reshape(len(specs), each, 3), fall.reshape(len(specs), each))
    return outcomes, {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}, rest


def alternatives(spec: Spec) -> Iterator[tuple[str, Spec]]:
    """Yield contracts that differ from the stated one in one respect, with its name."""
    change = dataclasses.replace
    for name, order in ORDERS.items():
        if order != spec.names:
            in_order = {key: dict(zip(spec.names, spec.joints(key), strict=True)) for key in ("kp", "kd")}
            poses = {
                key: dict(zip(spec.names, spec.joints(key), strict=True)) for key in ("default_pose", "action_scale")
            }
            yield f"joint order: joint_order={name}", change(spec, joint_order=name, **in_order, **poses)
    negative = -spec.joints("joint_sign")
    yield "sign: joint_sign reversed", change(spec, joint_sign=tuple(negative))
    yield "sign: action_scale reversed", change(spec, action_scale=tuple(-spec.joints("action_scale")))
    for factor in (0.5, 2.0):
        yield (
            f"scale: action_scale x {factor:g}",
            change(spec, action_scale=tuple(factor * spec.joints("action_scale"))),
        )
    stances = {"the nominal stance": dict(zip(robot.JOINTS, STANCE, strict=True))}
    stances["that of preset mjlab"] = PRESETS["mjlab"]["default_pose"]
    for name, pose in stances.items():
        yield f"default pose: {name}", change(spec, default_pose=pose)
    usual = {ALIASES.get(e["term"], e["term"]): e for e in PRESETS["legged_gym"]["observation"]}
    for k, observed in enumerate(spec.observation):
        name = ALIASES.get(observed.term, observed.term)
        others: list[tuple[str, dict[str, Any]]] = []
        if name == "projected_gravity":
            others = [("gravity frame: sign", {"scale": tuple(-np.broadcast_to(observed.scale, 3))})]
            others += [("gravity frame: quaternion=inverse", {"quaternion": "inverse"})]
            others += [("quaternion order: quaternion=xyzw", {"quaternion": "xyzw"})]
        if name == "joint_position":
            others = [(f"joint_position: relative={not observed.relative}", {"relative": not observed.relative})]
        for scale in (
            {1.0, usual.get(name, {}).get("scale", 1.0)} if name != "velocity_command" else {1.0, (2.0, 2.0, 0.25)}
        ):
            others += [(f"scale: {name} x {scale}", {"scale": scale})] if scale != observed.scale else []
        for text, values in others:
            terms = [*spec.observation[:k], change(observed, **values), *spec.observation[k + 1 :]]
            yield text, change(spec, observation=tuple(terms))


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
        raise ConfigError([f"observation: {front.size} numbers ({terms}); the network takes {network.size}"])
    with one_thread(), torch.no_grad():
        (stated,), trace, rest = drive(config, [spec], network)
        lines += at_rest(spec, rest)
        likely = []
        if np.isfinite(stated.fall) or stated.follows < 1 - BETTER:
            others = list(alternatives(spec))
            outcomes, _, _ = drive(config, [other for _, other in others], network)
            stands = [(r.follows, n) for r, (n, _) in zip(outcomes, others, strict=True) if np.isinf(r.fall)]
            least = -np.inf if np.isfinite(stated.fall) else stated.follows + BETTER
            likely = [f"{n} (follows {v:.0%})" for v, n in sorted(stands, reverse=True) if v > least][:3]
        model = compose_graph(front, back, network)
    what = f"falls after {stated.fall:.2f} s" if np.isfinite(stated.fall) else f"stands {SECONDS:g} s"
    verdict = f"with the stated contract it {what} and follows the commands to {stated.follows:.0%}"
    if likely:
        verdict += f"; likely mismatch, since it stands with: {'; '.join(likely)}"
    if (likely or np.isfinite(stated.fall)) and not force:
        raise ExportError(f"{file}: {verdict}; force=true imports it all the same")
    lines.append(verdict)
    trained = Trained(file.name, network.sha256, 0, 0)
    size_of = {p.name: p.size or front.size for p in OUTPUTS}
    ports = type("Ports", (), {"inputs": front.inputs, "outputs": tuple(
        dataclasses.replace(p, size=size_of[p.name]) for p in OUTPUTS
    )})  # fmt: skip
    about: dict[str, Any] = {"file": str(file), "iteration": 0, "num_timesteps": 0}
    meta = dataclasses.replace(metadata(config.task, ports, about), trained=trained)  # type: ignore[arg-type]
    data = bundle.write(meta, container, _versions(file.parent), model, trace)
    bundle.loads(data, str(file))
    return data, lines


def at_rest(spec: Spec, target: np.ndarray) -> list[str]:
    """Return what the first action of a standing robot asks of the joints.

    Args:
        spec: the contract.
        target: joint targets, rad, (12,) in the order of ``JOINTS``.
    """
    order = [spec.names.index(name) for name in robot.JOINTS]
    off = target - (spec.joints("joint_sign") * spec.joints("default_pose"))[order]
    torque, limit = spec.joints("kp")[order] * off, np.tile(robot.EFFORT_LIMIT, robot.NUM_LEGS)
    k, share, (low, high) = int(np.argmax(np.abs(off))), np.abs(torque) / limit, robot.JOINT_POS_LIMITS.T
    most = int(np.argmax(share))
    lines = [
        f"first target: {robot.JOINTS[k]} {off[k]:+.2f} rad from its default pose; "
        f"largest torque: {robot.JOINTS[most]} {torque[most]:+.1f} N m, {share[most]:.0%} of its limit"
    ]
    for what, wrong in (
        ("with torques beyond the limit", share > 1),
        ("beyond the stops", (target < low) | (target > high)),
    ):
        if np.any(wrong):
            lines.append(f"warning: first targets {what}: {', '.join(np.array(robot.JOINTS)[wrong])}")
    return lines
