"""What the page of ``go1exp sim`` sees of the simulated robot and asks of it; lives in the robot's own process.

It answers when it is asked and never waits, so that the page cannot hold up the robot.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from go1exp import robot
from go1exp.base.errors import Expected
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.sim_robot.alone import Account
from go1exp.deploy.sim_robot.machine import TICK, Body, Robot
from go1exp.deploy.sim_robot.server import GONE_S, Server
from go1exp.deploy.sim_robot.settings import SimConfig
from go1exp.evaluate.protocol.plan import Kicker, heading
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.effects import acting, catalogue
from go1exp.evaluate.viewer.session import PushMade, one_push

Array = NDArray[np.float64]

EVERY = 5
"""Ticks from row to row."""

ROW_S = EVERY * TICK

KEPT_S = 2.0
"""How much is kept for a page that does not ask, s; older rows are a gap in its curves."""

TRUTH, TORQUE, FORCE = slice(0, 13), slice(13, 25), slice(25, 29)
"""Columns of a row: the trunk's truth (``server.TRUTH``), torques, N m, and forces under the feet, N."""

HANGS = "the robot hangs: its trunk cannot be pushed"


@dataclass(frozen=True)
class Frame:
    """What has happened since the frame before.

    Attributes:
        now: s on the clock of ``time.perf_counter``.
        clock: of the robot, s.
        qpos: (19,) position, attitude and joint angles.
        first: number of the first row, counted since the robot began.
        rows: (R, 29) in the columns above, ``ROW_S`` apart.
        packets: (P, 3) of each packet of the one who is listened to: arrival, s; time since that before, s, NaN for the
            first of a speaker; time from new packet to new packet, s, NaN for one that repeats the packet before.
        peer: who is listened to; None before anybody has spoken.
        speaking: whether that one has been heard in the last second.
        states: sent so far.
        lost: datagrams that the simulated network lost so far.
        refused: datagrams by the reason, so far.
        slipped: time by which the robot's clock fell behind for good, s.
        posture: what the robot does, in words.
        push: the last one, by the robot's clock.
        message: for the user.
        sizes: of the effects that act, by name.
    """

    now: float
    clock: float
    qpos: Array
    first: int
    rows: NDArray[np.float32]
    packets: Array
    peer: str | None
    speaking: bool
    states: int
    lost: int
    refused: dict[str, int]
    slipped: float
    posture: str
    push: PushMade
    message: str
    sizes: dict[str, float]


class Probe:
    """Collects frames of a server's robot, and pushes it or puts it back when asked.

    Attributes:
        server: whose robot it is.
    """

    def __init__(self, server: Server, body: Body, config: SimConfig) -> None:
        """Begin to listen to the server.

        Args:
            server: whose robot it is.
            body: what its robot is made of.
            config: how it is set up.
        """
        self.server, self._body, self._config = server, body, config
        self._effects, self._sizes = catalogue(body.effect, randomize=True)
        self._builder: _Builder | None = None
        kept = round(KEPT_S / ROW_S)
        self._rows: deque[NDArray[np.float32]] = deque(maxlen=kept)
        self._packets: deque[tuple[float, float, float]] = deque(maxlen=round(KEPT_S / TICK))
        self._count, self._peer, self._heard = 0, server.peer, math.nan
        self._newest, self._changed = b"", math.nan  # the newest packet, and when it first came
        self._message, self._push = "", PushMade(-math.inf, 0.0, 0.0)
        self._account = Account(server, lambda line: None)
        self._kicker = _kicker(server.robot)
        server.on_heard, server.on_tick = self._hear, self._tick

    def _hear(self, arrived: float, packet: bytes) -> None:
        since = arrived - self._heard
        if self.server.peer != self._peer or since > GONE_S:
            since, self._changed, self._newest = math.nan, math.nan, b""
        cycle = math.nan
        if packet != self._newest:
            cycle, self._changed, self._newest = arrived - self._changed, arrived, packet
        self._packets.append((arrived, since, cycle))
        self._peer, self._heard = self.server.peer, arrived

    def _tick(self) -> None:
        if self._builder is not None and self._builder.ready.is_set():
            self._exchange(self._builder)
            self._builder = None
        if self.server.counts.ticks % EVERY:
            return
        now = self.server.robot.readings
        parts = (self.server.robot.sense_truth(), now["tau_est"], now["foot_force"])
        self._rows.append(np.concatenate(parts).astype(np.float32))
        self._count += 1

    def frame(self) -> Frame:
        """Return what has happened since the call before."""
        server, counts, now = self.server, self.server.counts, time.perf_counter()
        rows = np.array(self._rows, np.float32).reshape(-1, FORCE.stop)
        packets = np.array(self._packets, float).reshape(-1, 3)
        self._rows.clear()
        self._packets.clear()
        return Frame(
            now=now,
            clock=server.robot.clock,
            qpos=server.robot.pose(),
            first=self._count - len(rows),
            rows=rows,
            packets=packets,
            peer=None if server.peer is None else "{}:{}".format(*server.peer),
            speaking=now - self._heard < GONE_S,
            states=counts.states,
            lost=counts.lost,
            refused=dict(counts.refused),
            slipped=counts.slipped,
            posture=self._account.posture(),
            push=self._push,
            message=self._message,
            sizes={name: size for name, size in self._sizes.items() if size > 0.0},
        )

    def fulfil(self, requests: Iterable[ask.Request]) -> None:
        """Push the robot, put it back or change its effects; other requests are the client's affair and ignored."""
        for request in requests:
            match request:
                case ask.Push(impulse, direction):
                    self._pushed(impulse, direction)
                case ask.Reset():
                    self.server.robot.restart()
                    self._message = ""
                case ask.Effects(sizes):
                    self._begin_exchange(dict(sizes))

    def _pushed(self, impulse: float, direction: float) -> None:
        if self._kicker is None:
            self._message = HANGS
            return
        self._kicker.use(one_push(self._kicker.time, impulse, direction))
        angle = float(heading(self.server.robot.backend.qpos[:, 3:7])[0]) + direction
        self._push = PushMade(self.server.robot.clock, impulse, angle)

    def _begin_exchange(self, sizes: dict[str, float]) -> None:
        """Build a robot with other effects beside the one that walks; it takes over when it is ready."""
        try:
            effect = acting(sizes, self._effects, self._body.actuator, self._body.contact)
        except ConfigError as error:
            self._message = " ".join(str(error).split())
            return
        self._message = "another robot is being built ..."
        self._builder = _Builder(replace(self._body, effect=effect), self._config, sizes)

    def _exchange(self, built: _Builder) -> None:
        """Let a robot that is ready go on from where the present one is, between two ticks."""
        if built.robot is None:
            self._message = built.problem
            return
        built.robot.take_over(self.server.robot)
        self.server.robot, self._kicker = built.robot, _kicker(built.robot)
        self._sizes, self._message = built.sizes, ""


class _Builder:
    """Builds a robot in a thread, since that takes tens of ticks.

    Attributes:
        robot: that was built; None where it cannot be.
        problem: why it cannot.
        sizes: of its effects.
        ready: set when it is known.
    """

    def __init__(self, body: Body, config: SimConfig, sizes: dict[str, float]) -> None:
        """Begin."""
        self.robot: Robot | None = None
        self.problem, self.sizes, self.ready = "", sizes, threading.Event()
        threading.Thread(target=self._build, args=(body, config), daemon=True).start()

    def _build(self, body: Body, config: SimConfig) -> None:
        try:
            self.robot = Robot(body, config)
        except (ConfigError, Expected) as error:
            self.problem = " ".join(str(error).split())
        finally:
            self.ready.set()


def _kicker(made: Robot) -> Kicker | None:
    """Return what pushes a robot; None for one that hangs."""
    engine = made.backend
    floats = engine.qpos.shape[1] > robot.NUM_JOINTS
    return Kicker(engine, TICK, one_push(math.nan, 0.0, 0.0)) if floats else None
