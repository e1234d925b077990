"""The runtime and the simulated robot in one process and one thread, over their real sockets, at a time of their own.

Time passes only while the runtime sleeps, and then the robot ticks: the same arguments give the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from go1exp.deploy.runtime import job, udp, walk
from go1exp.deploy.runtime.commands import CommandConfig
from go1exp.deploy.runtime.loop import Deadlines
from go1exp.deploy.sim_robot.__main__ import bundle_task, sim_config
from go1exp.deploy.sim_robot.machine import TICK, Robot
from go1exp.deploy.sim_robot.server import TRUTH, Server
from go1exp.logs import recording
from go1exp.robot.messages import LowCmd, LowState

BEGIN = 100.0
"""The runtime's clock at the start, s."""

Spoil = Callable[[LowState], LowState | None]


class World:
    """What there is while a walk is played.

    Attributes:
        now: the time, s.
        robot: at the other end; None before it is started.
        applied: the commands that the robot applied, oldest first.
        targets: of each tick: the robot's clock, the target in force, and whether it braked.
        spins: what the runtime's clocks were asked to spin.
        closed: the simulated robot was closed.
    """

    def __init__(self, spoil: Spoil) -> None:
        self.now, self.spoil = BEGIN, spoil
        self.robot: Robot | None = None
        self.server: Server | None = None
        self.applied: list[LowCmd] = []
        self.targets: list[tuple[float, np.ndarray, bool]] = []
        self.spins: list[float] = []
        self.between: Callable[[], None] = lambda: None
        self.on_server: Callable[[World], None] = lambda world: None
        self.closed = False

    def pass_until(self, when: float) -> None:
        while self.now + TICK <= when + 1e-9:
            self.between()
            if self.server is not None and not self.closed:
                self.server.tick()
            self.now += TICK
        self.now = max(self.now, when)


class Listening(Robot):
    """A robot that tells what it applies, and whose sensors may be spoilt."""

    world: World

    def apply(self, command: LowCmd) -> None:
        self.world.applied.append(command)
        super().apply(command)

    def sense(self) -> tuple[LowState, np.ndarray]:
        state, true = super().sense()
        self.world.targets.append((state.clock, self._target[0].numpy().copy(), self.braking))
        spoilt = self.world.spoil(state)
        if spoilt is None:
            raise SilentError(true)
        return spoilt, true


class SilentError(Exception):
    """This state does not go out."""


class Mutable(Server):
    """A robot that may fall silent."""

    def tick(self) -> None:
        try:
            super().tick()
        except SilentError:
            self.counts.ticks += 1


class InProcess:
    """Stands for ``SimulatedRobot``."""

    def __init__(
        self, world: World, bundle: str, sim: Mapping[str, Any], other: Mapping[str, Any], keep: float
    ) -> None:
        config = sim_config(dict(sim))
        robot = Listening(bundle_task(bundle, dict(other)), config)
        robot.world, world.robot = world, robot
        self.world, self._server = world, Mutable(robot, config, kept=keep + 10.0)
        world.server = self._server
        world.on_server(world)
        self.port = self._server.port
        self.report: dict[str, Any] = {}
        self.truth: dict[str, np.ndarray] = {}
        self.applied: np.ndarray | None = None

    def __enter__(self) -> InProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.world.closed = True
        empty = Deadlines(TICK, 1).timing()
        self.report = asdict(self._server.counts) | {"timing": asdict(empty)}
        self.applied = np.array(self._server.applied)
        rows = np.array(self._server.truth)
        if len(rows) and not np.isnan(rows).any():
            self.truth = dict(zip(("clock", *TRUTH), rows.T, strict=True))
        self._server.close()


@contextmanager
def lockstep(
    spoil: Spoil = lambda state: state, on_server: Callable[[World], None] = lambda world: None
) -> Iterator[World]:
    """Let ``go1exp.deploy.runtime.job.run_job`` run in simulated time.

    ``spoil`` changes what sensors say, None is silence; ``on_server`` is called when the robot is there.
    """
    world = World(spoil)
    world.on_server = on_server

    def clock(spin: float, meanwhile: Any, between: Any, prepare: Any) -> Any:
        world.spins.append(spin)
        world.between = between
        return SimpleNamespace(now=lambda: world.now, sleep_until=world.pass_until)

    host_time = SimpleNamespace(perf_counter=lambda: world.now, time=lambda: 0.0)
    with pytest.MonkeyPatch.context() as patch:
        # Stamps of arrival are not believed, and states are as old as the last cycle.
        patch.setattr(udp, "time", host_time)
        patch.setattr(walk, "MonotonicClock", clock)
        patch.setattr(job, "SimulatedRobot", lambda *given, **options: InProcess(world, *given, **options))
        yield world


def play(
    bundle: str,
    out: Path,
    spoil: Spoil = lambda state: state,
    *,
    on_server: Callable[[World], None] = lambda world: None,
    about: Mapping[str, Any] | None = None,
    **plan: Any,
) -> SimpleNamespace:
    """Walk in lockstep, ``about`` a job and by a plan; return status, what was said, account, log, cycles and world."""
    usual: dict[str, Any] = {"seconds": 1.0, "stand_up": 0.2, "hand_over": 0.0, "lie_down": 0.0, "brake": 0.1}
    plan = {**usual, "command": CommandConfig((0.4, 0.0, 0.0)), **plan}
    said: list[str] = []
    with lockstep(spoil, on_server) as world:
        status = job.run_job(job.Job(bundle, "sim", walk.Plan(**plan), str(out), **(about or {})), said.append)
    (account,) = out.glob("*.json")
    kept = list(out.glob("*.parquet"))
    with np.load(next(out.glob("*.npz"))) as file:
        cycles = {name: file[name] for name in file.files}
    return SimpleNamespace(
        status=status,
        output=said,
        account=json.loads(account.read_text()),
        recording=recording.read(kept[0]) if kept else None,
        cycles=cycles,
        world=world,
    )
