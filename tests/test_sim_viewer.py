"""The page of ``go1exp sim viewer=web``, without a browser: what a client does shows, and a push moves the robot."""

from __future__ import annotations

import math
import multiprocessing
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
import pytest

from go1exp import robot
from go1exp.config.compose import compose
from go1exp.config.schema.registry import ConfigError
from go1exp.deploy.runtime import go1_wire
from go1exp.deploy.sim_robot import SimConfig
from go1exp.deploy.sim_robot.machine import TICK, Body, Robot
from go1exp.deploy.sim_robot.server import STRANGER, Server
from go1exp.evaluate.viewer import requests as ask
from go1exp.evaluate.viewer import sim_process
from go1exp.evaluate.viewer.session import SPAN
from go1exp.evaluate.viewer.sim_process import EVERY, SUSPENDED, Answering, Frame, Probe, RobotProcess
from go1exp.evaluate.viewer.sim_window import SimShow, SimView, longest
from go1exp.robot.messages import LowCmd
from go1exp.sim.task import parse_parts

GROUPS = ("robot", "actuator", "effect", "contact", "terrain")
CONTAINER = compose("sim", ["effect=payload"])
PARTS = parse_parts(CONTAINER, GROUPS)[0]
STAND = go1_wire.pack_command(LowCmd(robot.NOMINAL_STANCE.copy(), np.full(12, 60.0), np.full(12, 1.0)))
SAY = partial(print, flush=True)


class Here:
    """A robot in this process, its probe, its page, and a client; ticks pass when told."""

    def __init__(self, **config: object) -> None:
        body = Body(**PARTS)
        settings = SimConfig(noise=0.0, **config)  # type: ignore[arg-type]
        self.server = Server(Robot(body, settings), settings)
        self.probe = Probe(self.server, body, settings)
        self.show = SimShow(cast(RobotProcess, self), body)
        self.clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]

    def send(self, request: ask.Request) -> None:
        self.probe.fulfil([request])

    def look(self) -> Frame | None:
        return self.probe.frame()

    def live(self, seconds: float, packet: bytes = STAND, every: int = 1) -> SimView:
        for k in range(round(seconds / TICK)):
            if k % every == 0:
                self.clients[0].sendto(packet, self.server.address)
            self.server.tick()
            if k % 20 == 19:
                self.show.tick()
        return self.seen()

    def seen(self) -> SimView:
        self.show.tick()
        view = self.show.view()
        assert view is not None
        return view

    def close(self) -> None:
        self.server.close()
        for client in self.clients:
            client.close()


@pytest.fixture
def here() -> Iterator[Here]:
    made = Here()
    yield made
    made.close()


def test_the_page_shows_where_the_robot_is_and_its_curves(here: Here) -> None:
    view = here.live(0.4)
    np.testing.assert_allclose(here.show.data.qpos, here.server.robot.pose())
    assert len(view.t) == len(view.height) == 40
    assert view.t[-1] == 0.0
    assert view.height[-1] == pytest.approx(here.server.robot.truth[2], abs=1e-4)
    assert view.height[-1] > 0.25
    largest = np.array(view.torque).max(axis=1)
    assert ((largest > 0.0) & (largest < 1.0)).all()
    assert all(runs and runs[-1][1] == 0.0 for runs in view.contacts)  # stands on all four
    assert tuple(view.frame.sizes) == ("payload",)
    assert view.frame.posture.startswith("following commands, trunk at 0.")
    assert here.show.view() is None  # nothing new


def test_a_push_moves_the_robot_where_it_points_and_is_marked(here: Here) -> None:
    here.live(0.2)
    here.show.ask(ask.Push(20.0, math.pi / 2))
    view = here.live(0.2)
    forward, left, _ = np.abs(np.array(view.velocity)).max(axis=1)
    assert max(view.velocity[1]) == left > 0.3
    assert left > 2 * forward
    assert view.pushes == [pytest.approx(-0.2, abs=0.01)]
    assert len(view.arrows) == 1
    here.show.ask(ask.Reset())
    view = here.live(0.1)
    assert np.abs(np.array(view.velocity)[:2, -3:]).max() < 0.1
    assert view.frame.clock == pytest.approx(0.5)  # its clock goes on


def test_a_robot_that_hangs_cannot_be_pushed_and_is_shown_in_the_air() -> None:
    made = Here(start="suspended")
    made.show.ask(ask.Push(20.0, 0.0))
    view = made.live(0.1)
    made.close()
    assert view.frame.message == SUSPENDED
    assert view.pushes == []
    assert made.show.data.qpos[2] == 1.0
    assert np.isnan(view.height).all()
    assert np.isfinite(view.torque).all()


def test_effects_change_while_the_robot_stands_under_its_client(here: Here) -> None:
    view = here.live(0.3)
    assert view.frame.sizes == {"payload": 1.0}
    assert {"payload", "coulomb", "fixed_point"} <= set(view.known)
    before = here.server.robot
    here.show.ask(ask.SetEffects({"payload": 0.0, "coulomb": 2.0}))
    ends = time.monotonic() + 60.0
    while here.server.robot is before:
        view = here.live(0.02)  # the old one stands on meanwhile
        assert time.monotonic() < ends
    after = here.server.robot
    assert after.clock >= before.clock
    view = here.live(0.4)
    assert view.frame.sizes == {"coulomb": 2.0}
    assert view.frame.message == ""
    assert view.frame.posture.startswith("following commands, trunk at 0.")
    assert view.height[-1] > 0.25
    carried = [float(one.backend.field("body_mass").sum()) for one in (before, after)]
    assert carried[0] - carried[1] == pytest.approx(1.0, abs=1e-6)  # the payload is gone, kg
    here.show.ask(ask.Push(20.0, math.pi / 2))
    assert max(here.live(0.2).velocity[1]) > 0.3


def test_a_robot_takes_over_pose_speed_and_command_of_another(here: Here) -> None:
    here.live(0.1)
    here.show.ask(ask.Push(10.0, 0.0))
    here.live(0.06)
    old = here.server.robot
    new = Robot(replace(Body(**PARTS), effect=()), SimConfig(noise=0.0))
    new.take_over(old)
    np.testing.assert_array_equal(new.backend.qpos, old.backend.qpos)
    np.testing.assert_array_equal(new.backend.qvel, old.backend.qvel)
    np.testing.assert_array_equal(new.applied(), old.applied())
    np.testing.assert_array_equal(new.truth, old.truth)
    assert (new.clock, new.commanded, new.braking) == (old.clock, True, False)
    new.step()
    assert new.clock == pytest.approx(old.clock + TICK)
    for _ in range(60):
        new.step()
    assert new.braking  # the last command grows old as it would have


def test_effects_that_cannot_be_are_refused_and_the_robot_stays(here: Here) -> None:
    before = here.server.robot
    here.show.ask(ask.SetEffects({"gravity": 1.0}))
    view = here.live(0.1)
    assert "'gravity'" in view.frame.message
    assert here.server.robot is before
    assert view.frame.sizes == {"payload": 1.0}


def test_the_timing_of_the_client_is_that_of_its_packets(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    now = time.perf_counter()
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    here.server.peer = ("127.0.0.1", 5)
    for k, at in enumerate(np.cumsum(np.r_[now - 0.9, np.full(99, 0.004), 0.030, np.full(9, 0.004)])):
        here.probe._hear(float(at), b"%d" % (k // 5))  # each command five times: a cycle of 20 ms
    p = here.seen()
    assert (p.every.p50, p.every.worst) == (pytest.approx(4.0), pytest.approx(30.0))
    assert (p.new.p50, p.new.worst) == (pytest.approx(20.0), pytest.approx(46.0))
    assert len(p.new.interval) == 110 / 5 - 1
    assert p.rate == 110
    assert p.every.t[int(np.argmax(p.every.interval))] == pytest.approx(-0.9 + 99 * 0.004 + 0.030)


def test_intervals_rate_and_who_speaks_are_seen_as_they_happen(here: Here) -> None:
    ends = time.perf_counter() + 0.5
    while time.perf_counter() < ends:
        here.clients[0].sendto(STAND, here.server.address)
        time.sleep(0.01)
        here.server.tick()
    here.clients[1].sendto(STAND, here.server.address)
    here.clients[0].sendto(b"x", here.server.address)
    here.server.tick()
    p = here.seen()
    assert p.frame.peer == f"127.0.0.1:{here.clients[0].getsockname()[1]}"
    assert p.frame.connected
    assert p.frame.refused == {STRANGER: 1, "wrong size": 1}
    assert p.rate == here.server.counts.heard
    assert 10.0 <= p.every.p50 <= p.every.p99 <= p.every.worst
    assert len(p.every.interval) == here.server.counts.heard - 1
    assert sum(p.every.interval) < 1e3 * SPAN
    assert -SPAN < p.every.t[0] < p.every.t[-1] <= 0.0
    assert p.new.interval == []  # the same packet all the time


def test_another_speaker_begins_a_new_row_of_intervals(here: Here) -> None:
    here.probe._hear(10.0, b"a")
    here.probe._hear(10.5, b"b")
    here.probe._hear(12.0, b"b")  # silent for more than a second: gone, and come again
    here.server.peer = ("127.0.0.1", 5)
    here.probe._hear(12.1, b"b")
    for column in (1, 2):
        times = [packet[column] for packet in here.probe._packets]
        assert [None if math.isnan(since) else since for since in times] == [None, 0.5, None, None]


def test_a_page_that_does_not_ask_costs_a_gap_and_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sim_process, "KEPT_S", 0.2)
    made = Here()
    made.live(0.1)
    for _ in range(250):
        made.server.tick()
    view = made.live(0.0)
    made.close()
    assert len(view.t) == 60
    np.testing.assert_array_equal(np.isnan(view.height), [False] * 10 + [True] * 30 + [False] * 20)


def test_the_robot_answers_the_page_between_its_ticks_and_never_waits_for_it(here: Here) -> None:
    page, robots_end = multiprocessing.Pipe()
    answering = Answering(here.probe, robots_end)
    for _ in range(EVERY):
        here.server.tick()
    assert not page.poll()  # not asked
    page.send((ask.Push(5.0, 0.0),))
    for _ in range(EVERY):
        here.server.tick()
    assert page.poll()
    frame = page.recv()
    assert len(frame.rows) == 2
    assert frame.push.impulse == 5.0
    page.close()
    for _ in range(EVERY):
        here.server.tick()
    assert not answering.going
    robots_end.close()


def test_of_each_group_the_longest_interval_is_drawn() -> None:
    t = np.arange(2500.0)
    values = np.ones(2500)
    values[1234] = 9.0
    at, drawn = longest(t, values, 1000)
    assert len(at) == 834
    assert drawn.max() == 9.0
    assert at[drawn.argmax()] == 1234.0
    np.testing.assert_array_equal(longest(t, values, 2500)[0], t)


@pytest.mark.slow("go1exp/evaluate/viewer/", "go1exp/deploy/sim_robot/", "go1exp/cli/play_web.py")
def test_the_robot_lives_in_a_process_of_its_own_and_ends_with_the_page(
    capfd: pytest.CaptureFixture[str], request: pytest.FixtureRequest
) -> None:
    groups = {name: CONTAINER[name] for name in GROUPS}
    process = RobotProcess(groups, (0, 0), SimConfig(), ("127.0.0.1", 0), None, SAY)
    request.addfinalizer(process.close)  # a failed test must not leave it behind: pytest would wait for it
    with pytest.raises(ConfigError, match=r"address = 127\.0\.0\.1:\d+: "):
        RobotProcess(groups, (0, 0), SimConfig(), process.address, None, SAY)
    show = SimShow(process, Body(**PARTS))
    ends = time.perf_counter() + 20.0
    view = None
    while view is None and time.perf_counter() < ends:
        show.tick()
        view = show.view()
        time.sleep(0.01)
    assert view is not None
    assert view.frame.peer is None
    assert view.frame.refused == {}
    assert math.isnan(view.every.worst)
    process.close()
    assert process._process.exitcode == 0
    assert "ran for" in capfd.readouterr().out
    with pytest.raises(ask.Ended):
        show.tick()
