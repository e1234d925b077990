"""Plays what a protocol asks for: N robots, each with its own command, kicks, delay and ground, as one batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from go1exp import robot
from go1exp.base.tensors.randomness import Stream
from go1exp.config.schema.physics import BackendConfig, fitting_step
from go1exp.config.schema.registry import Entry, Term, members
from go1exp.config.schema.settings import subset
from go1exp.evaluate.agents import Agent, Progress
from go1exp.evaluate.controller.types import TrunkVelocity
from go1exp.evaluate.protocol.plan import STEP_BYTES, Array, Brake, Impulses, Kicker, Motion, Plan, heading
from go1exp.evaluate.recorder import Recorder, bytes_per_step
from go1exp.evaluate.rollout import DELAY, EvalConfig, delayed, evaluation_task, planar_velocity, require_agreement
from go1exp.mdp.commands import FixedVelocity
from go1exp.mdp.kinematics import KinematicState
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import TaskConfig


@dataclass(frozen=True)
class Rates:
    """Settings of the command line for all protocols."""

    seed: int  # seed of everything random
    policy_dt: float | None = None  # another period of the policy, s; None keeps that of training
    physics_dt: float | None = None  # another physics step, s; None keeps that of training
    engine: BackendConfig | None = None  # physics engine; None takes MuJoCo on the CPU


@dataclass(frozen=True, kw_only=True)
class Setting(Rates):
    """The same with those of one protocol: observation noise, randomisation, and the observed trunk velocity."""

    noise: bool
    randomize: bool
    trunk_velocity: TrunkVelocity


class Stage:
    """One agent on its robots."""

    def __init__(self, agent: Agent, setting: Setting, on_step: Progress = lambda done, total: None) -> None:
        """Prepare; ``on_step`` is called with the progress of everything that is played after ``expect``."""
        self.agent, self.setting = agent, setting
        self._on_step, self._done, self._total = on_step, 0.0, 0.0

    @property
    def policy_dt(self) -> float:
        """Period of the policy, s."""
        return self.setting.policy_dt or self.agent.task.sim.policy_dt

    def times(self, duration: float, policy_dt: float | None = None) -> Array:
        """Return the instants (T,) at which the policy acts in ``duration`` s."""
        dt = policy_dt or self.policy_dt
        return np.asarray(np.arange(self.steps(duration, dt)) * dt, dtype=np.float64)

    def steps(self, duration: float, policy_dt: float | None = None) -> int:
        """Return how many times the policy acts in ``duration`` s."""
        return round(duration / (policy_dt or self.policy_dt))

    def physics_dt(self, policy_dt: float) -> float:
        """Return the physics step with a policy of that period, s."""
        return self.setting.physics_dt or fitting_step(policy_dt, self.agent.task.sim.physics_dt)

    def bytes_per_second(self, robots: int, policy_dt: float | None, figures: int) -> tuple[float, float]:
        """Return what robots take, B/s: with ``figures`` numbers a step, and beside it while measures are recorded."""
        dt = policy_dt or self.policy_dt
        recorded = bytes_per_step(round(dt / self.physics_dt(dt)))
        return robots * (STEP_BYTES + 8 * figures) / dt, robots * recorded / dt

    def expect(self, steps_of_robots: float) -> None:
        """Add to the expected number of policy steps times robots, for the progress."""
        self._total += steps_of_robots

    def count(self, steps_of_robots: float) -> None:
        """Report so many policy steps times robots as done."""
        self._done += steps_of_robots
        self._on_step(min(round(self._done), round(self._total) - 1), round(self._total))

    def finished(self) -> None:
        """Report the end."""
        self._on_step(max(round(self._total), 1), max(round(self._total), 1))

    def run(self, plan: Plan) -> Motion:
        """Play a plan from its first to its last step."""
        return self.session(plan).run(len(plan.command))

    def session(self, plan: Plan) -> Session:
        """Return a plan's robots at the start, to be played piece by piece."""
        return Session(self, plan)

    def task(self, plan: Plan) -> TaskConfig:
        """Return the environment of a plan."""
        setting, of_agent = self.setting, self.agent.task
        policy_dt = plan.policy_dt or self.policy_dt
        seconds, physics_dt = len(plan.command) * policy_dt, self.physics_dt(policy_dt)
        times = {"seconds": seconds, "policy_dt": policy_dt, "physics_dt": physics_dt}
        config = subset(EvalConfig, setting, commands=(), episodes=plan.robots, **times)
        command = Term("command", Entry("command", "scheduled", _Scheduled), {})
        task = dataclasses.replace(evaluation_task(of_agent, config), terrain=plan.ground, command=command)
        if plan.friction is not None:
            task = dataclasses.replace(task, rand=_with_friction(task.rand, plan.friction))
        if plan.start is not None:
            task = dataclasses.replace(task, rand=(*task.rand, _starting(plan.start)))
        if plan.terminations is not None:
            task = dataclasses.replace(task, termination=plan.terminations)
        return task if plan.delay is None else delayed(task, 0.0)


class _Scheduled(FixedVelocity):
    """Velocities that a session gives: in force, and seen, from the step on for which they are meant."""

    source: Callable[[], Tensor] | None = None

    def advance(self, dt: float, restart: Tensor) -> None:
        """Take the next ones."""
        if self.source is not None:
            self.value.copy_(self.source())


class Session:
    """A plan that is played piece by piece, and that can return to a saved state."""

    def __init__(self, stage: Stage, plan: Plan) -> None:
        self._stage, self.plan = stage, plan
        self._velocity = plan.trunk_velocity or stage.setting.trunk_velocity
        task, seed = stage.task(plan), stage.setting.seed
        require_agreement(task)
        imu = stage.agent.senses or self._velocity == "estimated"
        self.core = Go1Core(task, plan.robots, seed, noise=stage.setting.noise, imu=imu)
        self._running = stage.agent.begin(self.core, self._velocity, seed)
        recording = plan.listen_from is not None
        self._recorder = Recorder(self.core, len(plan.command) - (plan.listen_from or 0)) if recording else None
        self._kicker = Kicker(self.core.backend, task.sim.physics_dt, plan.impulses) if plan.impulses else None
        self.brake: Brake | None = None
        if plan.braking is not None:
            peak = robot.per_joint(task.robot.effort_limit)
            self.brake = Brake(self.core.plant, task.sim.physics_dt, peak, plan.braking)
        if plan.delay is not None:  # before the first reset, which puts effects into force
            late: Tensor = self.core.plant.effects.effects[DELAY].delay
            usual = delay_of_effects(stage.agent.task)
            late.copy_(torch.from_numpy(plan.delay + usual)[:, None].expand_as(late))
        assert isinstance(self.core.command, _Scheduled)
        self._command, self._coming = self.core.command, 0
        self._command.source = self._next_command
        self._begin()

    def _begin(self) -> None:
        self.step = 0
        n = self.plan.robots
        self._alive, self._fell, self._left = (np.full(n, value) for value in (True, False, False))
        self._coming = 0
        self._observation = self.core.reset()
        if self._kicker:
            self._kicker.time = 0.0
        self._start = self.core.snapshot().base_pos_w[:, :2].numpy().copy()

    def use(self, impulses: Impulses) -> None:
        """Apply other kicks from now on."""
        assert self._kicker is not None
        self._kicker.use(impulses)

    def save(self) -> Any | None:
        """Return the state, or None if the agent cannot restore its own."""
        running = self._running.save()
        if running is None:
            return None
        counters = [self.step, self._alive.copy(), self._fell.copy(), self._left.copy(), self._observation.clone()]
        return self.core.state_dict(), running, counters, self._kicker.time if self._kicker else 0.0

    def load(self, state: Any | None, step: int) -> None:
        """Restore the state saved at ``step``; without a state, play everything up to it again."""
        if state is None:
            self._running = self._stage.agent.begin(self.core, self._velocity, self._stage.setting.seed)
            self.core.reseed(self._stage.setting.seed)
            self._begin()
            self.run(step)
            return
        environment, running, (self.step, alive, fell, left, observation), time = state
        self.core.load_state_dict(environment)
        self._running.load(running)
        self._alive, self._fell, self._left = alive.copy(), fell.copy(), left.copy()
        self._observation, self._coming = observation.clone(), self.step + 1
        if self._kicker:
            self._kicker.time = time

    def run(self, steps: int) -> Motion:
        """Play the next ``steps`` steps."""
        n, plan, core = self.plan.robots, self.plan, self.core
        dt, first = core.task.sim.policy_dt, self.step
        kept: dict[str, np.ndarray] = {name: np.zeros((steps, n)) for name in ("height", "way", "front_right")}
        kept |= {"velocity": np.zeros((steps, n, 3)), "alive": np.zeros((steps, n), bool)}
        kept["command"], finished, figures = np.zeros((steps, n, 3)), np.zeros(n, bool), list[Array]()
        for row in range(steps):
            kept["command"][row] = self._command.value.numpy()
            listening = self._recorder is not None and self.step >= (plan.listen_from or 0)
            if self._recorder and listening:
                self._recorder.begin_step()
            result = core.step(self._running(self._observation))
            core.check(result)
            self._observation = result.observation
            # Who fell, or left the map, starts again and does not count any more.
            self._fell |= self._alive & result.terminated.numpy()
            self._left |= self._alive & result.truncated.numpy()
            self._alive &= ~(result.terminated | result.truncated).numpy()
            if self._recorder and listening:
                self._recorder.end_step(torch.from_numpy(self._alive))
            self._keep(kept, row)
            if plan.figures is not None:
                figures.append(plan.figures(core.snapshot()).double().numpy())
            self.step += 1
            self._stage.count(n)
            if plan.finish is not None and ((kept["way"][row] >= plan.finish) | ~self._alive | finished).all():
                kept = {name: values[: row + 1] for name, values in kept.items()}
                self._stage.count(n * (steps - row - 1))
                break
            if plan.finish is not None:
                finished |= kept["way"][row] >= plan.finish
        t = np.asarray((first + 1 + np.arange(len(kept["way"]))) * dt, dtype=np.float64)
        trace = self._recorder.trace(slice(None)) if self._recorder else None
        ends = {"fell": self._fell.copy(), "left_map": self._left.copy()}
        return Motion(dt=dt, t=t, trace=trace, figures=np.array(figures) if figures else None, **ends, **kept)

    def _next_command(self) -> Tensor:
        """Return the command (N, 3) of the coming step, in which the state that steering needs is known."""
        command = self.plan.command[min(self._coming, len(self.plan.command) - 1)]
        self._coming += 1
        if self.plan.steer is not None:
            command = command.copy()
            qpos = self.core.backend.qpos
            beside = (qpos[:, 1] - self.core.spawn[:, 1]).numpy()
            turn = -self.plan.steer[0] * heading(qpos[:, 3:7]).numpy() - self.plan.along * self.plan.steer[1] * beside
            command[:, 2] = np.where(np.any(command != 0.0, axis=-1), np.clip(turn, -1.0, 1.0), 0.0)
        return torch.from_numpy(command)

    def _keep(self, kept: dict[str, np.ndarray], row: int) -> None:
        s = self.core.snapshot()
        kept["velocity"][row] = planar_velocity(self.core).numpy()
        below = self.core.ground_height(s.base_pos_w[:, :2])
        kept["height"][row] = (s.base_pos_w[:, 2] - below).numpy()
        kept["way"][row] = self.plan.along * (s.base_pos_w[:, 0].numpy() - self._start[:, 0])
        kept["alive"][row] = self._alive
        kept["front_right"][row] = s.foot_contact_time[:, 0].numpy()


def delay_of_effects(task: TaskConfig) -> float:
    """Return the command delay by the effects of a task, without their spread, s."""
    return sum(float(e.parameters["delay"]) for e in task.effect if e.entry.name == DELAY)


def _with_friction(terms: tuple[Term, ...], bounds: tuple[float | Array, float | Array]) -> tuple[Term, ...]:
    """Return randomisations in which the feet's friction is drawn from ``bounds``, numbers or (N,)."""
    entry = members("rand")["foot_friction"]
    each = tuple(b if isinstance(b, float) else torch.from_numpy(b).float().unsqueeze(-1) for b in bounds)
    others = tuple(t for t in terms if t.entry.name != entry.name)
    return (*others, Term("foot_friction", entry, {"range": each, "operation": "set"}, {"when": "reset"}))


def _starting(start: Array) -> Term:
    """Return a randomisation after which robots start at rest at ``start`` (N, 19), in MuJoCo's order."""
    given = torch.from_numpy(start)

    def put(state: KinematicState, stream: Stream) -> None:
        at = KinematicState.view(given, torch.zeros(len(given), 18, dtype=given.dtype))
        for part in dataclasses.fields(state):
            getattr(state, part.name).copy_(getattr(at, part.name))

    return Term("start", Entry("rand", "start", put, {"kind": "state"}), {})
