"""A link over UDP on this machine: the way to the simulated robot."""

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
"""Datagrams that one call reads at most: a flood delays a cycle, but does not stop it."""

GREETING_S = 0.1
"""The robot is greeted so often until it answers, s: a greeting may get lost."""

_STAMP = 35
"""SO_TIMESTAMPNS of Linux, which Python has no name for: the kernel notes when a datagram arrived."""
_TIMESPEC = struct.Struct("@qq")


@dataclass
class Traffic:
    """What went over a link.

    Attributes:
        received: states that were taken.
        sent: commands.
        foreign: datagrams that were no state of this version.
        late: states that were older than one that had come before, or came twice; they are left out.
        lost: states that the robot counted and that never came (a late one counts here too).
        refused: times that nobody listened at the other end.
    """

    received: int = 0
    sent: int = 0
    foreign: int = 0
    late: int = 0
    lost: int = 0
    refused: int = 0


class UdpLink:
    """A link to the robot that listens at a port of this machine; nothing is waited for.

    Attributes:
        traffic: what went over it.
    """

    def __init__(self, port: int, host: str = HOST) -> None:
        """Open it.

        Raises:
            OSError: if there can be no such socket.
        """
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.connect((host, port))  # from now on the kernel drops what comes from elsewhere
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
        """Return the state of a datagram, or None and a count."""
        about = wire.head(data)
        if about is None or about.kind != wire.STATE:
            self.traffic.foreign += 1
            return None
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
            pass  # as good as lost on the way
        except ConnectionRefusedError:
            self.traffic.refused += 1  # of an earlier one; a robot that is gone is found by its silence

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()


def _ask_for_stamps(opened: socket.socket) -> None:
    """Ask the kernel for times of arrival, which not every system gives."""
    with contextlib.suppress(OSError):
        opened.setsockopt(socket.SOL_SOCKET, _STAMP, 1)


def _age(extra: list[tuple[int, int, bytes]]) -> float:
    """Return how long ago a datagram arrived, s; 0 where the kernel does not tell.

    Its stamp is of the wall clock, which somebody may set meanwhile: more than a second is not believed.
    """
    for level, kind, content in extra:
        if level == socket.SOL_SOCKET and kind == _STAMP and len(content) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(content)
            age = time.time() - seconds - 1e-9 * nanoseconds
            return age if 0.0 <= age < 1.0 else 0.0
    return 0.0
