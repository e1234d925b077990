"""The simulated robot behind a UDP socket: the Go1's packets in real time, over a simulated network.

Packets are rounded and cut as the robot does (``go1_wire``). Battery and temperatures are constants. Commands carry no
number: they apply in the order of arrival, as far as is known also on the robot.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from go1exp.deploy.runtime import go1_wire
from go1exp.deploy.runtime.loop import Timing, run
from go1exp.deploy.runtime.safety import DEFAULT_KD
from go1exp.deploy.runtime.udp import HOST, arrival, enable_timestamps, listening
from go1exp.deploy.sim_robot import SimConfig
from go1exp.deploy.sim_robot.machine import TICK, Robot
from go1exp.robot.go1_fields import COMMAND_SIZE, LEGS
from go1exp.robot.messages import LowCmd, LowState

TICK_MS = 2
"""Increment per 2 ms of the tick that the simulated robot reports: the unit of SDK 3.8.6's comment."""

MOST_AT_ONCE = 10
"""Largest number of ticks that are made up after a delay; after a longer one the robot's clock stays behind."""

TRUTH = (
    *("base_pos_x_w", "base_pos_y_w", "base_pos_z_w", "base_quat_w", "base_quat_x", "base_quat_y", "base_quat_z"),
    *("base_lin_vel_x_w", "base_lin_vel_y_w", "base_lin_vel_z_w"),
    *("base_ang_vel_x_b", "base_ang_vel_y_b", "base_ang_vel_z_b"),
)
"""Columns of the truth, named as in a recording."""

GONE_S = 1.0
"""Time without a packet after which a client is gone, and another one is accepted, s."""

STRANGER = "another sender"

KEPT_S = 60.0
"""Default time for which truth and applied commands are kept, s."""

ASK_EVERY = 20
"""Cycles between two checks whether to continue."""


class Network:
    """Delays packets by independent times, and loses each with the same probability."""

    def __init__(self, delay: float, loss: float, rng: np.random.Generator, jitter: float = 0.0) -> None:
        """Delay by ``delay`` s and up to ``jitter`` s more, evenly distributed, and lose a share ``loss``."""
        self._delay, self._loss, self._rng, self._jitter = delay, loss, rng, jitter
        self._way: list[tuple[float, int, bytes]] = []
        self._count = 0
        self.lost = 0

    def put(self, now: float, data: bytes) -> None:
        """Send a datagram at ``now``, s."""
        if self._loss and self._rng.random() < self._loss:
            self.lost += 1
            return
        self._count += 1
        further = self._jitter * self._rng.random() if self._jitter else 0.0
        heapq.heappush(self._way, (now + self._delay + further, self._count, data))

    def take(self, now: float) -> list[bytes]:
        """Return the packets that have arrived by ``now``, in the order of arrival."""
        arrived = []
        while self._way and self._way[0][0] <= now + 1e-9:
            arrived.append(heapq.heappop(self._way)[2])
        return arrived


ZERO, SCALE = (100.0, 130.0), (0.5, 1.5)
"""Ranges from which ``sim.feet=raw`` draws zeros (counts; 114 to 125 on one robot) and scales (chosen)."""


class FootSensors:
    """The foot sensors: newtons, or counts, of which each sensor has its own zero and scale.

    Attributes:
        zero: (4,) counts without load.
        scale: (4,) counts per newton.
    """

    def __init__(self, config: SimConfig) -> None:
        rng = np.random.default_rng([config.seed, 2])
        raw = config.feet == "raw"
        self.zero = rng.uniform(*ZERO, LEGS) if raw else np.zeros(LEGS)
        self.scale = rng.uniform(*SCALE, LEGS) if raw else np.ones(LEGS)

    def counts(self, force: np.ndarray) -> np.ndarray:
        """Return the readings under forces (4,), N."""
        return self.zero + self.scale * force


def roll_pitch_yaw(quat: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw, rad, of an attitude w-x-y-z of unit length."""
    w, x, y, z = map(float, quat)
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return np.array([roll, pitch, math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))])


class Packets:
    """Packs states and unpacks commands as the robot does.

    Attributes:
        feet: the foot sensors.
        health: battery and temperatures of the states.
    """

    def __init__(self, config: SimConfig) -> None:
        self.feet, self.health = FootSensors(config), go1_wire.Health()
        self._last_velocity: np.ndarray | None = None

    def read(self, packet: bytes) -> LowCmd | str | None:
        """Return the command of a packet, None if it commands nothing, or the reason of its rejection.

        A commanded joint velocity dq* becomes a torque, kd dq*, that is fed forward.
        """
        command = go1_wire.unpack_command(packet)
        if isinstance(command, go1_wire.Refusal):
            return command.value
        if command.idle:
            return None
        brakes = command.damping
        kp, kd = np.where(brakes, 0.0, command.kp), np.where(brakes, DEFAULT_KD, command.kd)
        torque = np.where(brakes, 0.0, command.tau + command.kd * command.dq)
        only_brakes = not (kp.any() or torque.any())
        return LowCmd(command.q, kp, kd, damping=only_brakes, feedforward=torque if torque.any() else None)

    def written(self, state: LowState, ticks: int) -> bytes:
        """Return the packet of a state, ``ticks`` of 2 ms after the start of the robot."""
        before = state.joint_vel if self._last_velocity is None else self._last_velocity
        self._last_velocity = state.joint_vel
        health = replace(self.health, acceleration=tuple((state.joint_vel - before) / TICK))
        state = replace(state, foot_force=self.feet.counts(state.foot_force))
        return go1_wire.pack_state(state, TICK_MS * ticks, health, roll_pitch_yaw(state.imu_quat))


@dataclass
class Counts:
    """Counts of the robot's packets, and its real-time performance.

    Attributes:
        heard: packets of the client, including those without torque.
        commands: accepted commands.
        foreign: rejected packets: invalid, or of another sender.
        refused: rejected packets by reason.
        states: states sent.
        lost: packets that the simulated network lost.
        slipped: time by which the robot's clock is behind real time, s.
        ticks: simulated ticks of 2 ms.
        timing: of the loop.
    """

    heard: int = 0
    commands: int = 0
    foreign: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    states: int = 0
    lost: int = 0
    slipped: float = 0.0
    ticks: int = 0
    timing: dict[str, Any] = field(default_factory=dict)


class Server:
    """A robot at a port of this machine.

    Its client is the first sender of a valid packet. Other senders are rejected until the client has been silent for
    ``GONE_S``.

    Attributes:
        robot: the simulated one.
        address: where it listens.
        counts: of packets.
        peer: address of the client; None before the first packet.
        truth: newest rows of the trunk's true motion: the robot's clock, s, and ``TRUTH``.
        applied: newest rows of applied commands: clock, s, and whether one applied, its targets, rad, and gains
            (``Robot.applied``).
        packets: packs states and unpacks commands.
        on_heard: called for each packet of ``peer`` with its time of arrival, s on ``time.perf_counter``'s clock.
        on_tick: called after each tick.
    """

    on_heard: Callable[[float, bytes], None] | None = None
    on_tick: Callable[[], None] | None = None

    def __init__(self, robot: Robot, config: SimConfig, port: int = 0, host: str = HOST, kept: float = KEPT_S) -> None:
        """Listen at ``port``, or at any that is free if 0; keep the newest ``kept`` s of truth and commands.

        Raises:
            RobotError: if the port is taken, or the host is not this machine's.
        """
        self.robot, self.packets = robot, Packets(config)
        rng = np.random.default_rng([config.seed, 1])
        self._uplink, self._downlink = (Network(config.delay, config.loss, rng, config.jitter) for _ in range(2))
        self._socket = listening(host, port)
        self._socket.setblocking(False)
        enable_timestamps(self._socket)
        self.address: tuple[str, int] = self._socket.getsockname()
        self.peer: tuple[str, int] | None = None
        self._heard = -math.inf
        self.counts = Counts()
        self.truth, self.applied = (deque[np.ndarray](maxlen=math.ceil(kept / TICK) + 1) for _ in range(2))

    @property
    def port(self) -> int:
        """Where it listens."""
        return self.address[1]

    def serve(self, going: Callable[[], bool], seconds: float | None = None) -> Timing:
        """Run in real time while ``going``; return the timing."""
        begin, calls = math.inf, 0

        def work(now: float) -> bool:
            nonlocal begin, calls
            begin = min(begin, now - TICK * self.counts.ticks) if calls == 0 else begin
            # Ticks that should have been simulated by now, less those that were.
            due = int((now - begin) / TICK) + 1 - self.counts.ticks
            if due > MOST_AT_ONCE:
                # The start is moved, so that the lost time is not made up.
                behind = (due - MOST_AT_ONCE) * TICK
                begin, due = begin + behind, MOST_AT_ONCE
                self.counts.slipped += behind
            for _ in range(due):
                self.tick()
            calls += 1
            return calls % ASK_EVERY != 0 or going()

        timing = run(work, 1.0 / TICK, seconds)
        self.counts.timing = asdict(timing)
        return timing

    def tick(self) -> None:
        """Receive, apply the newest command, simulate one tick, and send the readings of its beginning."""
        robot, now = self.robot, self.robot.clock
        self._listen(now)
        for data in self._uplink.take(now):
            self._apply(data)
        # The newest command acts in this tick; the state that is sent is of its beginning.
        robot.step()
        state, true = robot.sense()
        self.truth.append(np.array([now, *true]))
        self.applied.append(np.array([now, *robot.applied()]))
        data = self.packets.written(state, round(now / TICK))
        if self.peer is not None:
            self._downlink.put(now, data)
            for delayed in self._downlink.take(now):
                self._send(delayed)
        self.counts.ticks += 1
        self.counts.lost = self._uplink.lost + self._downlink.lost
        if self.on_tick is not None:
            self.on_tick()

    def _listen(self, now: float) -> None:
        while True:
            try:
                data, extra, _, sender = self._socket.recvmsg(COMMAND_SIZE + 1, 64)
            except BlockingIOError:
                return
            except ConnectionRefusedError:
                continue  # an earlier state was sent to a port that is closed
            if wrong := go1_wire.refusal(data, COMMAND_SIZE):
                self._refuse(wrong.value)
            elif self.peer not in (None, sender) and now - self._heard < GONE_S:
                self._refuse(STRANGER)
            else:
                self.peer, self._heard = sender, now
                self.counts.heard += 1
                if self.on_heard is not None:
                    self.on_heard(arrival(extra), data)
                self._uplink.put(now, data)

    def _refuse(self, why: str) -> None:
        self.counts.foreign += 1
        self.counts.refused[why] = self.counts.refused.get(why, 0) + 1

    def _apply(self, packet: bytes) -> None:
        command = self.packets.read(packet)
        if isinstance(command, str):
            self._refuse(command)
        elif command is None:
            self.robot.release()
        else:
            self.counts.commands += 1
            self.robot.apply(command)

    def _send(self, data: bytes) -> None:
        assert self.peer is not None
        try:
            self._socket.sendto(data, self.peer)
            self.counts.states += 1
        except (BlockingIOError, ConnectionRefusedError):
            pass

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
