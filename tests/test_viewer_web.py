"""The page: its pipe to the robot, its frame period, and the browser's gamepad."""

from __future__ import annotations

import asyncio
import math
import multiprocessing
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mujoco.studio import messages
from websockets.datastructures import Headers
from websockets.http11 import Response

from go1exp.base.errors import Expected
from go1exp.evaluate.viewer.page_process import Mailbox, launch
from go1exp.evaluate.viewer.page_server import DEAD, PATH, PUSH, SILENT_S, STAND, Gamepad, steered
from go1exp.evaluate.viewer.web import FRAME_S, SLOWEST_FRAME_S, Ask, PictureRate, Shown


@pytest.fixture
def ends() -> Iterator[tuple[Mailbox, Mailbox]]:
    here, there = multiprocessing.Pipe()
    yield Mailbox(here), Mailbox(there)
    here.close()
    there.close()


def test_events_come_in_order_and_of_snapshots_the_newest(ends: tuple[Mailbox, Mailbox]) -> None:
    robot, page = ends
    for k in range(3):
        robot.events.put(Ask(k))
        robot.snapshots.put(Shown(k))
    assert page.events.get() == [Ask(0), Ask(1), Ask(2)]
    assert page.snapshots.get() == [Shown(0)]  # it was free; the others waited
    robot.snapshots.put(Shown(3))
    robot.events.get()  # hears that the first was taken, and sends what waits
    page.events.get()
    assert page.snapshots.get() == [Shown(3)]
    assert page.snapshots.get() == []


def test_a_page_that_does_not_look_holds_nobody_up(ends: tuple[Mailbox, Mailbox]) -> None:
    robot, _ = ends
    start = time.monotonic()
    for k in range(1000):  # 80 MB: far more than a pipe holds
        robot.snapshots.put(messages.StateSnapshot(state=np.full(10_000, float(k)), state_sig=1))
    assert time.monotonic() - start < 5.0
    kept = robot.snapshots.reclaim_unconsumed(messages.StateSnapshot)
    assert isinstance(kept, messages.StateSnapshot)
    assert kept.state[0] == 999.0
    assert robot.snapshots.reclaim_unconsumed(messages.StateSnapshot) is None


def test_snapshots_wait_for_the_model_that_they_are_of(ends: tuple[Mailbox, Mailbox]) -> None:
    robot, page = ends
    robot.snapshots.put(Shown("old"))
    assert page.events.get() == []
    robot.events.get()
    robot.events.put(Ask("new model"))
    robot.snapshots.put(Shown("new"))
    assert page.snapshots.get() == [Shown("old")]
    assert page.events.get() == [Ask("new model")]
    assert page.snapshots.get() == [Shown("new")]


def test_an_end_that_goes_ends_the_other(ends: tuple[Mailbox, Mailbox]) -> None:
    robot, page = ends
    page.close()
    assert [type(event) for event in robot.events.get()] == [messages.ExitEvent]
    robot.events.put(Ask(1))  # to nobody: not an error
    assert robot.over


def test_a_page_that_fails_is_an_error_here() -> None:
    def broken(endpoint: object) -> None:
        raise SystemExit(1)  # as multiprocessing ends a process of which an exception got out, without its text

    handle = launch(broken, [])

    def watch() -> None:
        while handle.is_running():
            time.sleep(0.01)

    with pytest.raises(Expected, match="page's process"):
        watch()


def passed(rate: PictureRate, begin: float, seconds: int, lost: float) -> None:
    """Let seconds pass, in each of which the robot loses ``lost`` s, in fifty parts."""
    for k in range(1, 50 * seconds + 1):
        rate.note(begin + k / 50, lost / 50)


def test_pictures_become_fewer_while_the_robot_loses_time_and_more_again() -> None:
    rate = PictureRate(0.0)
    passed(rate, 0.0, 5, 0.01)
    assert rate.every == FRAME_S
    passed(rate, 5.0, 2, 0.5)
    assert FRAME_S < rate.every < SLOWEST_FRAME_S
    passed(rate, 7.0, 20, 0.5)
    assert rate.every == SLOWEST_FRAME_S
    passed(rate, 27.0, 60, 0.0)
    assert rate.every == FRAME_S


def test_it_tells_when_the_rate_has_changed() -> None:
    rate = PictureRate(0.0)
    assert [rate.note(now, 0.1) for now in (0.5, 0.9, 1.0, 1.1)] == [False, False, True, False]
    assert rate.every == pytest.approx(1.3 * FRAME_S)


LIMITS = ((-1.5, 2.0), (-0.6, 0.8), (-1.0, 1.0))


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_sticks_ask_for_their_share_of_the_sliders_and_for_nothing_when_they_are_let_go() -> None:
    pad = Gamepad(Clock())
    assert pad.sticks() is None
    assert pad.hear("axes=-1.00,-1.00,1.00,0.00&held=")
    forward, left, turn = pad.sticks() or ()
    assert steered((forward, left, turn), LIMITS) == pytest.approx([2.0, 0.8, -1.0])
    half = 0.5 * (1.0 + DEAD)
    assert pad.hear(f"axes=0,{half},0,0&held=")
    assert steered(pad.sticks() or (), LIMITS) == pytest.approx([-0.75, 0.0, 0.0])
    assert pad.hear(f"axes={0.9 * DEAD},-{0.9 * DEAD},0,0")
    assert pad.sticks() is None


def test_a_page_that_is_gone_holds_no_stick() -> None:
    clock = Clock()
    pad = Gamepad(clock)
    pad.hear("axes=0,-1,0,0")
    clock.now += 0.9 * SILENT_S
    assert pad.sticks() is not None
    clock.now += 0.2 * SILENT_S
    assert pad.sticks() is None


def test_a_button_counts_once_for_each_press() -> None:
    pad = Gamepad(Clock())
    for held in ("", f"{PUSH}", f"{STAND},{PUSH}", f"{STAND}", f"{PUSH}"):
        pad.hear(f"axes=0,0,0,0&held={held}")
    assert pad.presses() == [PUSH, STAND, PUSH]
    assert pad.presses() == []


@pytest.mark.parametrize(
    "query", ["", "axes=", "axes=1,2", "axes=nan,0,0", "axes=0,0,0&held=x", "held=1", "axes=0,0,inf,0", "axes=a"]
)
def test_words_that_are_not_the_scripts_change_nothing(query: str) -> None:
    pad = Gamepad(Clock())
    pad.hear("axes=0,-1,0,0")
    assert not pad.hear(query)
    assert pad.sticks() == pytest.approx((1.0, 0.0, 0.0))
    assert pad.presses() == []


def answered(pad: Gamepad, path: str) -> Any:
    """Return what a server that has a page answers to a request."""

    def usual(connection: Any, request: Any) -> Response:
        body = b"<html><body>page</body></html>"
        return Response(200, "OK", Headers({"Content-Length": str(len(body))}), body)

    connection = SimpleNamespace(respond=lambda status, text: (int(status), text))
    return asyncio.run(pad.served(usual)(connection, SimpleNamespace(path=path)))


def test_the_page_has_the_script_and_its_words_are_heard() -> None:
    pad = Gamepad(Clock())
    page = answered(pad, "/?token=x")
    assert page.body.count(b"getGamepads") == 1
    assert page.body.endswith(b"</script>\n</body></html>")
    assert page.headers.get_all("Content-Length") == [str(len(page.body))]
    assert b"getGamepads" not in answered(pad, "/web_client.js").body
    assert answered(pad, f"{PATH}?axes=0,-1,0,0&held=")[0] == 200
    assert pad.sticks() is not None
    assert answered(pad, f"{PATH}?axes=7")[0] == 400
    assert math.isclose((pad.sticks() or (0.0,))[0], 1.0)
