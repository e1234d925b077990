"""A session in its scene, and the content of its panels."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.requests import Ground, Setup, lines
from go1exp.evaluate.viewer.session import PUSH_SHOWN_S, Session
from go1exp.sim.env.camera import ARROW_SCALE, COMMAND_RGB, LEAST_DRAWN, MEASURED_RGB, VELOCITY_TIME, Stage
from go1exp.sim.env.core import Go1Core

VIEWS_PER_S = 25.0  # rate at which the panels get new curves, Hz
PAUSED_S = 0.02  # time between two calls while paused, s
PUSH_RGB, PUSH_SCALE = (1.0, 0.35, 0.2), 0.012  # colour of the arrow of a push; its length per impulse, m / (N s)
FALLBACK = ((-1.5, 2.0), (-1.0, 1.0), (-1.5, 1.5))  # range of the sliders of a run without trained ranges
RANGES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")  # parameters of a command term that are ranges of velocity
CURVE_POINTS = 250  # points of a curve: about one a pixel
SPARK_POINTS = 100  # points of a reward's small curve
Vector = NDArray[np.float64]
Series = list[list[float]]


@dataclass(frozen=True)
class Arrow:
    """An arrow in the scene from ``start`` to ``end``, (3,) m."""

    start: Vector
    end: Vector
    rgb: tuple[float, float, float]


@dataclass(frozen=True)
class Timed:
    """Curves of the last seconds that all windows show."""

    t: list[float]  # times of the curves, 0 for now, s
    height: list[float]  # of the trunk over the ground, m; NaN for a suspended robot
    torque: Series  # twelve, over the limit
    contacts: tuple[tuple[tuple[float, float], ...], ...]  # contact intervals of each leg, s
    pushes: list[float]  # times of pushes, s
    arrows: tuple[Arrow, ...]


@dataclass(frozen=True)
class Reward:
    """A reward term of the last second."""

    name: str  # its key
    mean: float  # per second, weight included
    curve: list[float]  # its last ``history.SPAN`` s, thinned out


@dataclass(frozen=True)
class WalkView(Timed):
    """Content of the panels."""

    label: str
    labels: tuple[str, ...]
    setup: Setup
    grounds: Mapping[str, Ground]
    effects: Mapping[str, str]
    command: ask.Velocity
    limits: tuple[tuple[float, float], ...]
    pace: ask.Pace
    achieved: float  # simulated seconds per second
    time: float  # simulated s
    message: str
    physics_dt: float  # step in force, s
    command_curves: Series
    true: Series
    estimated: Series
    rewards: tuple[Reward, ...]
    total: float  # of all rewards, per second


class WalkShow:
    """A session in its scene."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._effects = lines(session.robots.effects)
        self._core: Go1Core | None = None
        self._speed = np.zeros(2)
        self._clock, self._then, self._achieved = time.perf_counter(), session.time, 1.0
        self._shown = -math.inf
        self._place()

    def _place(self) -> None:
        """Set the robot's pose in the scene; a new ground is a new model."""
        core = self.session.core
        if self._core is not core:
            old, self._core = getattr(self, "_stage", None), core
            if old is None or old.core.terrain.config != core.terrain.config:
                self._stage = Stage(core)
                self.model, self.data = self._stage.model, self._stage.data
            else:
                old.core = core
        if self._stage.place(0):
            self._stage = Stage(core)
            self._stage.place(0)
            self.model, self.data = self._stage.model, self._stage.data

    def ask(self, request: ask.Request) -> None:
        """Apply a request of the user."""
        self.session.ask(request)
        self._place()

    def tick(self) -> float:
        """Simulate one period of the policy, if it is due; return its duration in real time, s."""
        if not self.session.due():
            return PAUSED_S
        self.session.advance()
        self._place()
        s = self.session
        self._speed += (1.0 - math.exp(-s.dt / VELOCITY_TIME)) * (self._stage.data.qvel[:2] - self._speed)
        return s.dt / s.speed

    def view(self) -> WalkView | None:
        """Return the content of the panels, at most ``VIEWS_PER_S`` times a second."""
        now = time.perf_counter()
        if now - self._shown < 1.0 / VIEWS_PER_S:
            return None
        self._shown = now
        s, h = self.session, self.session.history
        every = max(1, math.ceil(h.filled / CURVE_POINTS))
        drawn = ("command", "true", "estimated", "torque", "height")
        curves = {name: h.series(name, every).T.tolist() for name in drawn}
        t = h.times().tolist()
        pushed = h.series("push")[:, 0] > 0.0
        begins = np.flatnonzero(np.diff(pushed, prepend=False) & pushed)
        return WalkView(
            label=s.label,
            labels=tuple(s.robots.agents),
            setup=s.setup,
            grounds=s.robots.grounds,
            effects=self._effects,
            command=s.command,
            limits=self._limits(),
            pace=ask.Pace(s.paused, s.speed),
            achieved=self._pace(now),
            time=s.time,
            message=s.message,
            physics_dt=s.core.task.sim.physics_dt,
            t=h.times(every).tolist(),
            command_curves=curves["command"],
            true=curves["true"],
            estimated=curves["estimated"] if np.isfinite(h.last("estimated", 0.0)).all() else [],
            height=curves["height"][0],
            torque=curves["torque"],
            contacts=tuple(runs_of(t, column, h.dt) for column in h.series("contact").T),
            pushes=[t[k] for k in begins],
            rewards=self._rewards(),
            total=float(np.nan_to_num(h.last("reward", 1.0)).sum(1).mean()) if h.filled else 0.0,
            arrows=self._arrows(),
        )

    def _limits(self) -> tuple[tuple[float, float], ...]:
        given = self.session.trained_for()
        pairs = [given.get(name, default) for name, default in zip(RANGES, FALLBACK, strict=True)]
        return tuple((min(a, 0.0), max(b, 0.0)) for a, b in pairs)

    def _pace(self, now: float) -> float:
        """Return the speed of the simulation over about a second."""
        if now - self._clock >= 1.0:
            self._achieved = (self.session.time - self._then) / (now - self._clock)
            self._clock, self._then = now, self.session.time
        return self._achieved

    def _rewards(self) -> tuple[Reward, ...]:
        h = self.session.history
        if not h.filled:
            return tuple(Reward(name, 0.0, []) for name in self.session.rewards)
        mean = np.nan_to_num(h.last("reward", 1.0)).mean(0)
        every = max(1, round(h.filled / SPARK_POINTS))
        curves = h.series("reward", every).T.tolist()
        return tuple(map(Reward, self.session.rewards, mean.tolist(), curves))

    def _arrows(self) -> tuple[Arrow, ...]:
        """Commanded and true velocity above the robot, as in a clip, and a push."""
        s, start = self.session, self._stage.data.qpos[:3].copy()
        angle = self._stage.heading()
        x, y = s.command[:2]
        wanted = np.array([math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y])
        drawn = [(wanted, 0.28, COMMAND_RGB), (self._speed, 0.23, MEASURED_RGB)]
        arrows = []
        for speed, height, rgb in drawn:
            if np.hypot(*speed) >= LEAST_DRAWN:
                base = start + np.array([0.0, 0.0, height])
                arrows.append(Arrow(base, base + ARROW_SCALE * np.array([*speed, 0.0]), rgb))
        if s.time - s.push.time < PUSH_SHOWN_S:
            arrows.append(push_arrow(start, s.push.impulse, s.push.angle))
        return tuple(arrows)


def push_arrow(at: Vector, impulse: float, angle: float) -> Arrow:
    """Return the arrow of a push on a trunk at ``at``, (3,) m, with a force at ``angle`` in the world, rad."""
    reach = PUSH_SCALE * impulse * np.array([math.cos(angle), math.sin(angle), 0.0])
    return Arrow(at - reach, at, PUSH_RGB)


def runs_of(t: list[float], column: Vector, dt: float) -> tuple[tuple[float, float], ...]:
    """Return the intervals, s, in which a column of zeros and ones is one."""
    on = np.concatenate([[0.0], np.nan_to_num(column), [0.0]]) > 0.5
    edges = np.flatnonzero(on[1:] != on[:-1]).reshape(-1, 2)
    return tuple((t[a] - dt, t[b - 1]) for a, b in edges.tolist())
