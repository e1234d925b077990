"""The gamepad at the browser: what its script says becomes a command, through the gate and nothing else."""

from __future__ import annotations

import asyncio
import math
from types import SimpleNamespace
from typing import Any

import pytest
from websockets.datastructures import Headers
from websockets.http11 import Response

from go1exp.evaluate.viewer.page_server import DEAD, PATH, PUSH, SILENT_S, STAND, Gamepad, steered

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
