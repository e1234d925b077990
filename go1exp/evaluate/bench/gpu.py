"""``suite=gpu``: speed of the environment step and of training relative to bare MuJoCo Warp, on this GPU."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import torch

from go1exp import robot
from go1exp.config.schema.joint_values import spread
from go1exp.config.schema.registry import ConfigError
from go1exp.evaluate.bench.env import (
    ACTION_SCALE,
    Measured,
    Subject,
    learning,
    least_time_share,
    products_subject,
    rates,
    ratio,
    speeds,
)
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.engine import make_backend
from go1exp.sim.env.sb3_env import Go1VecEnv
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import TaskConfig, TrainConfig
from go1exp.sim.terrain import build_terrain
from go1exp.train import trainer
from go1exp.train.ppo import AdaptivePPO

STEPS = 24  # policy steps between two readings of the clock; each reading waits for the device
PAPER_STEPS = 4096 * 24 * 5000  # policy steps in the training of the paper (section III-A)


def gpu() -> str:
    """Name the GPU and the versions that matter, one line."""
    import mujoco_warp
    import warp

    return f"{torch.cuda.get_device_name()}, mujoco-warp {mujoco_warp.__version__}, warp {warp.__version__}"


def stepped(step: Callable[[torch.Tensor], object], num_envs: int) -> Subject:
    """Return work that makes ``STEPS`` policy steps under random actions and waits for them."""
    generator = torch.Generator("cuda").manual_seed(0)

    def work() -> int:
        for _ in range(STEPS):
            step(ACTION_SCALE * torch.randn(num_envs, robot.NUM_JOINTS, generator=generator, device="cuda"))
        torch.cuda.synchronize()
        return STEPS * num_envs

    return work


def bare_subject(task: TaskConfig, num_envs: int, change: Callable[[Any], object] = lambda model: None) -> Subject:
    """MuJoCo Warp alone, as one graph: the same model with its sensors, a PD torque once a policy step, no MDP.

    ``change`` may set options of the compiled ``mujoco.MjModel``.
    """
    terrain = build_terrain(task.terrain)
    model, sensors = build_model(task.robot, terrain, task.sim.physics_dt, contact=task.contact)
    change(model)
    backend = make_backend(task.backend, model, sensors, num_envs)
    device = backend.qpos.device
    qpos, qvel = torch.zeros_like(backend.qpos), torch.zeros_like(backend.qvel)
    stance, limit = (
        torch.as_tensor(a, dtype=torch.float32, device=device)
        for a in (robot.NOMINAL_STANCE, robot.per_joint(task.robot.effort_limit))
    )
    origins = torch.as_tensor(terrain.tile_origins, dtype=torch.float32, device=device).reshape(-1, 3)
    qpos[:, :3] = origins[torch.arange(num_envs, device=device) % len(origins)]
    qpos[:, 2] += robot.NOMINAL_HEIGHT
    qpos[:, 3], qpos[:, 7:] = 1.0, stance
    backend.reset(torch.ones(num_envs, dtype=torch.bool, device=device), qpos, qvel)
    kp, kd = (task.actuator.parameters.get(name, usual) for name, usual in (("kp", 20.0), ("kd", 0.5)))
    kp, kd = (torch.as_tensor(spread(k, robot.JOINTS), dtype=torch.float32, device=device) for k in (kp, kd))
    action = torch.zeros(num_envs, robot.NUM_JOINTS, device=device)

    def hold() -> None:
        error = stance + task.action.scale * action - backend.qpos[:, 7:]
        torque = torch.clamp(kp * error - kd * backend.qvel[:, 6:], -limit, limit)
        for _ in range(task.sim.decimation):
            backend.step(torque)

    # One graph for all substeps of a policy step, as in the environment.
    replay, _ = backend.capture(hold)  # type: ignore[attr-defined]  # this suite's backend can

    def step(given: torch.Tensor) -> None:
        action.copy_(given)
        replay()

    return stepped(step, num_envs)


def border_subject(config: TrainConfig) -> Subject:
    """Training through SB3's own loop and buffer, with every step in numpy."""
    core = Go1Core(config.task, config.ppo.num_envs, config.process.seed, spread_starts=True, critic=True)
    ppo = AdaptivePPO(config.ppo, Go1VecEnv(core), config.process.seed, "cuda")
    return learning(ppo, config)


_FIRST = """
import sys
from go1exp.config.compose import compose
from go1exp.sim.task import parse_train
from go1exp.train import trainer
config = parse_train(compose("train", sys.argv[1:]))
trainer.build(config).learn(config.ppo.num_envs * config.ppo.steps)
"""


def first_update_seconds(overrides: list[str]) -> tuple[float, float]:
    """Return how long a fresh process takes to its first update, s: with no kernel compiled, and with all of them."""

    def once(cache: str) -> float:
        start = time.perf_counter()
        command = [sys.executable, "-c", _FIRST, *overrides]
        subprocess.run(command, check=True, capture_output=True, env={**os.environ, "WARP_CACHE_PATH": cache})
        return time.perf_counter() - start

    with tempfile.TemporaryDirectory() as cache:
        return once(cache), once(cache)


def run(config: TrainConfig, overrides: list[str], much: Measured) -> dict[str, float]:
    """Measure; return the figures by name; raise ConfigError of another backend."""
    if not config.task.backend.on_gpu:
        raise ConfigError(["suite=gpu needs backend=warp on a CUDA device"])
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, num_envs=much.num_envs))
    core = Go1Core(config.task, much.num_envs)
    core.reset()
    subjects = {"bare": bare_subject(config.task, much.num_envs), "env": stepped(core.step, much.num_envs)}
    ppo = trainer.build(config)
    subjects |= {"train": learning(ppo, config, torch.cuda.synchronize), "numpy": border_subject(config)}
    subjects["matrix_products"] = products_subject(ppo, torch.cuda.synchronize)
    measured = rates(subjects, much)
    cold, warm = first_update_seconds([*overrides, f"ppo.num_envs={much.num_envs}"])
    speed = speeds(measured)
    return {
        **speed,
        "gpu_env_over_bare": ratio(measured, "env", "bare"),
        "gpu_train_over_env": ratio(measured, "train", "env"),
        "gpu_train_over_env_limit": least_time_share(measured),
        "gpu_train_over_numpy": ratio(measured, "train", "numpy"),
        "paper_minutes": PAPER_STEPS / speed["train_steps_per_s"] / 60.0,
        "first_update_cold_s": cold,
        "first_update_warm_s": warm,
    }
