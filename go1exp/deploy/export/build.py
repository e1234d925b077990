"""Builds the bundle of a run: its policy, a trace of it, and everything that the robot's computer needs to run it."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import json
import platform
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from go1exp import __version__, robot
from go1exp.base.tensors.threads import one_thread
from go1exp.config.schema.history import history_columns
from go1exp.config.schema.joint_values import spread
from go1exp.config.schema.physics import CpuBackend
from go1exp.config.schema.registry import Term
from go1exp.deploy.estimation import go1, to_json
from go1exp.deploy.export.graph import DeployedPolicy, ExportError, blocks, outputs, to_onnx
from go1exp.deploy.runtime import bundle
from go1exp.deploy.runtime.metadata import Metadata, Port, Trained
from go1exp.robot.config import RobotConfig
from go1exp.sim.actuator.net import find
from go1exp.sim.effects.base import Measured
from go1exp.sim.effects.rules import nested_actuators
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig
from go1exp.train import run_folder
from go1exp.train.policy import acting, load_network


def readings(core: Go1Core) -> dict[str, Tensor]:
    """Return the present readings of the robots' sensors and computers, (N, size) by name, without noise."""
    s = core.snapshot()
    measured = Measured(s.joint_pos, s.joint_vel, gyro=s.base_ang_vel_b, quat=s.base_quat_w)
    effects = core.plant.effects
    if effects.senses:
        measured = effects.measure(dataclasses.replace(measured, joint_pos=core.plant.q, joint_vel=core.plant.qd))
    assert measured.gyro is not None
    assert measured.quat is not None
    current = {
        "joint_pos": measured.joint_pos,
        "joint_vel": measured.joint_vel,
        "imu_gyro": measured.gyro,
        "imu_quat": measured.quat,
        "base_lin_vel_b": s.base_lin_vel_b,
        "joint_torque": core.plant.reported_torque(),
        "joint_target": s.joint_target,
        "command": s.command,
        "previous_action": s.action,
        "lowest_action": s.action,
        "highest_action": s.action,
        "walked": s.episode_time.unsqueeze(-1),
    }
    return {name: values.float().clone() for name, values in current.items()}


def record(
    task: TaskConfig,
    policy: Callable[[Tensor], Tensor],
    inputs: Sequence[Port],
    seconds: float,
    seed: int,
    on_step: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, np.ndarray]:
    """Run one robot and return ``time``, ``input.NAME`` and ``output.NAME``, a row per policy step.

    Observations, actions and targets are those of the environment. The step that ends an episode is left out, because
    the environment starts the next episode within that step.

    Args:
        task: task of the training; its robot, ground, commands and pushes are drawn as in training, without noise.
        policy: observations (N, O) -> actions (N, 12).
        inputs: the readings to keep.
        seconds: length, s.
        seed: seed of everything random.
        on_step: called with the progress in steps.
    """
    steps, period = max(1, round(seconds / task.sim.policy_dt)), task.sim.policy_dt
    # that of training, as one episode, on the CPU with one thread
    sim = dataclasses.replace(task.sim, episode_s=(round(seconds / period) + 2) * period, spread_starts=False)
    traced = dataclasses.replace(task, sim=sim, backend=CpuBackend("cpu", threads=1), curriculum=())
    core = Go1Core(traced, 1, seed, noise=False)
    observation = core.reset()
    rows: list[dict[str, np.ndarray]] = []
    earlier = history_columns(task.observation).earlier
    for step in range(steps):
        policy_input = observation.clone()
        # before the step: what the policy is about to see
        before = {**readings(core), "past": policy_input[:, earlier]}
        result = core.step(policy(observation))
        core.check(result)
        if not bool(result.terminated | result.truncated):
            row = {f"input.{port.name}": before[port.name] for port in inputs}
            made = {"joint_target": core.target, "observation": policy_input, "action": core.action}
            row |= {f"output.{name}": values for name, values in made.items()}
            rows.append({"time": np.array([step * period]), **{k: v.numpy().copy() for k, v in row.items()}})
        observation = result.observation
        on_step(step + 1, steps)
    return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]} if rows else {}


PACKAGES = ("torch", "onnx", "onnxscript", "onnxruntime", "numpy", "mujoco-core")

AXES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
"""Parameters of a command term that give the ranges of its velocities."""

CONVENTIONS = {
    "units": "SI: m, rad, s, N m",
    "trunk": "x forward, y left, z up; origin and axes are those of the trunk in the vendor's URDF, the IMU's too",
    "world": "z up",
    "quaternion": "w-x-y-z, trunk to world",
    "joint": "angles, velocities and torques have the zero, sign and order of the vendor's SDK",
    "actuator": "torque = kp (joint_target - joint_pos) - kd joint_vel, at the motors' rate",
    "rows": "the first axis of every input and output; 1 on the robot",
}

Progress = Callable[[int, int], None]


def build(
    run: Path,
    checkpoint: Path | None = None,
    *,
    seconds: float = 5.0,
    seed: int = 0,
    on_step: Progress = lambda done, total: None,
) -> bytes:
    """Return the bundle of a run: the same bytes for the same run, versions and arguments.

    Args:
        run: run folder; its own configuration counts.
        checkpoint: a checkpoint's file; the newest if None.
        seconds: length of the trace, s.
        seed: seed of everything random in the trace.
        on_step: called with the progress of the trace, in steps.

    Raises:
        ExportError: if an observation term reads what the robot does not measure or has no form in ONNX, a package is
            missing, or the robot falls before the trace has a row.
        go1exp.deploy.runtime.bundle.BundleError: if ONNX, torch and the environment do not agree.
        FileNotFoundError: if ``run`` is not a run folder or has no checkpoint.
        go1exp.config.schema.registry.ConfigError: if its configuration is not one that this version knows.
    """
    config = run_folder.read_parsed(run)
    network, about = load_network(run, config, checkpoint)
    module = DeployedPolicy(network, config.task.observation, config.task.action)
    with one_thread():
        model = to_onnx(module)
        trace = record(config.task, acting(network), module.inputs, seconds, seed, on_step)
    if not trace:
        raise ExportError(f"{run}: every step of the trace ended an episode; there is nothing to replay")
    file = Path(about["file"])
    trained = Trained(file.name, bundle.seal(file.read_bytes()), int(about["iteration"]), int(about["num_timesteps"]))
    described = metadata(config.task, module.inputs, trained)
    data = bundle.write(described, run_folder.read_as_written(run), versions(run), model, trace)
    bundle.loads(data, str(run))  # read back: what is handed out has been replayed once
    return data


def metadata(task: TaskConfig, inputs: tuple[Port, ...], trained: Trained) -> Metadata:
    """Return the metadata of a task's policy, whose graph has these inputs; ``trained`` is its origin."""
    config: RobotConfig = task.robot
    observation = blocks(task.observation)
    try:
        return Metadata(
            robot="go1",
            joints=robot.JOINTS,
            legs=robot.LEGS,
            inputs=inputs,
            outputs=outputs(sum(block.size for block in observation)),
            observation=observation,
            nominal_stance=tuple(robot.NOMINAL_STANCE.tolist()),
            action_scale=task.action.scale,
            action_clip=task.action.clip,
            kp=gains(task.actuator, "kp"),
            kd=gains(task.actuator, "kd"),
            joint_limits=tuple((float(low), float(high)) for low, high in robot.JOINT_POS_LIMITS),
            torque_limit=tuple(robot.per_joint(config.effort_limit).tolist()),
            velocity_limit=tuple(robot.per_joint(config.velocity_limit).tolist()),
            policy_dt=task.sim.policy_dt,
            physics_dt=task.sim.physics_dt,
            command_ranges=command_ranges(task.command),
            conventions=CONVENTIONS,
            estimator=json.loads(to_json(go1())),
            trained=trained,
            action_max_step=task.action.max_step,
        )
    except ValueError as error:
        raise ExportError(str(error)) from None


def gains(actuator: Term, name: str) -> tuple[float, ...] | None:
    """Return ``kp`` or ``kd`` of an actuator, or of the recordings of its net, per joint; None if unknown."""
    for term, _ in nested_actuators(actuator):
        if name in term.parameters:
            return tuple(spread(term.parameters[name], robot.JOINTS).tolist())
        if "file" in term.parameters:
            from go1exp.sim.actuator.actuator_net import load  # this package takes seconds to import

            info = load(find(term.parameters["file"])).info
            values = getattr(info, name)
            return None if values is None else tuple(values[info.joints.index(joint)] for joint in robot.JOINTS)
    return None


def command_ranges(command: Term) -> dict[str, tuple[float, float]]:
    """Return lowest and highest commanded velocity by name, for the axes that the command's parameters give."""
    given = {name: command.parameters[name] for name in AXES if name in command.parameters}
    pairs = {name: value if isinstance(value, tuple | list) else (value, value) for name, value in given.items()}
    return {name: (float(pair[0]), float(pair[1])) for name, pair in pairs.items()}


def versions(run: Path) -> dict[str, Any]:
    """Return the versions of the exporting packages, and those that the run recorded when it was trained."""
    packages = {}
    for name in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            packages[name] = importlib.metadata.version(name)
    meta = run / "meta.json"
    return {
        "go1exp": __version__,
        "python": platform.python_version(),
        "packages": packages,
        "run": json.loads(meta.read_text()) if meta.is_file() else None,
    }
