"""The simulated robot of ``go1exp sim`` as something to show: its scene, its curves, and the timing of its client."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from go1exp import robot
from go1exp.deploy.sim_robot.machine import TICK, Body
from go1exp.deploy.sim_robot.server import TRUTH
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.effects import catalogue, lines
from go1exp.evaluate.viewer.history import SPAN, History
from go1exp.evaluate.viewer.session import PUSH_SHOWN_S, PushMade
from go1exp.evaluate.viewer.sim_probe import FORCE, ROW_S, TORQUE, Frame
from go1exp.evaluate.viewer.sim_process import Link
from go1exp.evaluate.viewer.walk import Arrow, Series, push_arrow, runs_of
from go1exp.sim.env.camera import Stage
from go1exp.sim.env.core import Go1Core
from go1exp.sim.terrain import build_terrain

LOOK_S = 1.0 / 30.0
"""Period at which the robot is looked at, s."""

Array = NDArray[np.float64]

WIDTHS = {"height": 1, "velocity": 3, "torque": 12, "contact": 4}
"""Columns of the curves."""

MOST_POINTS = 1000
"""Most intervals that are drawn: of a faster client the longest of each group."""


@dataclass(frozen=True)
class Intervals:
    """Times between packets of the last ``history.SPAN`` s.

    Attributes:
        t: times of arrival, 0 for now, s; thinned out.
        interval: time since the packet before, ms; of each group the longest.
        p50: median of all intervals, ms; NaN without any.
        p99: ms.
        worst: ms.
    """

    t: list[float]
    interval: list[float]
    p50: float
    p99: float
    worst: float


@dataclass(frozen=True)
class Packets:
    """The packets of the one who is listened to.

    Attributes:
        peer: who; None before anybody has spoken.
        speaking: whether that one has been heard in the last second.
        every: of all packets.
        new: of those that say something else than the packet before: the cycles of a client that sends each command
            again until it has the next one.
        rate: packets heard in the last second.
        answers: states sent per second.
        lost: datagrams that the simulated network lost, both ways, so far.
        refused: datagrams by the reason, so far.
    """

    peer: str | None
    speaking: bool
    every: Intervals
    new: Intervals
    rate: int
    answers: float
    lost: int
    refused: dict[str, int]


@dataclass(frozen=True)
class SimView:
    """What the panels draw.

    Attributes:
        t: times of the curves, 0 for now, s.
        height: of the trunk over the ground, m; NaN where it hangs.
        velocity: true forward, left, m/s, and turn, rad/s, in the trunk's frame.
        torque: twelve, over the limit.
        contacts: of each leg, from when to when it bore force, s.
        pushes: times of pushes, s.
        arrows: in the scene.
        packets: of the client.
        time: of the robot, s.
        slipped: time by which it fell behind real time, s.
        posture: what it does, in words.
        effects: names of those that act.
        sizes: theirs, by name.
        known: what each effect is that there is, by name.
        message: for the user.
    """

    t: list[float]
    height: list[float]
    velocity: Series
    torque: Series
    contacts: tuple[tuple[tuple[float, float], ...], ...]
    pushes: list[float]
    arrows: tuple[Arrow, ...]
    packets: Packets
    time: float
    slipped: float
    posture: str
    effects: tuple[str, ...]
    sizes: dict[str, float]
    known: dict[str, str]
    message: str


class SimShow:
    """A robot that somebody else drives.

    Attributes:
        model: the scene.
        data: its state.
    """

    def __init__(self, link: Link, body: Body) -> None:
        """Build the scene of the robot at the other end of ``link``."""
        self._link, self._body = link, body
        self._terrain = build_terrain(body.terrain)
        task = SimpleNamespace(robot=body.robot, sim=SimpleNamespace(physics_dt=TICK), contact=body.contact)
        free = {"qpos": torch.zeros(1, 19, dtype=torch.float64), "qvel": torch.zeros(1, 18, dtype=torch.float64)}
        free["qpos"][0, 3] = 1.0
        self._pose = free["qpos"]
        core = SimpleNamespace(terrain=self._terrain, task=task, backend=SimpleNamespace(**free))
        self._stage = Stage(cast(Go1Core, core))  # reads nothing else of an environment
        self.model, self.data = self._stage.model, self._stage.data
        self._limit = np.maximum(robot.per_joint(body.robot.effort_limit), 1e-9)
        self._history = History(WIDTHS, ROW_S)
        self._packets: deque[tuple[float, float, float]] = deque()
        self._pushes: deque[PushMade] = deque(maxlen=20)
        self._sent: deque[tuple[float, int]] = deque(maxlen=round(1.0 / LOOK_S))
        self._known = lines(catalogue(body.effect, randomize=True)[0])
        self._frame: Frame | None = None
        self._fresh = False

    def ask(self, request: ask.Request) -> None:
        """Do what a user asks for."""
        self._link.send(request)

    def tick(self) -> float:
        """Take in what the robot has sent; return how long a moment is, s."""
        frame = self._link.look()
        if frame is not None:
            self._take(frame)
        return LOOK_S

    def _take(self, frame: Frame) -> None:
        history = self._history
        for _ in range(min(frame.first - history.count, round(SPAN / ROW_S))):
            history.add({})  # rows that the robot did not keep: a gap
        history.count += max(0, frame.first - history.count)
        for row in self._rows(frame.rows.astype(float)):
            history.add(row)
        self._packets.extend(map(tuple, frame.packets.tolist()))
        while self._packets and self._packets[0][0] < frame.now - SPAN:
            self._packets.popleft()
        if frame.push.impulse and (not self._pushes or self._pushes[-1].time != frame.push.time):
            self._pushes.append(frame.push)
        self._sent.append((frame.now, frame.states))
        self._frame, self._fresh = frame, True
        self._pose[0] = torch.from_numpy(frame.qpos)
        if self._stage.place(0):  # other ground around the robot: a new model shows it
            self._stage = Stage(self._stage.core)
            self._stage.place(0)
            self.model, self.data = self._stage.model, self._stage.data

    def _rows(self, rows: Array) -> list[dict[str, Array]]:
        """Return what is drawn of a frame's rows (R, 29)."""
        truth = {name: rows[:, k] for k, name in enumerate(TRUTH)}
        place = np.stack([truth["base_pos_x_w"], truth["base_pos_y_w"]], axis=1)
        below = self._terrain.height_at(np.nan_to_num(place))
        true = np.column_stack([*in_trunk(truth), truth["base_ang_vel_z_b"]])
        torque, contact = np.abs(rows[:, TORQUE]) / self._limit, (rows[:, FORCE] > 0.0).astype(float)
        height = truth["base_pos_z_w"] - below
        together = zip(height, true, torque, contact, strict=True)
        return [dict(zip(WIDTHS, map(np.atleast_1d, row), strict=True)) for row in together]

    def view(self) -> SimView | None:
        """Return what is to be drawn; None if nothing has changed."""
        if self._frame is None or not self._fresh:
            return None
        self._fresh = False
        frame, h = self._frame, self._history
        t = h.times().tolist()
        curves: dict[str, Any] = {name: h.series(name).T for name in WIDTHS}
        pushes = [p for p in self._pushes if frame.clock - p.time < SPAN]
        new = pushes and frame.clock - pushes[-1].time < PUSH_SHOWN_S
        arrows = (push_arrow(self.data.qpos[:3].copy(), pushes[-1].impulse, pushes[-1].angle),) if new else ()
        return SimView(
            t=t,
            height=curves["height"][0].tolist(),
            velocity=curves["velocity"].tolist(),
            torque=curves["torque"].tolist(),
            contacts=tuple(runs_of(t, column, h.dt) for column in curves["contact"]),
            pushes=[p.time - frame.clock for p in pushes],
            arrows=arrows,
            packets=self._timing(frame),
            time=frame.clock,
            slipped=frame.slipped,
            posture=frame.posture,
            effects=tuple(frame.sizes),
            sizes=frame.sizes,
            known=self._known,
            message=frame.message,
        )

    def _timing(self, frame: Frame) -> Packets:
        """Return how the client's packets came."""
        arrived, since, cycle = np.array(self._packets, float).reshape(-1, 3).T
        (begin, before), (end, states) = self._sent[0], self._sent[-1]
        return Packets(
            peer=frame.peer,
            speaking=frame.speaking,
            every=intervals(arrived - frame.now, since),
            new=intervals(arrived - frame.now, cycle),
            rate=int((arrived > frame.now - 1.0).sum()),
            answers=(states - before) / (end - begin) if end > begin else 0.0,
            lost=frame.lost,
            refused=frame.refused,
        )


def intervals(at: Array, since: Array) -> Intervals:
    """Return what is drawn of packets that came at ``at`` (P,), s, ``since`` (P,) s after others; NaNs are left out."""
    known = np.isfinite(since)
    all_ms = 1e3 * since[known]
    p50, p99, worst = np.percentile(all_ms, (50, 99, 100)) if len(all_ms) else (np.nan,) * 3
    t, drawn = longest(at[known], all_ms, MOST_POINTS)
    return Intervals(t.tolist(), drawn.tolist(), float(p50), float(p99), float(worst))


def longest(t: Array, values: Array, most: int) -> tuple[Array, Array]:
    """Return at most ``most`` points (T,) of a curve: of each group of neighbours the one with the largest value."""
    every = -(-len(t) // most)
    if every <= 1:
        return t, values
    starts = range(0, len(t), every)
    chosen = np.array([k + int(np.argmax(values[k : k + every])) for k in starts])
    return t[chosen], values[chosen]


def in_trunk(truth: dict[str, Array]) -> tuple[Array, Array]:
    """Return the trunk's velocity forward and to the left, (R,) each, m/s, of columns of ``server.TRUTH``."""
    w, x, y, z = (truth[f"base_quat_{part}"] for part in "wxyz")
    a, b, c = (truth[f"base_lin_vel_{axis}_w"] for axis in "xyz")
    # The first two columns of the attitude's matrix, times the velocity in the world.
    forward = (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c
    left = 2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c
    return forward, left
