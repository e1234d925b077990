"""A simulated robot that a user commands, pushes and changes: one period of the policy at a time, without a browser."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from go1exp import robot
from go1exp.base.errors import Expected
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.deploy.estimation import EstimatorError
from go1exp.evaluate.agents import Agent, VelocityFilters
from go1exp.evaluate.protocol.plan import Impulses, Kicker, heading
from go1exp.evaluate.rollout import planar_velocity, require_agreement
from go1exp.evaluate.viewer import requests
from go1exp.evaluate.viewer.requests import Ground, Setup, task_under
from go1exp.sim.env.core import Go1Core

Array = NDArray[np.float64]
SPAN = 10.0  # duration of a curve, s


class History:
    """A ring of rows ``dt`` s apart, one for each period of the policy; ``widths`` are columns by quantity."""

    def __init__(self, widths: Mapping[str, int], dt: float) -> None:
        """Keep the last ``SPAN`` s."""
        self.dt, self.count = dt, 0
        self._rows = max(2, round(SPAN / dt))
        self._values = {name: np.full((self._rows, width), np.nan) for name, width in widths.items()}

    def add(self, quantities: Mapping[str, NDArray[np.floating]]) -> None:
        """Add a row; missing quantities are not drawn there."""
        for name, kept in self._values.items():
            kept[self.count % self._rows] = quantities.get(name, np.nan)
        self.count += 1

    @property
    def filled(self) -> int:
        """Number of kept rows."""
        return min(self.count, self._rows)

    def _indices(self, every: int) -> NDArray[np.int64]:
        """Numbers of the kept rows, oldest first: whole multiples of ``every``, so that a curve does not flicker."""
        first = self.count - self.filled
        return np.arange(-(-first // every) * every, self.count, every)

    def times(self, every: int = 1) -> Array:
        """Return the time of each row, oldest first: 0 for the newest, s."""
        return np.asarray((self._indices(every) - (self.count - 1)) * self.dt, dtype=np.float64)

    def series(self, name: str, every: int = 1) -> Array:
        """Return a quantity's rows (T, W), oldest first; every n-th of them for ``every`` = n."""
        return np.asarray(self._values[name][self._indices(every) % self._rows])

    def last(self, name: str, seconds: float) -> Array:
        """Return the rows (T, W) of the last ``seconds`` s."""
        return self.series(name)[-max(1, round(seconds / self.dt)) :]


PUSH_S = 0.1  # duration of a push, s
PUSH_SHOWN_S = 0.6  # time for which its arrow is shown, s
Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Robots:
    """Selectable policies, grounds and effects."""

    agents: Mapping[str, Callable[[], Agent]]  # label -> loader of the policy, bundle or controller
    grounds: Mapping[str, Ground]
    effects: Mapping[str, Term]


@dataclass(frozen=True)
class PushMade:
    """A push, for its arrow."""

    time: float  # at which it began, s
    impulse: float  # N s
    angle: float  # of the force in the world, rad


class Session:
    """One simulated robot that the policy ``label`` drives, at ``speed`` simulated s per s, since ``time`` simulated s.

    A request (``ask``) is checked before anything changes: an invalid one is rejected in ``message``, one line.
    """

    def __init__(self, robots: Robots, label: str, setup: Setup, velocity: requests.Velocity) -> None:
        """Build the robot and reset it to the start; raise ConfigError if the policy is incompatible with ``setup``."""
        self.robots, self.command = robots, velocity
        self._loaded: dict[str, Agent] = {}
        self.paused, self.speed, self.time, self.falls = False, 1.0, 0.0, 0
        self.history = History({}, math.inf)  # the curves
        self.rewards: tuple[str, ...] = ()
        self.message, self.push = "", PushMade(-math.inf, 0.0, 0.0)
        self._since, self._single = 0.0, False
        self._build(label, setup)
        self._begin()

    def _agent(self, label: str) -> Agent:
        if label not in self.robots.agents:
            raise ConfigError([f"policy {label!r}: known are {', '.join(self.robots.agents)}"])
        if label not in self._loaded:
            self._loaded[label] = self.robots.agents[label]()
        return self._loaded[label]

    def _build(self, label: str, setup: Setup) -> None:
        """Build another policy or setup; nothing changes unless all of it can be built, else raise ConfigError."""
        agent = self._agent(label)
        if problems := agent.problems(setup.trunk_velocity, "trunk_velocity"):
            raise ConfigError(problems)
        task = task_under(agent.task, setup, self.robots.grounds, self.robots.effects)
        require_agreement(task)
        core = Go1Core(task, 1, setup.seed, noise=setup.noise, imu=True)
        policy = agent.begin(core, setup.trunk_velocity, setup.seed)
        self._kicker = Kicker(core.backend, task.sim.physics_dt, one_push(math.nan, 0.0, 0.0))
        try:
            self._estimate: VelocityFilters | None = VelocityFilters(core, core.noise, setup.seed)
        except EstimatorError:
            self._estimate = None
        self.core, self._policy, self.label, self.setup = core, policy, label, setup
        self._limit = np.maximum(robot.per_joint(task.robot.effort_limit), 1e-9)
        names = tuple(t.key for t in core.terms.rewards)
        widths = {"command": 3, "true": 3, "estimated": 3, "height": 1, "torque": 12, "contact": 4, "push": 1}
        widths["reward"] = len(names)
        if (self.rewards, self.history.dt) != (names, self.dt):
            self.history = History(widths, self.dt)
        self.rewards = names

    def _begin(self) -> None:
        core, setup = self.core, self.setup
        ground = self.robots.grounds[setup.ground]
        self._aim()
        core.reset()
        if ground.tiles:
            core.level.fill_(round(min(max(setup.level, 0.0), ground.hardest)))
            if setup.tile in core.terrain.tile_types:
                core.tile_column.fill_(core.terrain.tile_types.index(setup.tile))
        self._observation = core.reset()
        self._fresh()

    def _aim(self) -> None:
        self.core.command.value[:] = self.core.command.value.new_tensor(self.command)

    def _fresh(self) -> None:
        self._since = 0.0
        if self._estimate is not None:
            self._estimate.restart(0)

    def _hand_over(self, old: Go1Core) -> None:
        """Continue from pose, velocity and target of the robot of ``old``; actuator and effects are reset.

        The first observation of the policy comes from holding the last target for one period.
        """
        core, everyone = self.core, torch.ones(1, dtype=torch.bool)
        core.level.copy_(old.level)
        core.tile_column.copy_(old.tile_column)
        core.reset()
        core.spawn.copy_(old.spawn)
        core.backend.reset(everyone, old.backend.qpos.clone(), old.backend.qvel.clone())
        core.target.copy_(old.target)
        core.plant.reset(everyone, old.target.to(core.backend.qpos.dtype))
        action = core.task.action
        nominal = torch.as_tensor(robot.NOMINAL_STANCE, dtype=torch.float32)
        held = ((old.target - nominal) / action.scale).clamp(-action.clip, action.clip)
        core.action.copy_(held)  # it is no change
        self._observation = core.step(held).observation
        if self._estimate is not None:
            self._estimate.restart(0)

    def ask(self, request: requests.Request) -> None:
        """Apply a request, or give the reason of its rejection in ``message``."""
        try:
            self._fulfil(request)
        except (ConfigError, Expected) as error:
            self.message = " ".join(str(error).split())

    def _fulfil(self, request: requests.Request) -> None:
        match request:
            case requests.Command(velocity):
                self.command = velocity
            case requests.Push(impulse, direction):
                self._push(impulse, direction)
            case requests.Pace(paused, speed):
                self.paused, self.speed = paused, speed
            case requests.Step():
                self._single = True
            case requests.Reset():
                self._begin()
                self.message = ""
            case requests.SelectPolicy(label):
                self._exchange(label, self.setup)
            case requests.SetEffects(sizes):
                self._exchange(self.label, dataclasses.replace(self.setup, sizes=dict(sizes)))
            case requests.Conditions():
                self._exchange(self.label, dataclasses.replace(self.setup, **dataclasses.asdict(request)))
            case requests.SelectGround(ground, level, tile):
                self._build(self.label, dataclasses.replace(self.setup, ground=ground, level=level, tile=tile))
                self._begin()
                self.message = ""

    def _exchange(self, label: str, setup: Setup) -> None:
        old = self.core
        self._build(label, setup)
        self._aim()
        self._hand_over(old)
        self.message = ""

    def _push(self, impulse: float, direction: float) -> None:
        self._kicker.use(one_push(self._kicker.time, impulse, direction))
        angle = float(heading(self.core.backend.qpos[:, 3:7])[0]) + direction
        self.push = PushMade(self.time, impulse, angle)

    @property
    def dt(self) -> float:
        """Period of the policy, s."""
        return self.core.task.sim.policy_dt

    def due(self) -> bool:
        """Return whether a period is due: the simulation runs, or a single step was requested."""
        return not self.paused or self._single

    def advance(self) -> None:
        """Simulate one period of the policy; raise NumericalFault when a value is not finite."""
        self._single, core = False, self.core
        self._aim()
        result = core.step(self._policy(self._observation))
        core.check(result)
        self._observation = result.observation
        self.time += self.dt
        self._since += self.dt
        why = core.episode_end(result, 0)
        if why is not None:
            self.falls += bool(result.terminated[0])
            self.message = f"{self.time:.1f} s: {why} after {self._since:.1f} s; reset"
            self._fresh()
        self._remember()

    def _remember(self) -> None:
        s, core = self.core.snapshot(), self.core
        below = core.ground_height(s.base_pos_w[:, :2])
        reward = np.array([float(v[0]) for v in core.reward_terms().values()]) / self.dt
        row: dict[str, Vector] = {
            "command": np.array(self.command),
            "true": planar_velocity(core)[0].numpy(),
            "height": (s.base_pos_w[:, 2] - below).double().numpy(),
            "torque": s.joint_torque[0].abs().double().numpy() / self._limit,
            "contact": s.foot_contact[0].double().numpy(),
            "push": np.array([self.push.impulse if self.time - self.push.time < PUSH_S + self.dt else 0.0]),
            "reward": reward,
        }
        if self._estimate is not None:
            gyro = core.plant.sense(s).base_ang_vel_b if core.plant.effects.senses else s.base_ang_vel_b
            row["estimated"] = np.array([*self._estimate.velocities()[0, :2], float(gyro[0, 2])])
        self.history.add(row)

    def trained_for(self) -> dict[str, tuple[float, float]]:
        """Return the trained ranges of velocity by the names of the command's parameters."""
        parameters = self._agent(self.label).task.command.parameters
        return {name: tuple(v) for name, v in parameters.items() if isinstance(v, tuple | list) and len(v) == 2}


def one_push(start: float, impulse: float, direction: float) -> Impulses:
    """Return one push on one robot; none for a start of NaN."""
    begins, size, angle = (np.full((1, 1), v) for v in (start, impulse, direction))
    return Impulses(begins, size, angle, duration=PUSH_S)
