"""The robot in a real browser: a page that draws, controls that move it, and a server that refuses strangers."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

from go1exp.base.paths import data_root
from tests.browser import CHROMIUM, Browser, wait_until

PATIENCE = 120.0
"""How long something may take that draws without a graphics card beside other tests, s."""

PARTS = (
    "go1exp/evaluate/viewer/",
    "go1exp/cli/play_web.py",
    "go1exp/cli/play.py",
    "tests/browser.py",
    "tests/viewer_process.py",
)

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(data_root()), "PYTHONUNBUFFERED": "1"}


class Told:
    """What a process last said of itself."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.last: dict[str, Any] = {}
        self._process = process
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.last = {**self.last, **json.loads(line)}

    def __getitem__(self, name: str) -> Any:
        return self.last[name]

    def place(self, name: str, share: float = 0.5) -> tuple[float, float]:
        """Return a point in a control, from its left."""
        left, top, right, bottom = self["places"][name]
        return left + share * (right - left), 0.5 * (top + bottom)


@contextmanager
def shown() -> Iterator[Told]:
    """The robot on a page, and what it says."""
    command = [sys.executable, "-m", "tests.viewer_process"]
    process = subprocess.Popen(command, env=ENVIRONMENT, cwd=data_root(), stdout=subprocess.PIPE, text=True)
    try:
        told = Told(process)
        wait_until(lambda: "address" in told.last or process.poll() is not None, PATIENCE, "address")
        yield told
        process.send_signal(signal.SIGINT)
        assert process.wait(30.0) == 0
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        told._thread.join(10.0)
        process.stdout.close()


@pytest.mark.slow(*PARTS)
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")
def test_a_robot_is_seen_and_driven_in_chromium() -> None:
    """A small picture: without a graphics card each one takes a core a third of a second."""
    with shown() as told, Browser(1280, 800, scale=0.25) as browser:
        browser.go(told["address"])
        wait_until(lambda: bool(told.last.get("places")), PATIENCE, "panel")
        wait_until(lambda: browser.screenshot().std() > 15.0, PATIENCE, "picture in the canvas")
        picture = browser.screenshot().astype(float)
        height, width = picture.shape[:2]
        scene = picture[height // 10 : -height // 8, round(0.26 * width) : round(0.62 * width)]
        assert scene.std(axis=(0, 1)).min() > 5.0  # a robot on a floor, and not one colour
        assert abs(scene - picture[:, : width // 5].mean(axis=(0, 1))).mean() > 10.0  # and not the panel

        # a slider moves the robot: its speed follows
        forward = told.place("forward m/s", 0.45)  # the place has the label in it
        browser.hold(lambda: told.place("forward m/s", 0.45), until=lambda: told["command"][0] > 0.3, seconds=PATIENCE)
        wanted, start, since = told["command"][0], told["x"], told["time"]
        assert 0.3 < wanted < 1.6
        wait_until(lambda: told["time"] > since + 2.5, 3 * PATIENCE, "two seconds of walking")
        assert told["x"] > start + 0.5
        assert told["velocity"][0] == pytest.approx(wanted, abs=0.3)

        # a push is in the curves
        browser.hold_key("p", "KeyP", 80, until=lambda: told["pushed"] is not None, seconds=PATIENCE)
        wait_until(lambda: told["time"] > told["pushed"] + 0.5, PATIENCE, "half a second")
        assert told["marked"] == pytest.approx(20.0)
        assert told["sideways"] > 0.3
        wait_until(lambda: told["seen"] >= 1, PATIENCE, "mark in the curves of the window")

        # an arrow key, and zero
        before = told["command"][0]
        browser.hold_key("ArrowDown", "ArrowDown", 40, until=lambda: told["command"][0] < before, seconds=PATIENCE)
        browser.hold_key("0", "Digit0", 48, until=lambda: told["command"] == [0.0, 0.0, 0.0], seconds=PATIENCE)
        assert told.place("forward m/s", 0.45) == forward  # slow or not, no panel jumped from under the mouse


PAD = """
window.pad = {index: 0, connected: true, mapping: "standard", axes: [0, 0, 0, 0],
              buttons: Array.from({length: 17}, () => ({pressed: false}))};
navigator.getGamepads = () => [null, window.pad];
"""
"""A gamepad that a test moves; Chromium without a display has no other."""


@pytest.mark.slow(*PARTS)
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")
def test_a_gamepad_drives_the_robot() -> None:
    with shown() as told, Browser(1280, 800, scale=0.1) as browser:
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=PAD)
        browser.go(told["address"])
        wait_until(lambda: bool(told.last.get("places")), PATIENCE, "panel")
        assert told["command"] == [0.0, 0.0, 0.0]
        browser.evaluate("pad.axes[1] = -1, pad.axes[2] = 0.6")
        wait_until(lambda: told["command"][0] > 0.5 and told["command"][2] < -0.2, PATIENCE, "answer to the sticks")
        browser.evaluate("pad.buttons[1].pressed = true")
        wait_until(lambda: told["pushed"] is not None, PATIENCE, "push")
        browser.evaluate("pad.axes[1] = 0.05, pad.axes[2] = 0")  # let go, and a little worn
        wait_until(lambda: told["command"] == [0.0, 0.0, 0.0], PATIENCE, "stand")


@pytest.mark.slow(*PARTS)
def test_strangers_are_refused_and_the_page_is_served() -> None:
    with shown() as told:
        here = told["address"].split("/")[2]
        for path in ("/", "/model", "/web_client.js", "/?token=guess", "/assets/ibl.ktx", "/gamepad?axes=0,-1,0,0"):
            with pytest.raises(urllib.error.HTTPError) as refused:
                urllib.request.urlopen(f"http://{here}{path}", timeout=10)
            with refused.value:
                assert refused.value.code == 403
                assert b"token" in refused.value.read()
        for path in ("/state?sid=1", "/ui?sid=1", "/drop?sid=1"):
            with pytest.raises(InvalidStatus) as closed, connect(f"ws://{here}{path}"):
                pass
            assert closed.value.response.status_code == 403
        with urllib.request.urlopen(told["address"], timeout=10) as page:
            carried = {"Cookie": page.headers["Set-Cookie"].split(";")[0]}
            assert b"<canvas" in page.read()
        state = f"ws://{here}/state?sid=1"
        stranger = Origin("http://evil.example")  # the page of another site, in the same browser
        with pytest.raises(InvalidStatus), connect(state, additional_headers=carried, origin=stranger):
            pass
        request = urllib.request.Request(f"http://{here}/model?total_bytes", headers=carried)
        with urllib.request.urlopen(request, timeout=10) as model:
            assert b"total_bytes" in model.read()
        with connect(state, additional_headers=carried, origin=Origin(f"http://{here}")) as admitted:
            assert "role=" in str(admitted.recv(timeout=10.0))


@pytest.mark.slow(*PARTS)
def test_the_command_ends_by_ctrl_c_and_a_second_one_takes_the_next_port(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from go1exp.cli import main; raise SystemExit(main())", "play", "policy=clock"]

    def start() -> subprocess.Popen[str]:
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        return subprocess.Popen([*command, "viewer=web"], cwd=tmp_path, env=ENVIRONMENT, text=True, **pipes)  # type: ignore[call-overload]

    with start() as first, start() as second:
        assert first.stdout is not None
        assert second.stdout is not None
        outputs = first.stdout, second.stdout
        opened = [output.readline() for output in outputs]
        ports = [int(line.split(":")[2].split("/")[0]) for line in opened]
        assert ports[0] != ports[1]
        assert len({line.split("token=")[1] for line in opened}) == 2
        for process, output, port in zip((first, second), outputs, ports, strict=True):
            assert f"ssh -L {port}:127.0.0.1:{port}" in output.readline()
            process.send_signal(signal.SIGINT)
            said, complained = process.communicate(timeout=60)
            assert (process.returncode, complained) == (0, "")
            assert "closed after" in said
    assert list(tmp_path.iterdir()) == []
