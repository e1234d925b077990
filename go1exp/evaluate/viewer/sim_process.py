"""The robot of ``go1exp sim viewer=web`` in a process of its own, so that the page takes none of its time."""

from __future__ import annotations

import multiprocessing
import signal
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Protocol

from go1exp.base.errors import Expected
from go1exp.base.signals import ending
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.sim_robot.alone import Say
from go1exp.deploy.sim_robot.machine import Body, Robot
from go1exp.deploy.sim_robot.settings import SimConfig
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer.sim_probe import EVERY, Frame, Probe

SWITCH_S = 1e-4
"""Longest time for which a thread that builds another robot may hold up the ticks of 2 ms, s; Python's own is 5 ms."""

ENDS_S = 5.0
"""How long the robot may take to end, s."""


class Link(Protocol):
    """The page's way to a robot."""

    def send(self, request: ask.Request) -> None:
        """Ask something of it."""

    def look(self) -> Frame | None:
        """Return the next frame if it has come, without waiting; raise ``requests.Ended`` after the last one."""


@dataclass(frozen=True)
class Listening:
    """From the robot, when it is there: where it listens."""

    address: tuple[str, int]


@dataclass(frozen=True)
class Refused:
    """From the robot, when it cannot be: why, in lines; and whether they are problems of the settings."""

    lines: tuple[str, ...]
    settings: bool


class RobotProcess:
    """A robot in another process.

    Attributes:
        address: where it listens for its client, host and port.
    """

    def __init__(
        self,
        groups: Mapping[str, Any],
        tile: tuple[int, int],
        config: SimConfig,
        address: tuple[str, int],
        seconds: float | None,
        say: Say,
    ) -> None:
        """Start it and wait until it listens.

        Args:
            groups: the configuration of the groups of ``machine.Body``, as plain data that another process can get.
            tile: on which it begins.
            config: how it is set up.
            address: where to listen.
            seconds: how long it lives, s; None until it is closed.
            say: prints a line of it; an importable function, since it is called in the other process.

        Raises:
            ConfigError: if its settings are refused.
            Expected: if it cannot listen there, or ends before.
        """
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        given = (other, dict(groups), tile, config, address, seconds, say)
        self._process = context.Process(target=_live, args=given, daemon=True)
        before = {number: signal.signal(number, signal.SIG_IGN) for number in ending()}
        try:
            self._process.start()  # it inherits that it ignores them: Ctrl-C is for the page, which then ends it
        finally:
            for number, usual in before.items():
                signal.signal(number, usual)
        other.close()
        try:
            answer = self._pipe.recv()
        except EOFError:
            answer = Refused(("the simulated robot's process ended before it listened",), settings=False)
        if isinstance(answer, Refused):
            self.close()
            raise ConfigError(list(answer.lines)) if answer.settings else Expected("\n".join(answer.lines))
        self.address: tuple[str, int] = answer.address
        self._wishes: list[ask.Request] = []
        self._asked = False

    def send(self, request: ask.Request) -> None:
        """Ask something of it, with the next look."""
        self._wishes.append(request)

    def look(self) -> Frame | None:
        """Return the next frame if it has come, and ask for another one; see ``Link``."""
        try:
            frame: Frame | None = None
            if self._asked and self._pipe.poll():
                frame, self._asked = self._pipe.recv(), False
            if not self._asked:
                self._pipe.send(tuple(self._wishes))
                self._wishes, self._asked = [], True
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


def _live(
    pipe: Connection,
    groups: dict[str, Any],
    tile: tuple[int, int],
    config: SimConfig,
    address: tuple[str, int],
    seconds: float | None,
    say: Say,
) -> None:
    """Be the robot until the page's end of the pipe is closed."""
    import torch

    from go1exp.deploy.sim_robot.alone import serve
    from go1exp.deploy.sim_robot.server import Server
    from go1exp.sim.task import parse_parts

    torch.set_num_threads(1)
    sys.setswitchinterval(SWITCH_S)
    try:
        parts, problems = parse_parts(groups, tuple(groups))
        if problems:
            raise ConfigError(problems)
        body = Body(**parts, tile=tile)
        server = Server(Robot(body, config), config, address[1], address[0])
    except ConfigError as error:
        pipe.send(Refused(tuple(error.problems), settings=True))
        return
    except (Expected, OSError) as error:
        pipe.send(Refused((f"address = {address[0]}:{address[1]}: {error}",), settings=False))
        return
    pipe.send(Listening(server.address))
    answering = Answering(Probe(server, body, config), pipe)
    try:
        serve(server, lambda: answering.going, say, seconds)
    finally:
        server.close()


class Answering:
    """Answers the page between two ticks.

    Attributes:
        going: whether the page is still there.
    """

    def __init__(self, probe: Probe, pipe: Connection) -> None:
        """Answer from the next tick on."""
        self.going, self._probe, self._pipe = True, probe, pipe
        self._before, probe.server.on_tick = probe.server.on_tick, self._tick

    def _tick(self) -> None:
        if self._before is not None:
            self._before()
        if not self.going or self._probe.server.counts.ticks % EVERY:
            return
        try:
            if self._pipe.poll():
                wishes: Sequence[ask.Request] = self._pipe.recv()
                self._probe.fulfil(wishes)
                self._pipe.send(self._probe.frame())
        except (EOFError, OSError):
            self.going = False
