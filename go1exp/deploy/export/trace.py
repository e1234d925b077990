"""The trace: some seconds of the environment under a policy, inputs and outputs of each step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from torch import Tensor

from go1exp.config.schema.backends import CpuBackend
from go1exp.config.schema.history import history_columns
from go1exp.deploy.runtime.metadata import Port
from go1exp.sim.effects.base import Measured
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig


def readings(core: Go1Core) -> dict[str, Tensor]:
    """Return the present readings of the robots' sensors and computers, (N, size) by name, without noise."""
    s = core.snapshot()
    assert s.base_lin_vel_b is not None
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
        "walked": s.episode_time.unsqueeze(-1),
    }
    return {name: values.float().clone() for name, values in current.items()}


def traced_task(task: TaskConfig, seconds: float) -> TaskConfig:
    """Return the task in which a trace is recorded: that of training, as one episode, on the CPU with one thread."""
    period = task.sim.policy_dt
    sim = dataclasses.replace(task.sim, episode_s=(round(seconds / period) + 2) * period, spread_starts=False)
    return dataclasses.replace(task, sim=sim, backend=CpuBackend("cpu", threads=1), curriculum=())


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
    core = Go1Core(traced_task(task, seconds), 1, seed, noise=False)
    observation = core.reset()
    steps, period = max(1, round(seconds / task.sim.policy_dt)), task.sim.policy_dt
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
