"""How well a policy follows commands: a grid of constant commands, many episodes of each, all at once."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch

from go1exp.config import TaskConfig, time_rules
from go1exp.deploy.past import PastActions
from go1exp.env.core import Go1Core
from go1exp.evaluate.estimated import EstimatedVelocity
from go1exp.evaluate.observed import columns
from go1exp.evaluate.policy import Policy
from go1exp.mdp.commands import FixedVelocity
from go1exp.schema.registry import ConfigError, Term, members
from go1exp.terrain import TerrainConfig

Command = tuple[float, float, float]
"""Commanded velocity: x, y in m/s, yaw rate in rad/s, body frame."""

AXES = ("x", "y", "yaw")


@dataclass(frozen=True)
class EvalConfig:
    """What to run a policy through.

    Attributes:
        commands: the grid.
        episodes: episodes of each command.
        duration_s: length of an episode, s.
        settle_s: time at its start that counts for falls but not for tracking, s.
        noise: add the observation noise of training.
        randomize: randomise robots and starts as in training; else the nominal robot.
        push: push as in training.
        train_ground: the ground of training; else flat.
        policy_dt: another period of the policy, s, or None for that of training.
        seed: of everything random.
        physics_dt: another step of the physics, s, or None for that of training.
        trunk_velocity: what the policy sees of it: ``exact``, or ``estimated`` by the filter from the robot's sensors.
    """

    commands: tuple[Command, ...]
    episodes: int
    duration_s: float
    settle_s: float
    noise: bool
    randomize: bool
    push: bool
    train_ground: bool
    policy_dt: float | None
    seed: int
    physics_dt: float | None = None
    trunk_velocity: Literal["exact", "estimated"] = "exact"

    @classmethod
    def of(cls, settings: Any, **changes: Any) -> EvalConfig:
        """Take what ``settings`` (of a verb) has of these attributes; ``changes`` give the rest."""
        shared = {f.name: getattr(settings, f.name) for f in dataclasses.fields(cls) if hasattr(settings, f.name)}
        return cls(**{**shared, **changes})


def evaluation_task(task: TaskConfig, config: EvalConfig) -> TaskConfig:
    """Return the task in which a policy trained on ``task`` is judged: on the CPU, wherever it was trained.

    Raises:
        ConfigError: if the times do not divide each other.
    """
    period = config.policy_dt or task.sim.policy_dt
    beyond = (math.ceil(config.duration_s / period) + 1) * period  # no time limit within the evaluation
    step = config.physics_dt or task.sim.physics_dt
    sim = dataclasses.replace(task.sim, physics_dt=step, policy_dt=period, episode_s=beyond, spread_starts=False)
    if problems := time_rules(sim):
        raise ConfigError(problems)
    fixed = Term("command", members("command")["fixed_velocity"], {})
    engine = task.backend.as_reference()
    changes: dict[str, Any] = {"sim": sim, "command": fixed, "curriculum": (), "backend": engine}
    if not config.randomize:
        changes["rand"] = ()
        changes["effect"] = tuple(dataclasses.replace(e, slots={**e.slots, "spread": {}}) for e in task.effect)
    if not config.push:
        changes["event"] = ()
    if not config.train_ground:
        changes["terrain"] = TerrainConfig(kind="flat")
    return dataclasses.replace(task, **changes)


def evaluate(
    task: TaskConfig, policy: Policy, config: EvalConfig, on_step: Callable[[int, int], None] = lambda done, total: None
) -> dict[str, Any]:
    """Run the grid and return a report of plain data.

    A robot counts until it falls. Tracking figures of a command are over all its robots and the time after
    ``settle_s``: ``mean`` velocity, ``rmse`` against the command, per axis. ``on_step`` is told the progress in steps.
    """
    count = len(config.commands) * config.episodes
    estimated = config.trunk_velocity == "estimated"
    core = Go1Core(evaluation_task(task, config), count, config.seed, noise=config.noise, imu=estimated)
    seen = EstimatedVelocity(core, config.noise, config.seed).put if estimated else lambda observation: observation
    past = PastActions[torch.Tensor](task.sim.policy_dt, core.task.sim.policy_dt)
    held = columns(core.task, "previous_action") if past.cycles > 1 else None
    assert isinstance(core.command, FixedVelocity)
    commands = torch.tensor(config.commands, dtype=torch.float32)
    core.command.value.copy_(commands.repeat_interleave(config.episodes, 0))
    observation = core.reset()
    dt = core.task.sim.policy_dt
    steps, settle = round(config.duration_s / dt), round(config.settle_s / dt)

    alive = torch.ones(count, dtype=torch.bool)
    fell = torch.zeros(count, dtype=torch.bool)
    survived = torch.zeros(count)
    samples = torch.zeros(count)
    velocity_sum = torch.zeros(count, 3, dtype=torch.float64)
    square_sum = torch.zeros(count, 3, dtype=torch.float64)
    for step in range(steps):
        result = core.step(policy(seen(observation)))
        core.check(result)
        observation = result.observation
        if held is not None:
            observation = observation.clone()
            observation[:, held] = past.after(core.action.clone())
        fell |= alive & result.terminated
        alive &= ~(result.terminated | result.truncated)
        survived += alive * dt
        if step >= settle:
            s = core.snapshot()
            assert s.base_lin_vel_b is not None
            velocity = torch.cat([s.base_lin_vel_b[:, :2], s.base_ang_vel_b[:, 2:]], dim=1).double()
            counted = alive.unsqueeze(1)
            velocity_sum += velocity * counted
            square_sum += (velocity - core.command.value).square() * counted
            samples += alive
        on_step(step + 1, steps)

    rows = []
    for k, command in enumerate(config.commands):
        mine = slice(k * config.episodes, (k + 1) * config.episodes)
        n = float(samples[mine].sum())
        rows.append(
            {
                "command": list(command),
                "mean": _per_axis(velocity_sum[mine].sum(0) / n) if n else None,
                "rmse": _per_axis((square_sum[mine].sum(0) / n).sqrt()) if n else None,
                "falls": int(fell[mine].sum()),
                "episodes": config.episodes,
                "mean_time_s": float(survived[mine].mean()),
            }
        )
    total = float(samples.sum())
    overall = (square_sum.sum(0) / total).sqrt() if total else None
    return {
        "commands": rows,
        "rmse": _per_axis(overall) if overall is not None else None,
        "falls": int(fell.sum()),
        "episodes": count,
        "settings": {k: v for k, v in dataclasses.asdict(config).items() if k != "commands"},
    }


def grid(x: Sequence[float], y: Sequence[float], yaw: Sequence[float], cross: bool) -> tuple[Command, ...]:
    """Return commands: every combination of the axes' values, or (``cross`` false) one axis at a time and standing."""
    if cross:
        return tuple((a, b, c) for a in x for b in y for c in yaw)
    single = [(a, 0.0, 0.0) for a in x] + [(0.0, b, 0.0) for b in y] + [(0.0, 0.0, c) for c in yaw]
    return tuple(dict.fromkeys([(0.0, 0.0, 0.0), *single]))


def _per_axis(values: torch.Tensor) -> dict[str, float]:
    return {axis: round(float(v), 5) for axis, v in zip(AXES, values, strict=True)}
