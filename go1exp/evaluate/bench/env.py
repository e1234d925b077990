"""``suite=env`` and ``suite=train``: speed of the environment relative to bare MuJoCo, memory, training.

Timing is robust on a busy machine: subjects run in turns, and the median of the rounds counts.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import platform
import resource
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from mujoco.batch import Batch
from stable_baselines3.common.vec_env import SubprocVecEnv

from go1exp import robot
from go1exp.config.schema.joint_values import spread
from go1exp.sim.env.batch import MANY as MANY_ROBOTS
from go1exp.sim.env.batch import robot_bytes
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.gym_env import Go1Env
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import TaskConfig, TrainConfig
from go1exp.sim.terrain import build_terrain
from go1exp.train import trainer
from go1exp.train.network import policy_settings
from go1exp.train.ppo import AdaptivePPO

Subject = Callable[[], int]  # a piece of work to measure: does one unit and returns its number of environment steps


@dataclass(frozen=True)
class Measured:
    """How much is measured, and how progress is reported."""

    num_envs: int  # environments of a batch
    rounds: int
    seconds: float  # of each subject in each round
    on_round: Callable[[int, int], None]  # called with the rounds that are done, and all


def rates(subjects: Mapping[str, Subject], much: Measured) -> dict[str, list[float]]:
    """Return the steps per second of each subject in each round; a warm-up unit of each does not count."""
    for work in subjects.values():
        work()
    measured: dict[str, list[float]] = {name: [] for name in subjects}
    for k in range(much.rounds):
        for name, work in subjects.items():
            steps, start = 0, time.perf_counter()
            # Whole units only: the time is taken after the last one.
            while (elapsed := time.perf_counter() - start) < much.seconds:
                steps += work()
            measured[name].append(steps / elapsed)
        much.on_round(k + 1, much.rounds)
    return measured


def ratio(rates: Mapping[str, list[float]], over: str, under: str) -> float:
    """Return the median over rounds of one subject's rate over another's, taken within each round."""
    return statistics.median(a / b for a, b in zip(rates[over], rates[under], strict=True))


def speeds(rates: Mapping[str, list[float]]) -> dict[str, float]:
    """Return the median over rounds of each subject's rate, by the figure's name."""
    return {f"{name}_steps_per_s": statistics.median(values) for name, values in rates.items()}


def machine() -> str:
    """Describe the machine and the versions that matter, one line."""
    cpu = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{cpu}, {os.cpu_count()} cores, mujoco {version('mujoco-core')}, torch {torch.__version__}"


ACTION_SCALE = 0.5  # standard deviation of random actions, policy units (chosen: robots move their feet and few fall)
MANY = 2048  # environments of the larger batch whose memory is measured


def core_subject(task: TaskConfig, num_envs: int) -> Subject:
    """The whole environment step under random actions."""
    core = Go1Core(task, num_envs)
    core.reset()
    generator = torch.Generator().manual_seed(0)

    def work() -> int:
        core.step(ACTION_SCALE * torch.randn(num_envs, robot.NUM_JOINTS, generator=generator))
        return num_envs

    return work


def bare_subject(task: TaskConfig, num_envs: int) -> Subject:
    """MuJoCo's batch alone: the same model with its sensors, a PD torque held for each policy step, no MDP."""
    terrain = build_terrain(task.terrain)
    model, _ = build_model(task.robot, terrain, task.sim.physics_dt, contact=task.contact)
    batch = Batch(model, num_envs, nthread=task.backend.as_reference().threads)
    qpos, qvel, ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
    batch.bind("sensordata")  # so that sensors are computed and copied, as in the environment
    batch.reset(keyframe=0)
    origins = terrain.tile_origins.reshape(-1, 3)
    qpos[:, :3] += origins[np.arange(num_envs) % len(origins)]
    limit = robot.per_joint(task.robot.effort_limit)
    kp, kd = (task.actuator.parameters.get(name, usual) for name, usual in (("kp", 20.0), ("kd", 0.5)))
    kp, kd = spread(kp, robot.JOINTS), spread(kd, robot.JOINTS)
    rng = np.random.default_rng(0)

    def work() -> int:
        target = robot.NOMINAL_STANCE + task.action.scale * ACTION_SCALE * rng.normal(size=(num_envs, 12))
        torque = kp * (target - qpos[:, 7:]) - kd * qvel[:, 6:]
        np.clip(torque, -limit, limit, out=ctrl)
        batch.step(nstep=task.sim.decimation)
        return num_envs

    return work


def _one_env(task: TaskConfig, index: int) -> Go1Env:
    torch.set_num_threads(1)
    return Go1Env(task=task, env_index=index)


def subproc_subject(task: TaskConfig) -> tuple[Subject, Callable[[], None]]:
    """Our own single environment in SB3's SubprocVecEnv, a process per core; also how to end it."""
    count = os.cpu_count() or 1
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for this process, which then ends the others
    try:
        vec = SubprocVecEnv([functools.partial(_one_env, task, i) for i in range(count)], start_method="spawn")
    finally:
        signal.signal(signal.SIGINT, before)
    vec.reset()
    rng = np.random.default_rng(0)

    def work() -> int:
        vec.step((ACTION_SCALE * rng.normal(size=(count, robot.NUM_JOINTS))).astype(np.float32))
        return count

    return work, vec.close


_MEMORY_PROBE = """
import sys
from go1exp.evaluate.bench.env import resident_kb_after_steps
print(resident_kb_after_steps(int(sys.argv[1]), sys.argv[2:]))
"""


def resident_kb_after_steps(num_envs: int, overrides: list[str]) -> int:
    """Build an environment of ``num_envs``, step it, return this process's peak resident memory, kB.

    From Linux's own account where there is one: ``getrusage`` counts the memory of the process that started this one.
    """
    from go1exp.config.compose import compose
    from go1exp.sim.task import parse_task

    work = core_subject(parse_task(compose("train", overrides)), num_envs)
    for _ in range(3):
        work()
    try:
        status = Path("/proc/self/status").read_text()
        return int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM")))
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def memory_per_env_kb(overrides: list[str]) -> float:
    """Return peak memory per environment beyond the first, kB, from two fresh processes."""

    def peak(num_envs: int) -> int:
        command = [sys.executable, "-c", _MEMORY_PROBE, str(num_envs), *overrides]
        return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)

    return (peak(MANY) - peak(1)) / (MANY - 1)


def run(task: TaskConfig, overrides: list[str], much: Measured) -> dict[str, float]:
    """Measure; return the figures by name."""
    subproc, close = subproc_subject(task)
    subjects = {"env": core_subject(task, much.num_envs), "bare": bare_subject(task, much.num_envs)}
    try:
        measured = rates(subjects | {"subproc": subproc}, much)
    finally:
        close()
    return {
        **speeds(measured),
        "env_over_bare": ratio(measured, "env", "bare"),
        "env_over_subproc": ratio(measured, "env", "subproc"),
        "memory_per_env_kb": memory_per_env_kb(overrides),
        "memory_per_env_kb_limit": robot_bytes(task, MANY_ROBOTS) / 1e3,
    }


def learning(ppo: AdaptivePPO, config: TrainConfig, finish: Callable[[], None] = lambda: None) -> Subject:
    """Whole iterations: rollout, advantages, update; ``finish`` waits for the device."""
    size = config.ppo.num_envs * config.ppo.steps

    def work() -> int:
        ppo.learn(size, reset_num_timesteps=ppo.iteration == 0)
        finish()
        return size

    return work


def products_subject(ppo: AdaptivePPO, finish: Callable[[], None] = lambda: None) -> Subject:
    """The matrix products of an update's linear layers alone, forward and backward: what an update takes at least.

    The gradient of the observations is among them, which an update leaves out.
    """
    policy, c = ppo.policy, ppo.config
    rows = ppo.batch_size * (2 if c.symmetry else 1)
    kind = torch.bfloat16 if policy_settings(c)["bf16"] else torch.float32
    weights = [m.weight.detach().to(kind) for m in policy.modules() if isinstance(m, torch.nn.Linear)]
    layers = [(w, torch.randn(rows, w.shape[1]).to(w), torch.randn(rows, w.shape[0]).to(w)) for w in weights]

    def work() -> int:
        for _ in range(c.epochs * c.minibatches):
            for weight, given, gradient in layers:
                given @ weight.T, gradient.T @ given, gradient @ weight
        finish()
        return ppo.n_envs * ppo.n_steps

    return work


def least_time_share(measured: Mapping[str, list[float]]) -> float:
    """Return what training over environment would be if an update took no longer than its matrix products."""
    pairs = zip(measured["env"], measured["matrix_products"], strict=True)
    return statistics.median(1.0 / (1.0 + env / products) for env, products in pairs)


def train(config: TrainConfig, much: Measured) -> dict[str, float]:
    """Measure; return the figures by name."""
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, num_envs=much.num_envs))
    ppo = trainer.build(config)
    subjects = {"train": learning(ppo, config), "env": core_subject(config.task, much.num_envs)}
    measured = rates(subjects | {"matrix_products": products_subject(ppo)}, much)
    over = {"train_over_env": ratio(measured, "train", "env"), "train_over_env_limit": least_time_share(measured)}
    return {**speeds(measured), **over}
