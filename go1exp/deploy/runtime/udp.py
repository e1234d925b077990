"""Link over UDP to a Go1, or to the simulated robot, which exchanges the same packets; delays of packets."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from go1exp.base.errors import REFUSED
from go1exp.deploy.runtime import go1_wire
from go1exp.deploy.runtime.launch import RobotError
from go1exp.robot.go1_fields import PERIOD, ROBOT, ROBOT_PORT, STATE_SIZE
from go1exp.robot.messages import OVERTAKEN_S, LowCmd, LowState

HOST = "127.0.0.1"

MAX_READ = 1024
"""Largest number of datagrams that one call reads: a flood of them delays a cycle but does not stop it."""

REMEMBERED = 64
"""Number of newest ticks that identify duplicates: more than ``OVERTAKEN_S`` holds."""

SIMULATED_TICK_S = 0.001
"""Unit of the tick of the simulated robot, s. On hardware it is measured (``go1_check``)."""

_STAMP = 35
"""SO_TIMESTAMPNS of Linux, for which Python has no name: the kernel stamps datagrams with their time of arrival."""
_TIMESPEC = struct.Struct("@qq")

Ancillary = list[tuple[int, int, bytes]]
"""Ancillary data of ``socket.recvmsg``."""


def parsed_address(text: str | None, default: tuple[str, int] = (ROBOT, ROBOT_PORT)) -> tuple[str, int]:
    """Return host and port of HOST:PORT; ``default`` if None; raise RobotError if it is written otherwise."""
    if text is None:
        return default
    host, colon, port = text.rpartition(":")
    if not (colon and host and port.isascii() and port.isdigit() and int(port) < 2**16):
        raise RobotError(f"address={text}: must be HOST:PORT, such as {default[0]}:{default[1]}", status=REFUSED)
    return host, int(port)


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that is bound to an address; raise RobotError if it cannot be bound."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind((host, port))
    except OSError as error:
        bound.close()
        raise RobotError(f"address = {host}:{port}: {error.strerror or error}", status=REFUSED) from None
    return bound


@dataclass
class Traffic:
    """Counts of the datagrams over a link.

    Attributes:
        received: accepted states.
        sent: commands.
        repeated: commands sent again between two cycles.
        foreign: rejected datagrams.
        refused_because: rejected datagrams by reason.
        overtaken: states of ``received`` that arrived after a newer one.
        late: duplicates, and states that arrived too late for use; they are dropped.
        lost: states missing in the robot's count; dropped late ones count too.
        refused: times that the port at the other end was closed.
    """

    received: int = 0
    sent: int = 0
    repeated: int = 0
    foreign: int = 0
    refused_because: dict[str, int] = field(default_factory=dict)
    overtaken: int = 0
    late: int = 0
    lost: int = 0
    refused: int = 0


class Go1Link:
    """A link to a Go1, or to the simulated robot; no call waits.

    The robot answers to the address from which it receives packets, and the vendor's client sends one every 2 ms.
    So until the first command a packet without any torque is sent (``go1_wire.IDLE``), and between two cycles the
    last command is repeated.

    Attributes:
        traffic: counts of its datagrams.
        tick: of the newest state; None before the first.
        tick_s: unit of the robot's tick, s; NaN if unknown: then states have no clock and lost ones are not counted.
        sent_at: time at which the last command was sent, s; NaN before.
        newest: packet of the last accepted state; empty before the first.
    """

    def __init__(self, host: str, port: int, tick_s: float = math.nan) -> None:
        """Open the socket; nothing is sent yet; raise OSError if the socket cannot be opened."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.connect((host, port))  # the kernel then drops datagrams of other senders
            enable_timestamps(self._socket)
        except OSError:
            self._socket.close()
            raise
        self.traffic, self.tick_s, self.newest = Traffic(), tick_s, b""
        self.tick: int | None = None
        self._first = 0
        self._ticks: deque[int] = deque(maxlen=REMEMBERED)
        self._count, self._clock = 0, math.nan
        self._packet = go1_wire.IDLE
        self._last_sent, self.sent_at = -math.inf, math.nan

    @property
    def health(self) -> go1_wire.Health | None:
        """Battery, temperatures and accelerations of the newest state; None before the first."""
        return go1_wire.unpack_health(self.newest) if self.newest else None

    def receive(self) -> Sequence[LowState]:
        """Return the states that have arrived since the last call, in the order of arrival, without waiting."""
        states = [state for datagram in self._datagrams() if (state := self._accepted(*datagram)) is not None]
        if self.tick is None or self._packet is go1_wire.IDLE:
            self.repeat()
        return states

    def _datagrams(self) -> Iterator[tuple[bytes, Ancillary]]:
        """Yield the datagrams that have arrived since the last call, with the kernel's stamps (``arrival``)."""
        for _ in range(MAX_READ):
            try:
                data, ancillary, _, _ = self._socket.recvmsg(STATE_SIZE + 1, 64)  # a longer one shows by its size
            except (BlockingIOError, InterruptedError):
                return
            except OSError:  # the port at the other end is closed, or the network is down
                self.traffic.refused += 1
                continue
            yield data, ancillary

    def _accepted(self, data: bytes, ancillary: Ancillary) -> LowState | None:
        """Return the state of a datagram; None, and a count, if it is rejected."""
        wrong = go1_wire.state_refusal(data)
        if wrong is not None:
            self.traffic.foreign += 1
            self.traffic.refused_because[wrong.value] = self.traffic.refused_because.get(wrong.value, 0) + 1
            return None
        tick = go1_wire.tick_of(data)
        ahead = None if self.tick is None else go1_wire.newer(tick, self.tick)
        if ahead is not None and ahead <= 0:
            return self._overtaken(data, ancillary, tick, ahead)
        if ahead is None:
            self._first = tick
        # The count goes on where the tick wraps around. It is whole: a sum of seconds drifts by a microsecond in hours,
        # and then no state is found among the robot's applied commands.
        self._count = tick if ahead is None else self._count + ahead
        if ahead is not None and not math.isnan(self._clock):  # not the first since the tick's unit is known
            self.traffic.lost += max(round(ahead * self.tick_s / PERIOD) - 1, 0)
        self._clock = self._count * self.tick_s
        self.traffic.received += 1
        self.tick, self.newest = tick, data
        self._ticks.append(tick)
        return go1_wire.unpack_state(data, arrival(ancillary), self._clock)

    def _overtaken(self, data: bytes, ancillary: Ancillary, tick: int, ahead: int) -> LowState | None:
        """Return a state of ``ahead`` <= 0 ticks after the newest one; None if it is a duplicate, or too late."""
        expected = go1_wire.newer(tick, self._first) > 0 and tick not in self._ticks
        if not (expected and -ahead * self.tick_s <= OVERTAKEN_S + 1e-9):  # NaN too: its age is not known
            self.traffic.late += 1
            return None
        self.traffic.received += 1
        self.traffic.overtaken += 1
        self.traffic.lost -= 1
        self._ticks.append(tick)
        return go1_wire.unpack_state(data, arrival(ancillary), (self._count + ahead) * self.tick_s)

    def _put(self, packet: bytes) -> None:
        """Send a packet; one that cannot be sent counts as lost in the network."""
        try:
            self._socket.send(packet)
        except BlockingIOError:
            pass
        except OSError:  # reports an earlier datagram; a robot that is gone is detected by missing states
            self.traffic.refused += 1

    def send(self, command: LowCmd) -> None:
        """Send a command, without waiting; raise ValueError if a part has another size, or is not finite."""
        self._packet = go1_wire.pack_command(command)
        self.traffic.sent += 1
        self._put(self._packet)
        self._last_sent = self.sent_at = time.perf_counter()

    def repeat(self) -> None:
        """Send the last command again if a period has passed since; before the first, a packet without torque."""
        now = time.perf_counter()
        if now - self._last_sent < 0.9 * PERIOD:
            return
        self._last_sent = now
        self.traffic.repeated += 1
        self._put(self._packet)

    def rehearse(self, command: LowCmd) -> None:
        """Pack a command that is not sent."""
        go1_wire.pack_command(command)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def enable_timestamps(opened: socket.socket) -> None:
    """Enable the kernel's times of arrival; not every system has them."""
    with contextlib.suppress(OSError):
        opened.setsockopt(socket.SOL_SOCKET, _STAMP, 1)


def arrival(ancillary: Ancillary) -> float:
    """Return the time of arrival of a datagram, s on ``time.perf_counter``'s clock; now without a kernel stamp.

    The stamp is by the wall clock, which can be changed meanwhile; ages of more than a second are ignored.
    """
    now = time.perf_counter()
    for level, kind, content in ancillary:
        if level == socket.SOL_SOCKET and kind == _STAMP and len(content) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(content)
            age = time.time() - seconds - 1e-9 * nanoseconds
            return now - age if 0.0 <= age < 1.0 else now
    return now


# ---------------------------------------------------------------------- delays of packets

# The two clocks have different origins, so the latency of the fastest packet is unknown. The delay of another one
# relative to it is: arrival less the robot's clock, less the smallest such difference.

WINDOW_S = 1.0
"""Window of the fastest packet, s: 500 packets, and clocks that differ by 100 ppm drift by 0.1 ms."""

MOST_SLIP = 1e-3
"""Relative difference of the clocks from which it is reported: 1 ms of delay within ``WINDOW_S``."""

SHORTEST_S = 2.0
"""Shortest time over which clocks are compared, s: the tick's resolution is 1 ms."""

FEWEST = 8
"""Smallest number of packets for that."""


class PacketDelay:
    """Delays of packets relative to the fastest of the last ``WINDOW_S``."""

    def __init__(self) -> None:
        # Arrival and offset. Offsets increase, so that the first is the least.
        self._least: deque[tuple[float, float]] = deque()

    def note(self, arrived: float, clock: float) -> float:
        """Add a packet that ``arrived`` by our clock, s, measured at ``clock`` by the robot's; return its delay, s.

        Packets are given in the order of arrival. NaN if the robot reports no clock.
        """
        if math.isnan(clock):
            return math.nan
        offset, least = arrived - clock, self._least
        while least and least[-1][1] >= offset:
            least.pop()
        least.append((arrived, offset))
        while least[0][0] < arrived - WINDOW_S:
            least.popleft()
        return offset - least[0][1]

    def age(self, now: float, clock: float) -> float:
        """Return the age at ``now`` of a state measured at ``clock``, less the latency of the fastest packet, s.

        NaN if the robot reports no clock, or before the first packet.
        """
        return now - clock - self._least[0][1] if self._least else math.nan


def delays(arrived: Iterable[float], clock: Iterable[float]) -> np.ndarray:
    """Return the delays (T,), s, of packets in the order of arrival; arguments as those of ``PacketDelay.note``."""
    packets = PacketDelay()
    return np.array([packets.note(float(t), float(c)) for t, c in zip(arrived, clock, strict=True)])


def slip(arrived: np.ndarray, clock: np.ndarray) -> float | None:
    """Return the relative rate error of the robot's clock, both (T,), s: positive if it runs slow.

    Computed from the fastest packets of the first and of the last quarter, so that variable delays do not count. None
    without a clock, or over less than ``SHORTEST_S``.
    """
    known = np.isfinite(clock)
    arrived, offset = arrived[known], (arrived - clock)[known]
    if len(arrived) < FEWEST or arrived[-1] - arrived[0] < SHORTEST_S:
        return None
    quarter = len(arrived) // 4
    first, last = int(np.argmin(offset[:quarter])), len(arrived) - quarter + int(np.argmin(offset[-quarter:]))
    return float((offset[last] - offset[first]) / (arrived[last] - arrived[first]))


def spread(values: np.ndarray) -> Mapping[str, float] | None:
    """Return median, 99th percentile and largest of times, s, by name; None if none is known."""
    known = values[np.isfinite(values)]
    if not len(known):
        return None
    p50, p99 = np.percentile(known, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "worst": float(known.max())}
