"""The robot of ``policy=clock`` on a page, in a process of its own, which says what it does in lines of JSON.

The page's process says in the same way what its window draws.

MuJoCo Studio has one window in a process, and shuts it down when the garbage collector comes to it.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import torch

from go1exp.evaluate.viewer import web
from go1exp.evaluate.viewer.drive_window import DriveWindow
from go1exp.evaluate.viewer.page_server import Gamepad
from go1exp.evaluate.viewer.requests import Setup
from go1exp.evaluate.viewer.session import Session
from go1exp.evaluate.viewer.walk import WalkShow
from tests.test_viewer import clock_robots

EVERY_S = 0.1


class Sayer:
    """Says something in a line of JSON, not too often."""

    def __init__(self) -> None:
        self._said = 0.0

    def __call__(self, told: Callable[[], dict[str, Any]]) -> None:
        if time.monotonic() - self._said > EVERY_S:
            self._said = time.monotonic()
            sys.stdout.write(json.dumps(told()) + "\n")  # one call, so that lines of the two processes do not mix
            sys.stdout.flush()


class Telling(WalkShow):
    """A show that says how it goes."""

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        self._say = Sayer()

    def tick(self) -> float:
        moment = super().tick()
        self._say(self._told)
        return moment

    def _told(self) -> dict[str, Any]:
        s = self.session
        told: dict[str, Any] = {"time": s.time, "command": s.command, "x": float(s.core.backend.qpos[0, 0])}
        told["velocity"] = s.history.last("true", 1.0).mean(0).tolist()
        sideways = s.history.last("true", min(s.time - s.push.time, 5.0))[:, 1] if s.push.impulse else [0.0]
        told |= {"pushed": s.push.time if s.push.impulse else None, "sideways": max(sideways)}
        told |= {"marked": float(s.history.series("push").max()), "robot_cpu_s": time.process_time()}
        return told


class TellingWindow(DriveWindow):
    """A window that says, from the page's process, what it draws and where."""

    def __init__(self, pad: Gamepad) -> None:
        super().__init__(pad)
        self._say = Sayer()

    def right(self) -> None:
        super().right()
        seen = len(self.view.pushes)
        self._say(lambda: {"seen": seen, "places": self.places, "page_cpu_s": time.process_time()})


def main() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where pytest runs in a shell's background
    torch.set_num_threads(1)
    robots = clock_robots()
    session = Session(robots, "clock", Setup(), (0.0, 0.0, 0.0))
    pad = Gamepad()
    web.run(
        Telling(session),
        [TellingWindow(pad)],
        pad=pad,
        title="test",
        host="127.0.0.1",
        port=0,
        on_open=lambda text: print(json.dumps({"address": text.split()[1]}), flush=True),
    )


if __name__ == "__main__":
    main()
