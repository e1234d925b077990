"""The pipe between the robot and the page's process: events in order, the newest snapshots, and neither end waits."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mujoco.studio")

from mujoco.studio import messages

from go1exp.base.errors import Expected
from go1exp.evaluate.viewer.page_process import Mailbox, launch
from go1exp.evaluate.viewer.web import Ask, Shown


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
