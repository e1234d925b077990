"""The simulated robot by itself, for any client that uses the Go1's packets: ``go1exp sim``."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from go1exp.deploy.runtime.udp import HOST
from go1exp.deploy.sim_robot.machine import TICK, Robot
from go1exp.deploy.sim_robot.server import Server

Say = Callable[[str], None]

REPORT_S = 1.0
"""Period of the lines while a client is connected, s."""


def greeting(start: str, address: tuple[str, int]) -> str:
    """Return the line with the address of a robot, host and port, and a second one if others can reach it."""
    host, port = address
    line = f"a Go1 ({start}) listens at {host}:{port}; Ctrl-C ends it"
    return line if host == HOST else f"{line}\nnote: any computer in the network can command it"


def posture(robot: Robot) -> str:
    """Return what the robot does: its motors, and the height of its trunk."""
    height = robot.truth[2]
    motors = "braking" if robot.braking else ("following commands" if robot.commanded else "holding its pose")
    return f"{motors}, " + ("suspended" if np.isnan(height) else f"trunk at {height:.2f} m")


@dataclass
class Monitor:
    """Reports a robot's client, the rate of its packets, and what is rejected.

    Attributes:
        server: the robot.
        say: prints a line.
    """

    server: Server
    say: Say
    _peer: tuple[str, int] | None = None
    _at: float = field(default_factory=time.perf_counter)
    _before: tuple[int, int, int, float] = (0, 0, 0, 0.0)
    _refused: dict[str, int] = field(default_factory=dict)
    _quiet: bool = False

    def look(self, now: float) -> None:
        """Report what has changed; ``now`` in s. To be called some times a second."""
        peer = self.server.peer
        if peer != self._peer and peer is not None:
            self.say(f"client {peer[0]}:{peer[1]}; others are rejected until it has been silent for a second")
            self._peer = peer
        for why, count in self.server.counts.refused.items():
            if why not in self._refused:
                self.say(f"rejected for the first time: {why}")
                self._refused[why] = count
        if now - self._at >= REPORT_S:
            self._report(now)

    def _report(self, now: float) -> None:
        counts, passed = self.server.counts, now - self._at
        present = (counts.heard, counts.states, counts.foreign, counts.slipped)
        heard, states, foreign, slipped = (a - b for a, b in zip(present, self._before, strict=True))
        if self._peer is not None and (heard or foreign):
            new = {why: count - self._refused.get(why, 0) for why, count in counts.refused.items()}
            self.say(
                f"{self._peer[0]}:{self._peer[1]}: {heard / passed:.0f} packets/s in, {states / passed:.0f} out; "
                f"{posture(self.server.robot)}; rejected {listed(new)}; {1e3 * slipped:.0f} ms behind real time"
            )
            self._quiet = False
        elif not self._quiet:
            self.say("no client")
            self._quiet = True
        self._at, self._before, self._refused = now, present, dict(counts.refused)


def listed(counts: dict[str, int]) -> str:
    """Return counts as text, by reason; ``none`` if all are zero."""
    return ", ".join(f"{count} x {why}" for why, count in counts.items() if count) or "none"


def serve(server: Server, going: Callable[[], bool], say: Say, seconds: float | None = None) -> None:
    """Run a robot while ``going``, for at most ``seconds``, and report its client."""
    monitor = Monitor(server, say)

    def on() -> bool:
        monitor.look(time.perf_counter())
        return going()

    server.serve(on, seconds)
    counts = server.counts
    say(
        f"ran for {counts.ticks * TICK:.1f} s; commands accepted: {counts.commands}, states sent: {counts.states}, "
        f"rejected: {listed(counts.refused)}, packets lost in the network: {counts.lost}"
    )
