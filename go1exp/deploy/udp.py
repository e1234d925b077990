"""A link over UDP on this machine, to the simulated robot."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass

from go1exp.deploy import wire
from go1exp.deploy.messages import LowCmd, LowState

HOST = "127.0.0.1"
AT_ONCE = 1024
"""Most datagrams that one call reads: a flood of them delays a cycle but does not stop it."""

GREETING_S = 0.1
"""Period at which a hello is sent until the robot answers, s: a hello can be lost."""

_STAMP = 35
"""SO_TIMESTAMPNS of Linux, for which Python has no name: the kernel stamps datagrams with their time of arrival."""
_TIMESPEC = struct.Struct("@qq")


@dataclass
class Traffic:
    """Counts of the datagrams over a link.

    Attributes:
        received: states that were accepted.
        sent: commands.
        foreign: datagrams that were not a state of this version.
        late: states older than one received before, or received twice; they are left out.
        lost: states missing in the robot's count (a late one counts here too).
        refused: times that the port at the other end was closed.
    """

    received: int = 0
    sent: int = 0
    foreign: int = 0
    late: int = 0
    lost: int = 0
    refused: int = 0


class UdpLink:
    """A link to the robot that listens at a port of this machine; no call waits.

    Attributes:
        traffic: counts of its datagrams.
    """

    def __init__(self, port: int, host: str = HOST) -> None:
        """Open it.

        Raises:
            OSError: if the socket cannot be opened.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.connect((host, port))  # the kernel then drops datagrams of other senders
            _ask_for_stamps(self._socket)
        except OSError:
            self._socket.close()
            raise
        self._last: int | None = None
        self._greeted = -float("inf")
        self.traffic = Traffic()

    def receive(self) -> Sequence[LowState]:
        """Return the states that have arrived since the last call, oldest first, without waiting."""
        states = []
        for _ in range(AT_ONCE):
            try:
                data, extra, _, _ = self._socket.recvmsg(wire.STATE_SIZE + 1, 64)
            except (BlockingIOError, InterruptedError):
                break
            except ConnectionRefusedError:
                self.traffic.refused += 1
                continue
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
        return wire.unpack_state(data, about, time.perf_counter() - _age(extra))

    def _greet(self) -> None:
        now = time.perf_counter()
        if now - self._greeted >= GREETING_S:
            self._greeted = now
            self._put(wire.hello(0, now))

    def send(self, command: LowCmd) -> None:
        """Send a command, without waiting."""
        self.traffic.sent += 1
        self._put(wire.pack_command(command, self.traffic.sent, time.perf_counter()))

    def _put(self, data: bytes) -> None:
        try:
            self._socket.send(data)
        except BlockingIOError:
            pass  # counts as lost
        except ConnectionRefusedError:
            self.traffic.refused += 1  # reports an earlier datagram; a robot that is gone is noticed by missing states

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _ask_for_stamps(opened: socket.socket) -> None:
    """Ask the kernel for times of arrival; not every system has them."""
    with contextlib.suppress(OSError):
        opened.setsockopt(socket.SOL_SOCKET, _STAMP, 1)


def _age(extra: list[tuple[int, int, bytes]]) -> float:
    """Return how long ago a datagram arrived, s; 0 if the kernel gives no stamp.

    The stamp is by the wall clock, which can be changed meanwhile; ages of more than a second are ignored.
    """
    for level, kind, content in extra:
        if level == socket.SOL_SOCKET and kind == _STAMP and len(content) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(content)
            age = time.time() - seconds - 1e-9 * nanoseconds
            return age if 0.0 <= age < 1.0 else 0.0
    return 0.0
