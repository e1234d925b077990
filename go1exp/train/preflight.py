"""Checks before a run begins: devices, shares of several GPUs, memory, accounts, actuator nets."""

from __future__ import annotations

import importlib.util
import math
import warnings

import numpy as np
import torch

from go1exp import robot
from go1exp.base import memory
from go1exp.config.schema.physics import PhysxBackend, WarpBackend
from go1exp.config.schema.registry import ConfigError
from go1exp.mdp.commands import AXES
from go1exp.mdp.curricula import YAW_ARM
from go1exp.sim.effects.rules import nested_actuators
from go1exp.sim.env.batch import FLOAT_BYTES, robot_bytes
from go1exp.sim.env.camera import missing_for_mp4
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.engine import device_of, free_on
from go1exp.sim.task import TrainConfig
from go1exp.sim.terrain import TerrainConfig, lost_kinds
from go1exp.train import metrics
from go1exp.train.schedule import check_measures

SLOWEST = 0.02
"""Commands that are all slower than this, m/s, do not differ from the sway of a gait (chosen)."""

LEAST_ROBOTS = 64
"""On each of several GPUs: a tensor is taken for the robots' by its length, which no other has (``train/group.py``)."""


def check(config: TrainConfig) -> None:
    """Refuse a training that this machine cannot run. Makes no file.

    Raises:
        ConfigError: if a device, a package or an account is not there, if it does not fit into memory, if a schedule
            waits for an unknown metric, or if an actuator net does not fit the robot or the physics step.
        go1exp.base.errors.Expected: if a net's file is damaged.
        FileNotFoundError: if it is not there.
    """
    check_devices(config)
    warn_of_idle_curriculum(config)
    check_shares(config)
    check_measures(config)
    check_memory(config, device_of(config.task.backend))
    warn_of_lost_ground(config.task.terrain)  # which fits into memory
    metrics.check_account(config.logger)
    if any("file" in term.parameters for term, _ in nested_actuators(config.task.actuator)):
        Go1Core(config.task, 1)


def warn_of_idle_curriculum(config: TrainConfig) -> None:
    """Warn where the curriculum can promote no robot: one kind of ground, or no command to speak of."""
    task, asked = config.task, config.task.command.parameters
    axes = [asked[key] for key in AXES if key in asked]
    arms = (1.0, 1.0, YAW_ARM)
    fastest = math.hypot(*(arm * np.abs(axis).max() for arm, axis in zip(arms, axes, strict=False)))
    reasons = {
        "terrain.rows = 1: there is no higher level": task.terrain.rows == 1,
        "every command is zero, and a robot without a command keeps its level": asked.get("standing_fraction") == 1.0
        or asked.get("zero_fraction") == 1.0
        or (len(axes) == 3 and not np.any(axes)),
        f"no command is faster than {fastest:.2g} m/s (1 rad/s counts {YAW_ARM:g} m/s), as a gait's sway may be": (
            0.0 < fastest < SLOWEST and len(axes) == 3
        ),
    }
    for reason in (reason for reason, holds in reasons.items() if holds and task.curriculum):
        warnings.warn(f"curriculum.{task.curriculum[0].key}: promotes no robot; {reason}", stacklevel=3)


def warn_of_lost_ground(terrain: TerrainConfig) -> None:
    """Warn of kinds of ground that are asked for and that no robot will meet."""
    absent, flat = lost_kinds(terrain) if terrain.kind == "tiles" else ([], [])
    if absent:
        warnings.warn(f"terrain.cols = {terrain.cols}: too few for the shares of {', '.join(absent)}", stacklevel=3)
    if flat:
        warnings.warn(
            f"terrain: tiles of {', '.join(flat)} are flat, also in the last of {terrain.rows} rows", stacklevel=3
        )


def check_shares(config: TrainConfig) -> None:
    """Refuse a training that cannot be shared out over the GPUs asked for.

    Raises:
        ConfigError: naming what would have to be different.
    """
    devices, ppo, backend = config.process.devices, config.ppo, config.task.backend
    if devices == 1:
        return
    problems = []
    if not (isinstance(backend, WarpBackend) and backend.device == "cuda" and config.process.device == "auto"):
        problems.append("needs backend=warp, backend.device=cuda and device=auto")
    elif devices > torch.cuda.device_count():
        problems.append(f"torch finds {torch.cuda.device_count()} CUDA devices")
    if ppo.num_envs % devices or ppo.num_envs // devices < LEAST_ROBOTS:
        problems.append(f"ppo.num_envs = {ppo.num_envs} must be {LEAST_ROBOTS} or more for each, as many for all")
    if ppo.num_envs * ppo.steps // ppo.minibatches % devices:
        problems.append(f"a minibatch ({ppo.num_envs} x {ppo.steps} / {ppo.minibatches}) must be a multiple of it")
    if problems:
        raise ConfigError([f"devices = {devices}: {problem}" for problem in problems])


def check_devices(config: TrainConfig) -> None:
    """Refuse devices, engines and a video writer that are not there (SB3 would quietly take another device).

    Raises:
        ConfigError: naming each.
    """
    backend, problems = config.task.backend, []
    wanted = [("device", config.process.device, "device=cpu")]
    if isinstance(backend, WarpBackend):
        missing = [name for name in ("warp", "mujoco_warp") if importlib.util.find_spec(name) is None]
        if missing:
            problems.append(
                "backend = 'warp': needs the packages mujoco-warp and warp-lang: pip install 'go1exp[gpu]', or use "
                "backend=cpu"
            )
        wanted.append(("backend.device", backend.device, "backend=cpu"))
    if isinstance(backend, PhysxBackend):
        problems.append("backend = 'physx': evaluates policies and trains none; use backend=cpu or backend=warp")
    if config.video.every and (absent := missing_for_mp4()):
        problems.append(f"video.every = {config.video.every}: {absent}, or set it to 0")
    for key, name, instead in wanted:
        if name.startswith("cuda") and not torch.cuda.is_available():
            problems.append(f"{key} = {name!r}: torch finds no CUDA device; use {instead}")
        elif name.startswith("cuda:") and int(name[5:]) >= torch.cuda.device_count():
            problems.append(f"{key} = {name!r}: torch finds {torch.cuda.device_count()} CUDA devices, numbered from 0")
    if problems:
        raise ConfigError(problems)


SAMPLE_BYTES = 12
"""A sample of the ground: float64 as it is built, float32 in the engine."""


def needed_bytes(config: TrainConfig) -> int:
    """Return a lower bound of the memory that a training takes on each device, B.

    What fails for certain is refused, nothing else.
    Robots; the rollout once (observations of one number a term, actions, their means, six numbers a step); the layers'
    outputs of one minibatch, and of its mirror image, which wait for the backward pass.
    """
    ppo, devices = config.ppo, config.process.devices
    per_robot = robot_bytes(config.task, ppo.num_envs)
    row = len(config.task.observation) + len(config.task.critic) + 2 * robot.NUM_JOINTS + 6
    rollout = ppo.num_envs * ppo.steps
    samples = rollout // ppo.minibatches * (2 if ppo.symmetry else 1)
    outputs = samples * 2 * sum(ppo.hidden)
    return ppo.num_envs * per_robot // devices + FLOAT_BYTES * (rollout * row + outputs // devices)


def check_memory(config: TrainConfig, device: torch.device) -> None:
    """Refuse a training that cannot fit.

    Args:
        config: what is to be trained.
        device: where most of it lies.

    Raises:
        ConfigError: with what it takes and what there is.
    """
    needed, available = needed_bytes(config), free_on(device)
    ground, free = config.task.terrain, memory.free()
    samples = math.prod(ground.shape) if ground.kind == "tiles" else 0
    if free is not None and SAMPLE_BYTES * samples > free:
        size = f"terrain.rows = {ground.rows}, cols = {ground.cols}: {samples:,} samples of the ground"
        raise ConfigError([f"{size}: {memory.too_much(SAMPLE_BYTES * samples, free)}"])
    if available is not None and needed > available:
        ppo = config.ppo
        beyond = {"num_envs": ppo.num_envs / 4096, "steps": ppo.steps / 24, "hidden": max(ppo.hidden) / 512}
        first, *others = sorted(beyond, key=lambda name: -beyond[name])  # the one furthest beyond what is usual
        values = {name: f"ppo.{name} = {getattr(ppo, name)}" for name in ("num_envs", "steps")}
        values["hidden"] = f"ppo.hidden = {list(ppo.hidden)}"
        where = f"on {device}" if device.type == "cuda" else "in memory"
        amounts = f"at least {needed / 1e9:.1f} GB, and {available / 1e9:.1f} GB are free {where}"
        raise ConfigError([f"{values[first]}: with {' and '.join(values[n] for n in others)} it takes {amounts}"])
