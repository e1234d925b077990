"""The robot of ``go1exp sim viewer=web``: a process of its own, which the page observes without delaying it."""

from __future__ import annotations

import math
import multiprocessing
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from queue import SimpleQueue

import numpy as np
from numpy.typing import NDArray

from go1exp import robot
from go1exp.base.errors import REFUSED, Expected
from go1exp.base.signals import ending
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.sim_robot import SimConfig
from go1exp.deploy.sim_robot.alone import Say, posture
from go1exp.deploy.sim_robot.machine import TICK, Body, Robot
from go1exp.deploy.sim_robot.server import GONE_S, Server
from go1exp.evaluate.protocol.plan import Kicker, heading
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.requests import active, catalogue
from go1exp.evaluate.viewer.session import PushMade, one_push

Array = NDArray[np.float64]
EVERY = 5  # ticks from row to row
ROW_S = EVERY * TICK
KEPT_S = 2.0  # time that is kept for a page that does not ask, s; older rows are a gap in its curves

TRUTH, TORQUE, FORCE = slice(0, 13), slice(13, 25), slice(25, 29)
"""Columns of a row: the trunk's truth (``server.TRUTH``), torques, N m, and forces under the feet, N."""

SUSPENDED = "the robot is suspended: its trunk cannot be pushed"

SWITCH_S = 1e-4
"""Thread switch interval of the robot's process, s: building another robot must not delay its ticks of 2 ms."""

Built = tuple[Robot, dict[str, float]] | str
"""A robot with the sizes of its effects, or the reason why it cannot be built."""

ENDS_S = 5.0  # time that the robot's process is given to end, s


@dataclass(frozen=True)
class Frame:
    """State of the robot, and everything that has happened since the frame before."""

    now: float  # s on the clock of ``time.perf_counter``
    clock: float  # of the robot, s
    qpos: Array  # (19,) position, attitude and joint angles
    first: int  # number of the first row, counted since the start of the robot
    rows: NDArray[np.float32]  # (R, 29) in the columns above, ``ROW_S`` apart
    # (P, 3) of the client's packets: arrival, s; time since the packet before, s, NaN for a client's first one; time
    # between new commands, s, NaN for a packet that repeats the one before
    packets: Array
    peer: str | None  # address of the client; None before the first packet
    connected: bool  # whether a packet of the client has arrived in the last second
    states: int
    lost: int
    refused: dict[str, int]
    slipped: float  # time by which the robot's clock is behind real time, s
    posture: str
    push: PushMade  # the last one, by the robot's clock
    message: str
    sizes: dict[str, float]  # of the active effects, by name


class Probe:
    """Collects frames of a server's robot; pushes, resets and exchanges the robot on request."""

    def __init__(self, server: Server, body: Body, config: SimConfig) -> None:
        """Observe ``server``, whose robot was built from ``body`` and ``config``."""
        self.server, self._body, self._config = server, body, config
        self._effects, self._sizes = catalogue(body.effect, randomize=True)
        self._built: SimpleQueue[Built] = SimpleQueue()
        self._rows: deque[NDArray[np.float32]] = deque(maxlen=round(KEPT_S / ROW_S))
        self._packets: deque[tuple[float, float, float]] = deque(maxlen=round(KEPT_S / TICK))
        self._count, self._peer, self._heard = 0, server.peer, math.nan
        self._newest, self._changed = b"", math.nan  # the newest packet, and its first arrival
        self._message, self._push = "", PushMade(-math.inf, 0.0, 0.0)
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
        if not self._built.empty():
            self._exchange(self._built.get())
        if self.server.counts.ticks % EVERY:
            return
        now = self.server.robot.readings
        parts = (self.server.robot.truth, now["tau_est"], now["foot_force"])
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
            connected=now - self._heard < GONE_S,
            states=counts.states,
            lost=counts.lost,
            refused=dict(counts.refused),
            slipped=counts.slipped,
            posture=posture(server.robot),
            push=self._push,
            message=self._message,
            sizes={name: size for name, size in self._sizes.items() if size > 0.0},
        )

    def fulfil(self, requests: Iterable[ask.Request]) -> None:
        """Push the robot, reset it or change its effects; other requests concern the client and are ignored."""
        for request in requests:
            match request:
                case ask.Push(impulse, direction):
                    self._push_robot(impulse, direction)
                case ask.Reset():
                    self.server.robot.restart()
                    self._message = ""
                case ask.SetEffects(sizes):
                    self._begin_exchange(dict(sizes))

    def _push_robot(self, impulse: float, direction: float) -> None:
        if self._kicker is None:
            self._message = SUSPENDED
            return
        self._kicker.use(one_push(self._kicker.time, impulse, direction))
        angle = float(heading(self.server.robot.backend.qpos[:, 3:7])[0]) + direction
        self._push = PushMade(self.server.robot.clock, impulse, angle)

    def _begin_exchange(self, sizes: dict[str, float]) -> None:
        """Build a robot with other effects in a thread; it takes over when it is ready."""
        try:
            effect = active(sizes, self._effects, self._body.actuator, self._body.contact)
        except ConfigError as error:
            self._message = " ".join(str(error).split())
            return
        self._message = "another robot is being built ..."
        self._built = SimpleQueue()  # one that is being built for an earlier request is dropped
        arguments = (replace(self._body, effect=effect), sizes, self._built)
        threading.Thread(target=self._build, args=arguments, daemon=True).start()

    def _build(self, body: Body, sizes: dict[str, float], built: SimpleQueue[Built]) -> None:
        """Build a robot in a thread, since that takes tens of ticks; if it cannot be built, give the reason."""
        try:
            built.put((Robot(body, self._config), sizes))
        except (ConfigError, Expected) as error:
            built.put(" ".join(str(error).split()))

    def _exchange(self, built: Built) -> None:
        """Let the new robot continue from the state of the present one, between two ticks."""
        if isinstance(built, str):
            self._message = built
            return
        new, self._sizes = built
        new.take_over(self.server.robot)
        self.server.robot, self._kicker, self._message = new, _kicker(new), ""


def _kicker(made: Robot) -> Kicker | None:
    floats = made.backend.qpos.shape[1] > robot.NUM_JOINTS
    return Kicker(made.backend, TICK, one_push(math.nan, 0.0, 0.0)) if floats else None


class RobotProcess:
    """A robot in another process, which listens for its client at ``address``, host and port."""

    def __init__(
        self,
        groups: Mapping[str, object],
        tile: tuple[int, int],
        config: SimConfig,
        address: tuple[str, int],
        seconds: float | None,
        say: Say,
    ) -> None:
        """Start it and wait until it listens.

        ``groups`` are those of ``machine.Body`` as plain data, ``tile`` is the row and column where it begins, and
        ``seconds`` how long it runs, None until it is closed. ``say`` prints a line in the other process: an importable
        function. Raise ConfigError if its settings or ``address`` are refused, and Expected if it ends before it
        listens.
        """
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        given = (other, dict(groups), tile, config, address, seconds, say)
        self._process = context.Process(target=_run, args=given, daemon=True)
        before = {number: signal.signal(number, signal.SIG_IGN) for number in ending()}
        try:
            self._process.start()  # it inherits that it ignores them: Ctrl-C ends the page, which then ends it
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        other.close()
        try:
            answer = self._pipe.recv()
        except EOFError:
            answer = Expected("the simulated robot's process ended before it listened")
        if isinstance(answer, Exception):
            self.close()
            raise answer
        self.address: tuple[str, int] = answer
        self._requests: list[ask.Request] = []
        self._waiting = False

    def send(self, request: ask.Request) -> None:
        """Send a request with the next look."""
        self._requests.append(request)

    def look(self) -> Frame | None:
        """Return the next frame if it has come, and ask for another; raise ``requests.Ended`` after the last one."""
        try:
            frame: Frame | None = None
            if self._waiting and self._pipe.poll():
                frame, self._waiting = self._pipe.recv(), False
            if not self._waiting:
                self._pipe.send(tuple(self._requests))
                self._requests, self._waiting = [], True
        except (EOFError, OSError):
            raise ask.Ended from None
        return frame

    def close(self) -> None:
        """End it."""
        self._pipe.close()
        self._process.join(ENDS_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _run(
    pipe: Connection,
    groups: dict[str, object],
    tile: tuple[int, int],
    config: SimConfig,
    address: tuple[str, int],
    seconds: float | None,
    say: Say,
) -> None:
    """Run the robot until the page's end of the pipe is closed."""
    import torch

    from go1exp.deploy.sim_robot.alone import serve
    from go1exp.sim.task import required_parts

    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH_S)
    try:
        body = Body(**required_parts(groups), tile=tile)
        server = Server(Robot(body, config), config, address[1], address[0])
    except ConfigError as error:
        pipe.send(ConfigError(error.problems))
        return
    except Expected as error:
        pipe.send(ConfigError([str(error)]) if error.status == REFUSED else Expected(str(error)))
        return
    pipe.send(server.address)
    answering = Answering(Probe(server, body, config), pipe)
    try:
        serve(server, lambda: answering.going, say, seconds)
    finally:
        server.close()


class Answering:
    """Answers the page between two ticks; never waits."""

    def __init__(self, probe: Probe, pipe: Connection) -> None:
        self.going, self._probe, self._pipe = True, probe, pipe
        self._before, probe.server.on_tick = probe.server.on_tick, self._tick

    def _tick(self) -> None:
        if self._before is not None:
            self._before()
        if not self.going or self._probe.server.counts.ticks % EVERY:
            return
        try:
            if self._pipe.poll():
                self._probe.fulfil(self._pipe.recv())
                self._pipe.send(self._probe.frame())
        except (EOFError, OSError):
            self.going = False
