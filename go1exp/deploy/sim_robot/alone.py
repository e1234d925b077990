"""The simulated robot by itself, for any client that speaks the Go1's protocol: ``go1exp sim``."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from go1exp.deploy.runtime.udp import HOST
from go1exp.deploy.sim_robot.machine import TICK
from go1exp.deploy.sim_robot.server import Server

Say = Callable[[str], None]

REPORT_S = 1.0
"""Period of the lines while somebody speaks, s."""


def greeting(start: str, address: tuple[str, int]) -> str:
    """Return the line that says where a robot listens, host and port, and a second one if others can reach it."""
    host, port = address
    line = f"a Go1 ({start}) listens at {host}:{port}; Ctrl-C ends it"
    return line if host == HOST else f"{line}\nnote: anybody in the network can command it"


@dataclass
class Account:
    """Says who speaks to a robot, how often, and what is refused and why.

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
        """Say what has changed; ``now`` in s. To be called some times a second."""
        peer = self.server.peer
        if peer != self._peer and peer is not None:
            self.say(f"{peer[0]}:{peer[1]} speaks; others are refused until it has been silent for a second")
            self._peer = peer
        for why, count in self.server.counts.refused.items():
            if why not in self._refused:
                self.say(f"refused for the first time: {why}")
                self._refused[why] = count
        if now - self._at >= REPORT_S:
            self._report(now)

    def _report(self, now: float) -> None:
        counts, passed = self.server.counts, now - self._at
        present = (counts.heard, counts.states, counts.foreign, counts.slipped)
        heard, states, _, slipped = (a - b for a, b in zip(present, self._before, strict=True))
        if self._peer is not None and (heard or present[2] != self._before[2]):
            refused = ", ".join(
                f"{count - self._refused.get(why, 0)} x {why}"
                for why, count in counts.refused.items()
                if count != self._refused.get(why, 0)
            )
            self.say(
                f"{self._peer[0]}:{self._peer[1]}: {heard / passed:.0f} packets/s in, {states / passed:.0f} out; "
                f"{self.posture()}; refused {refused or 'none'}; {1e3 * slipped:.0f} ms behind real time"
            )
            self._quiet = False
        elif not self._quiet:
            self.say("nobody speaks")
            self._quiet = True
        self._at, self._before, self._refused = now, present, dict(counts.refused)

    def posture(self) -> str:
        """Return what the robot does, in words."""
        robot = self.server.robot
        true = robot.sense_truth()
        height = "hung" if np.isnan(true[2]) else f"trunk at {true[2]:.2f} m"
        drives = "braking" if robot.braking else ("following" if robot.commanded else "holding its pose")
        return f"{drives}, {height}"


def serve(server: Server, going: Callable[[], bool], say: Say, seconds: float | None = None) -> None:
    """Let a robot live while ``going``, for at most ``seconds``, and say what happens to it."""
    account = Account(server, say)

    def on() -> bool:
        account.look(time.perf_counter())
        return going()

    server.serve(on, seconds)
    counts = server.counts
    refused = ", ".join(f"{count} x {why}" for why, count in counts.refused.items()) or "none"
    say(
        f"lived for {counts.ticks * TICK:.1f} s; {counts.commands} commands obeyed, {counts.states} states sent, "
        f"refused {refused}; {counts.lost} packets lost on the way"
    )
