"""Links over UDP: to a robot that speaks the Go1's protocol, and to a simulated one that speaks the exact one."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from go1exp.deploy.runtime import go1_wire, wire
from go1exp.robot.messages import OVERTAKEN_S, LowCmd, LowState

HOST = "127.0.0.1"
AT_ONCE = 1024
"""Most datagrams that one call reads: a flood of them delays a cycle but does not stop it."""

KNOWN = 64
"""Newest ticks that are remembered, so that no state is taken twice: more than ``OVERTAKEN_S`` holds."""

GREETING_S = 0.1
"""Period at which a hello is sent until the robot answers, s: a hello can be lost."""

SIMULATED_TICK_S = 0.001
"""Unit of the tick of the simulated robot, s. On hardware it is measured (``go1_check``)."""

_STAMP = 35
"""SO_TIMESTAMPNS of Linux, for which Python has no name: the kernel stamps datagrams with their time of arrival."""
_TIMESPEC = struct.Struct("@qq")


@dataclass
class Traffic:
    """Counts of the datagrams over a link.

    Attributes:
        received: states that were accepted.
        sent: commands.
        repeated: commands that were sent again between two cycles.
        foreign: datagrams that were not a state of this version.
        refused_because: these by their reason, where the protocol tells.
        overtaken: states of ``received`` that came after a newer one (of the Go1's protocol, where the tick is known).
        late: states received twice, or too late to be of use; they are left out.
        lost: states missing in the robot's count (one that came too late counts here too).
        refused: times that the port at the other end was closed.
        complete: whether all of this is counted; else only what was received and sent is known.
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
    complete: bool = True

    def counts(self) -> dict[str, Any]:
        """Return what is known, by name."""
        every = {name: value for name, value in vars(self).items() if name != "complete"}
        return every if self.complete else {name: every[name] for name in ("received", "sent")}


class Datagrams:
    """A socket to one address, which the kernel keeps all other senders from; no call waits.

    Attributes:
        traffic: counts; it counts only closed ports itself.
    """

    def __init__(self, port: int, host: str, size: int) -> None:
        """Open it for datagrams of ``size`` bytes.

        Raises:
            OSError: if the socket cannot be opened.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.connect((host, port))  # the kernel then drops datagrams of other senders
            ask_for_stamps(self._socket)
        except OSError:
            self._socket.close()
            raise
        self._room = size + 1  # a longer one shows by its size
        self.traffic = Traffic()

    def arrived(self) -> Iterator[tuple[bytes, list[tuple[int, int, bytes]]]]:
        """Yield what has come since the last call, with what the kernel says of it (``arrival``)."""
        for _ in range(AT_ONCE):
            try:
                data, extra, _, _ = self._socket.recvmsg(self._room, 64)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:  # the port at the other end is closed, or the network is down
                self.traffic.refused += 1
                continue
            yield data, extra

    def put(self, data: bytes) -> None:
        """Send a datagram; one that cannot go out counts as lost on the way."""
        try:
            self._socket.send(data)
        except BlockingIOError:
            pass
        except OSError:
            self.traffic.refused += 1  # reports an earlier datagram; a robot that is gone is noticed by missing states

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class UdpLink:
    """A link to a simulated robot that speaks the exact protocol (``wire``); no call waits.

    Attributes:
        traffic: counts of its datagrams.
        sent_at: when the last command left, s; NaN before.
    """

    def __init__(self, port: int, host: str = HOST) -> None:
        """Open it.

        Raises:
            OSError: if the socket cannot be opened.
        """
        self._datagrams = Datagrams(port, host, wire.STATE_SIZE)
        self._last: int | None = None
        self._greeted = -float("inf")
        self.sent_at = math.nan
        self.traffic = self._datagrams.traffic

    def receive(self) -> Sequence[LowState]:
        """Return the states that have arrived since the last call, in the order of arrival, without waiting."""
        states = []
        for data, extra in self._datagrams.arrived():
            state = self._taken(data, extra)
            if state is not None:
                states.append(state)
        if self._last is None:
            self._greet()
        return states

    def _taken(self, data: bytes, extra: list[tuple[int, int, bytes]]) -> LowState | None:
        """Return the state of a datagram; None, and a count, if it is not accepted."""
        about = wire.head(data)
        if about is None or about.kind != wire.STATE:
            self.traffic.foreign += 1
            return None
        # 1: the next state; more: states are missing; 0 or less: an old one.
        ahead = 1 if self._last is None else wire.newer(about.number, self._last)
        if ahead <= 0:
            self.traffic.late += 1
            return None
        self.traffic.lost += ahead - 1
        self.traffic.received += 1
        self._last = about.number
        return wire.unpack_state(data, about, arrival(extra))

    def _greet(self) -> None:
        now = time.perf_counter()
        if now - self._greeted >= GREETING_S:
            self._greeted = now
            self._datagrams.put(wire.hello(0, now))

    def send(self, command: LowCmd) -> None:
        """Send a command, without waiting."""
        self.traffic.sent += 1
        self._datagrams.put(wire.pack_command(command, self.traffic.sent, time.perf_counter()))
        self.sent_at = time.perf_counter()

    def repeat(self) -> None:
        """Do nothing: this robot keeps a command for a while."""

    def rehearse(self, command: LowCmd) -> None:
        """Pack a command that is not sent."""
        wire.pack_command(command, 0, 0.0)

    def close(self) -> None:
        """Close the socket."""
        self._datagrams.close()


class Go1Link:
    """A link to a Go1, or to the simulated robot that speaks as one; no call waits.

    The robot answers to whoever speaks to it, and the vendor's client speaks every 2 ms. So until the first command a
    packet is sent that asks for nothing (``go1_wire.IDLE``), and between two cycles the last command is sent again.

    Attributes:
        traffic: counts of its datagrams.
        tick_s: unit of the robot's tick, s; NaN if not known: then states have no clock and lost ones are not counted.
        sent_at: when the last command left, s; NaN before.
        newest: the last state's packet that was accepted; empty before the first.
    """

    def __init__(self, host: str = go1_wire.ROBOT, port: int = go1_wire.ROBOT_PORT, tick_s: float = math.nan) -> None:
        """Open it; nothing is sent yet.

        Raises:
            OSError: if the socket cannot be opened.
        """
        self._datagrams = Datagrams(port, host, go1_wire.STATE_SIZE)
        self.traffic, self.tick_s, self.newest = self._datagrams.traffic, tick_s, b""
        self._last: int | None = None
        self._first = 0
        self._heard: deque[int] = deque(maxlen=KNOWN)
        self._clock, self._packet = math.nan, go1_wire.IDLE
        self._spoken, self.sent_at = -math.inf, math.nan

    @property
    def tick(self) -> int | None:
        """The tick of the newest state; None before the first."""
        return self._last

    @property
    def health(self) -> go1_wire.Health | None:
        """What the newest state has beside the readings; None before the first."""
        return go1_wire.unpack_health(self.newest) if self.newest else None

    def receive(self) -> Sequence[LowState]:
        """Return the states that have arrived since the last call, in the order of arrival, without waiting."""
        states = []
        for data, extra in self._datagrams.arrived():
            state = self._taken(data, extra)
            if state is not None:
                states.append(state)
        if self._last is None or self._packet is go1_wire.IDLE:
            self.repeat()
        return states

    def _taken(self, data: bytes, extra: list[tuple[int, int, bytes]]) -> LowState | None:
        """Return the state of a datagram; None, and a count, if it is not accepted."""
        wrong = go1_wire.state_refusal(data)
        if wrong is not None:
            self.traffic.foreign += 1
            self.traffic.refused_because[wrong.value] = self.traffic.refused_because.get(wrong.value, 0) + 1
            return None
        tick = go1_wire.tick_of(data)
        ahead = None if self._last is None else go1_wire.newer(tick, self._last)
        if ahead is not None and ahead <= 0:
            return self._overtaken(data, extra, tick, ahead)
        known = math.isfinite(self.tick_s)
        if ahead is None:
            self._first = tick
        if ahead is None or math.isnan(self._clock):  # the first, or the first since the tick's unit is known
            self._clock = tick * self.tick_s
        else:
            # By whole ticks since the first: a float of a tick that has wrapped around would jump back.
            self._clock += ahead * self.tick_s
            self.traffic.lost += max(round(ahead * self.tick_s / go1_wire.PERIOD) - 1, 0)
        self.traffic.received += 1
        self._last, self.newest = tick, data
        self._heard.append(tick)
        return go1_wire.unpack_state(data, arrival(extra), self._clock if known else math.nan)

    def _overtaken(self, data: bytes, extra: list[tuple[int, int, bytes]], tick: int, ahead: int) -> LowState | None:
        """Return a state of ``ahead`` <= 0 ticks after the newest one; None if it is doubled, or of no use any more."""
        awaited = go1_wire.newer(tick, self._first) > 0 and tick not in self._heard
        if not (awaited and -ahead * self.tick_s <= OVERTAKEN_S + 1e-9):  # NaN too: its age is not known
            self.traffic.late += 1
            return None
        self.traffic.received += 1
        self.traffic.overtaken += 1
        self.traffic.lost -= 1
        self._heard.append(tick)
        return go1_wire.unpack_state(data, arrival(extra), self._clock + ahead * self.tick_s)

    def send(self, command: LowCmd) -> None:
        """Send a command, without waiting.

        Raises:
            ValueError: if it has a part of another size, or one that is not finite.
        """
        self._packet = go1_wire.pack_command(command)
        self.traffic.sent += 1
        self._datagrams.put(self._packet)
        self._spoken = self.sent_at = time.perf_counter()

    def repeat(self) -> None:
        """Send the last command again if a period has passed since; before the first, what asks for nothing."""
        now = time.perf_counter()
        if now - self._spoken < 0.9 * go1_wire.PERIOD:
            return
        self._spoken = now
        self.traffic.repeated += 1
        self._datagrams.put(self._packet)

    def rehearse(self, command: LowCmd) -> None:
        """Pack a command that is not sent."""
        go1_wire.pack_command(command)

    def close(self) -> None:
        """Close the socket."""
        self._datagrams.close()


def ask_for_stamps(opened: socket.socket) -> None:
    """Ask the kernel for times of arrival; not every system has them."""
    with contextlib.suppress(OSError):
        opened.setsockopt(socket.SOL_SOCKET, _STAMP, 1)


def arrival(extra: list[tuple[int, int, bytes]]) -> float:
    """Return when a datagram arrived, s on ``time.perf_counter``'s clock; now if the kernel gives no stamp.

    The stamp is by the wall clock, which can be changed meanwhile; ages of more than a second are ignored.
    """
    now = time.perf_counter()
    for level, kind, content in extra:
        if level == socket.SOL_SOCKET and kind == _STAMP and len(content) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(content)
            age = time.time() - seconds - 1e-9 * nanoseconds
            return now - age if 0.0 <= age < 1.0 else now
    return now
