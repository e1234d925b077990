"""What the page of ``go1exp sim`` sees of the simulated robot and asks of it; lives in the robot's own process.

It answers when it is asked and never waits, so that the page cannot hold up the robot.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from go1exp import robot
from go1exp.protocol.disturbances import Kicker, heading
from go1exp.sim_robot.alone import Account
from go1exp.sim_robot.machine import TICK
from go1exp.sim_robot.server import GONE_S, Server
from go1exp.viewer import requests as ask
from go1exp.viewer.session import PushMade, one_push

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
        packets: (P, 2) of each packet of the one who is listened to: arrival, s, and time since that before, s; NaN for
            the first of a speaker.
        peer: who is listened to; None before anybody has spoken.
        speaking: whether that one has been heard in the last second.
        states: sent so far.
        lost: datagrams that the simulated network lost so far.
        refused: datagrams by the reason, so far.
        slipped: time by which the robot's clock fell behind for good, s.
        posture: what the robot does, in words.
        push: the last one, by the robot's clock.
        message: for the user.
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


class Probe:
    """Collects frames of a server's robot, and pushes it or puts it back when asked.

    Attributes:
        server: whose robot it is.
    """

    def __init__(self, server: Server) -> None:
        """Begin to listen to the server."""
        self.server = server
        kept = round(KEPT_S / ROW_S)
        self._rows: deque[NDArray[np.float32]] = deque(maxlen=kept)
        self._packets: deque[tuple[float, float]] = deque(maxlen=round(KEPT_S / TICK))
        self._count, self._peer, self._heard = 0, server.peer, math.nan
        self._message, self._push = "", PushMade(-math.inf, 0.0, 0.0)
        self._account = Account(server, lambda line: None)
        engine = server.robot.backend
        floats = engine.qpos.shape[1] > robot.NUM_JOINTS
        self._kicker = Kicker(engine, TICK, one_push(math.nan, 0.0, 0.0)) if floats else None
        server.on_heard, server.on_tick = self._hear, self._tick

    def _hear(self, arrived: float) -> None:
        since = arrived - self._heard
        if self.server.peer != self._peer or since > GONE_S:
            since = math.nan
        self._packets.append((arrived, since))
        self._peer, self._heard = self.server.peer, arrived

    def _tick(self) -> None:
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
        packets = np.array(self._packets, float).reshape(-1, 2)
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
        )

    def fulfil(self, requests: Iterable[ask.Request]) -> None:
        """Push the robot or put it back; other requests are the client's affair and ignored."""
        for request in requests:
            match request:
                case ask.Push(impulse, direction):
                    self._pushed(impulse, direction)
                case ask.Reset():
                    self.server.robot.restart()
                    self._message = ""

    def _pushed(self, impulse: float, direction: float) -> None:
        if self._kicker is None:
            self._message = HANGS
            return
        self._kicker.use(one_push(self._kicker.time, impulse, direction))
        angle = float(heading(self.server.robot.backend.qpos[:, 3:7])[0]) + direction
        self._push = PushMade(self.server.robot.clock, impulse, angle)
