"""Tracking of a grid of constant commands, several episodes of each, as one batch; the delay margin."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch

from go1exp.base import memory
from go1exp.base.wording import counted
from go1exp.config.schema.physics import BackendConfig, CpuBackend
from go1exp.config.schema.registry import ConfigError, Term, TooLongError, members
from go1exp.evaluate.agents import ControllerAgent, PolicyAgent
from go1exp.evaluate.controller.types import Command, Controller, TrunkVelocity
from go1exp.evaluate.quantities import AXES, described, drawn, rows_of, share
from go1exp.evaluate.recorder import Recorder, bytes_per_second
from go1exp.mdp.commands import FixedVelocity
from go1exp.mdp.measures import measured
from go1exp.sim.env.batch import refuse_too_many
from go1exp.sim.env.core import Go1Core
from go1exp.sim.env.engine import make_backend
from go1exp.sim.physics.agreement import Check, require, robots_needed
from go1exp.sim.physics.scene import build_model
from go1exp.sim.task import TaskConfig, time_rules
from go1exp.sim.terrain import TerrainConfig, build_terrain
from go1exp.train.policy import Policy


@dataclass(frozen=True)
class EvalConfig:
    """Settings of an evaluation."""

    commands: tuple[Command, ...]  # the grid
    episodes: int  # episodes of each command
    seconds: float  # length of an episode, s
    settle_s: float = 0.0  # time at its start that counts for falls but not for tracking, s
    noise: bool = False  # add the observation noise of training
    randomize: bool = False  # randomise robots and starts as in training; if not, the nominal robot
    push: bool = False  # push as in training
    train_ground: bool = False  # use the ground of training; if not, flat ground
    policy_dt: float | None = None  # another period of the policy, s, or None for that of training
    seed: int = 1  # seed of everything random
    physics_dt: float | None = None  # another physics step, s, or None for that of training
    # velocity that the policy observes: ``exact``, or ``estimated`` from the sensors by the filter
    trunk_velocity: TrunkVelocity = "exact"
    engine: BackendConfig | None = None  # what moves the robots, or None for MuJoCo on the processor


def evaluation_task(task: TaskConfig, config: EvalConfig) -> TaskConfig:
    """Return the task that evaluates a policy of ``task``, on the CPU; raise ConfigError if its two steps misfit."""
    period = config.policy_dt or task.sim.policy_dt
    beyond = (math.ceil(config.seconds / period) + 1) * period  # no time limit within the evaluation
    step = config.physics_dt or task.sim.physics_dt
    sim = dataclasses.replace(task.sim, physics_dt=step, policy_dt=period, episode_s=beyond, spread_starts=False)
    if problems := time_rules(sim):
        raise ConfigError(problems)
    fixed = Term("command", members("command")["fixed_velocity"], {})
    engine = config.engine or task.backend.as_reference()
    changes: dict[str, Any] = {"sim": sim, "command": fixed, "curriculum": (), "backend": engine}
    if period < task.sim.policy_dt:  # agents bound the change over a period of training, which is several steps
        changes["action"] = dataclasses.replace(task.action, max_step=None)
    if not config.randomize:
        changes["rand"] = ()
        changes["effect"] = tuple(dataclasses.replace(e, slots={**e.slots, "spread": {}}) for e in task.effect)
    if not config.push:
        changes["event"] = ()
    if not config.train_ground:
        changes["terrain"] = TerrainConfig(kind="flat")
    return dataclasses.replace(task, **changes)


def require_agreement(task: TaskConfig) -> list[Check]:
    """Return the checks of an engine against MuJoCo, none for that; raise Expected if they fail, or without it."""
    if isinstance(task.backend, CpuBackend):
        return []
    ground = build_terrain(TerrainConfig(kind="flat"))
    model, sensors = build_model(task.robot, ground, task.sim.physics_dt, contact=task.contact)
    mujoco, engine = (make_backend(b, model, sensors, robots_needed()) for b in (CpuBackend("cpu", 1), task.backend))
    return require(mujoco, engine, task.backend.name)


def evaluate(
    task: TaskConfig,
    policy: Policy | None,
    config: EvalConfig,
    on_step: Callable[[int, int], None] = lambda done, total: None,
    measures: Sequence[Term] = (),
    controller: Callable[[], Controller] | None = None,
) -> dict[str, Any]:
    """Run the grid and return a report of plain data.

    A robot counts until it falls. Tracking figures of a command are over all its robots and the time after
    ``settle_s``: ``mean`` velocity, ``rmse`` against the command, per axis. ``on_step`` is called with the progress.
    ``controller`` makes what moves one robot in place of the policy, by its own sensors.
    ``measures`` (``go1exp/mdp/measures``) are over the same time and over robots that differ: ``distinct`` of them.
    ``rows`` has one entry for each robot, for a file of its own.
    ``agreement`` has the differences of another engine from MuJoCo, checked first: raise Expected if they are too
    large, TooLongError if what measures need does not fit into memory, ConfigError if ``settle_s`` leaves no step.
    """
    count = len(config.commands) * config.episodes
    agent = ControllerAgent("", task, controller) if controller else PolicyAgent("", task, cast(Policy, policy))
    imu = config.trunk_velocity == "estimated" or agent.senses
    task = evaluation_task(task, config)
    _check_memory(config, task, bytes_per_second(task, count) if measures else 0.0)
    dt = task.sim.policy_dt
    steps, settle = _steps(config, dt)
    checks = require_agreement(task)
    core = Go1Core(task, count, config.seed, noise=config.noise, imu=imu)
    act = agent.begin(core, config.trunk_velocity, config.seed)
    assert isinstance(core.command, FixedVelocity)
    _share_out(core, config)
    observation = core.reset()
    draws = drawn(core)  # robots that fall are drawn anew
    tally = _Tally(count)
    recorder = Recorder(core, steps - settle) if measures else None
    for step in range(steps):
        if recorder and step >= settle:
            recorder.begin_step()
        result = core.step(act(observation))
        core.check(result)
        observation = result.observation
        tally.add_step(result.terminated, result.truncated, dt)
        if step >= settle:
            tally.add_velocity(planar_velocity(core), core.command.value)
            if recorder:
                recorder.end_step(tally.alive)
        on_step(step + 1, steps)
    report = {**tally.report(config), "physics_dt": core.task.sim.physics_dt}
    if checks:
        report["agreement"] = [dataclasses.asdict(check) for check in checks]
    if recorder:
        for k, row in enumerate(report["commands"]):
            row["measures"] = described(measures, recorder.trace(tally.distinct(k, config).numpy()))
        report["units"] = {t.key: t.entry.traits["unit"] for t in measures}
    of_robots = measured(recorder.trace(slice(None)), list(measures)) if recorder else {}
    report["rows"] = rows_of(
        commands=core.command.value.double().numpy(), draws=draws, measures=of_robots, **tally.each(config)
    )
    return report


def _share_out(core: Go1Core, config: EvalConfig) -> None:
    """Give robot i command i // episodes, and the robots of each command the same columns of tiles, of all kinds."""
    commands = torch.tensor(config.commands, dtype=torch.float32)
    core.command.value.copy_(commands.repeat_interleave(config.episodes, 0))
    columns, each = len(core.terrain.tile_types), torch.arange(config.episodes)
    spread = each * columns // config.episodes if config.episodes < columns else each % columns
    core.tile_column.copy_(spread.repeat(len(config.commands)))


def _steps(config: EvalConfig, dt: float) -> tuple[int, int]:
    """Return how many steps are played, and how many of them do not count; raise ConfigError if none does."""
    steps, settle = round(config.seconds / dt), round(config.settle_s / dt)
    if steps <= settle:
        left = f"no step of the policy ({dt:g} s) is left after settle_s = {config.settle_s:g}"
        raise ConfigError([f"seconds = {config.seconds:g}: {left}"])
    return steps, settle


def _check_memory(config: EvalConfig, task: TaskConfig, rate: float) -> None:
    """Raise ConfigError if the robots do not fit into memory; TooLongError if ``rate`` B/s of measures do not."""
    refuse_too_many("episodes", config.episodes, task, len(config.commands))
    count = len(config.commands) * config.episodes
    seconds, available = config.seconds - config.settle_s, memory.free()
    if available is None or seconds * rate <= available:
        return
    what = f"what measures need of {counted(count, 'robot')} {memory.too_much(seconds * rate, available)}"
    fitting, key = f"{available / rate:.0f} s", f"seconds = {config.seconds:g}"
    if rate > available:  # not one second would fit
        fitting = str(int(config.episodes * available / (seconds * rate)))
        key = f"episodes = {config.episodes}"
    raise TooLongError([f"{key}: {what}; {fitting} at most would fit; measures=[] needs none of it"])


def planar_velocity(core: Go1Core) -> torch.Tensor:
    """Return the velocity of the trunk in its own frame (N, 3), float64: x and y in m/s, yaw rate in rad/s."""
    s = core.snapshot()
    return torch.cat([s.base_lin_vel_b[:, :2], s.base_ang_vel_b[:, 2:]], dim=1).double()


class _Tally:
    """Running sums over the steps of an evaluation, one row for each robot."""

    def __init__(self, count: int) -> None:
        self.alive = torch.ones(count, dtype=torch.bool)
        self.fell = torch.zeros(count, dtype=torch.bool)
        self.survived = torch.zeros(count)  # s
        self.samples = torch.zeros(count)
        # float64: sums over thousands of steps
        self.velocity_sum = torch.zeros(count, 3, dtype=torch.float64)
        self.square_sum = torch.zeros(count, 3, dtype=torch.float64)

    def add_step(self, terminated: torch.Tensor, truncated: torch.Tensor, dt: float) -> None:
        """Count falls and time; a robot that has fallen starts again but does not count any more."""
        self.fell |= self.alive & terminated
        self.alive &= ~(terminated | truncated)
        self.survived += self.alive * dt

    def add_velocity(self, velocity: torch.Tensor, command: torch.Tensor) -> None:
        """Add the velocities (N, 3) of the robots that have not fallen, and their squared errors."""
        counted = self.alive.unsqueeze(1)
        self.velocity_sum += velocity * counted
        self.square_sum += (velocity - command).square() * counted
        self.samples += self.alive

    def report(self, config: EvalConfig) -> dict[str, Any]:
        """Return the report: one row for each command, and the totals."""
        each = [self.distinct(k, config) for k in range(len(config.commands))]
        return {
            "commands": [self._row(k, each[k], config) for k in range(len(config.commands))],
            **self._totals(slice(None), torch.cat(each)),
            "settings": {k: v for k, v in dataclasses.asdict(config).items() if k != "commands"},
        }

    def each(self, config: EvalConfig) -> dict[str, Any]:
        """Return what each robot came to, as ``rows_of`` takes it."""
        mean = self.square_sum / self.samples.double().unsqueeze(1)  # NaN without a sample
        return {
            "episodes": config.episodes,
            "errors": mean.sqrt().numpy(),
            "fell": self.fell.numpy(),
            "moving_s": self.survived.double().numpy(),
        }

    def distinct(self, k: int, config: EvalConfig) -> torch.Tensor:
        """Return the robots of command ``k`` without repeats (``quantities.distinct``): indices, ascending."""
        first = k * config.episodes
        if not (config.noise or config.randomize or config.push or config.train_ground):
            return torch.tensor([first])
        robots = slice(first, first + config.episodes)
        sums = torch.cat([self.velocity_sum[robots], self.square_sum[robots], self.survived[robots, None].double()], 1)
        by_figures = {tuple(row): first + i for i, row in reversed(list(enumerate(sums.tolist())))}
        return torch.tensor(sorted(by_figures.values()))

    def _totals(self, robots: slice, distinct: torch.Tensor) -> dict[str, object]:
        """Return errors and falls of some robots together; ``distinct`` are those without repeats."""
        n, falls, fell = float(self.samples[robots].sum()), self.fell[robots], int(self.fell[distinct].sum())
        return {
            "rmse": _per_axis((self.square_sum[robots].sum(0) / n).sqrt()) if n else None,
            "falls": int(falls.sum()),
            "episodes": len(falls),
            "distinct_falls": {"count": fell, **share(fell, len(distinct))},
        }

    def _row(self, k: int, distinct: torch.Tensor, config: EvalConfig) -> dict[str, object]:
        robots = slice(k * config.episodes, (k + 1) * config.episodes)
        n = float(self.samples[robots].sum())
        return {
            "command": list(config.commands[k]),
            "mean": _per_axis(self.velocity_sum[robots].sum(0) / n) if n else None,
            **self._totals(robots, distinct),
            "mean_time_s": float(self.survived[robots].mean()),
        }


def grid(x: Sequence[float], y: Sequence[float], yaw: Sequence[float], cross: bool) -> tuple[Command, ...]:
    """Return commands: every combination of the axes' values, or (``cross`` false) one axis at a time and standing."""
    if cross:
        return tuple((a, b, c) for a in x for b in y for c in yaw)
    single = [(a, 0.0, 0.0) for a in x] + [(0.0, b, 0.0) for b in y] + [(0.0, 0.0, c) for c in yaw]
    return tuple(dict.fromkeys([(0.0, 0.0, 0.0), *single]))


def _per_axis(values: torch.Tensor) -> dict[str, float]:
    return {axis: round(float(v), 5) for axis, v in zip(AXES, values, strict=True)}


DELAYS_MS = (10, 20, 30, 40)  # further delays of commands that are tried, ms
DELAY = "command_delay"  # effect that delays commands


def delayed(task: TaskConfig, delay: float) -> TaskConfig:
    """Return the task with a command delay of ``delay`` s, in place of that of its own effects."""
    others = tuple(e for e in task.effect if e.entry.name != DELAY)
    entry = members("effect")[DELAY]
    term = Term(DELAY, entry, entry.check({"delay": delay}, DELAY)[0], {"spread": {}})
    return dataclasses.replace(task, effect=(*others, term))


def delay_margin(
    task: TaskConfig,
    policy: Policy | None,
    config: EvalConfig,
    falls: Mapping[str, float | None],
    on_step: Callable[[int, int], None] = lambda done, total: None,
    controller: Callable[[], Controller] | None = None,
) -> dict[str, Any]:
    """Run the grid of ``evaluate`` with growing command delay until a robot falls; return the largest without, ``ms``.

    A delay of the actuator stays, and the margin is added to it. ``falls`` are the ``distinct_falls`` without any, and
    of each delay that was run in what is returned; ``ms`` is None if robots fall without any.
    """
    runs, margin = {"0": falls}, None if falls["count"] else 0
    for ms in () if margin is None else DELAYS_MS:
        late = delayed(task, 1e-3 * ms)
        runs[str(ms)] = evaluate(late, policy, config, on_step, controller=controller)["distinct_falls"]
        if runs[str(ms)]["count"]:
            break
        margin = ms
    return {"ms": margin, "falls": runs}
