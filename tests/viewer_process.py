"""The robot of ``policy=trot`` on a page, in a process of its own, which says what it does in lines of JSON.

MuJoCo Studio has one window in a process, and shuts it down when the garbage collector comes to it.
"""

from __future__ import annotations

import json
import time

import torch

from go1exp.cli.play_web import _drivers, _effects, _grounds
from go1exp.cli.subjects import driver, named
from go1exp.viewer import web
from go1exp.viewer.conditions import Setup
from go1exp.viewer.drive_window import DriveWindow
from go1exp.viewer.session import Robots, Session
from go1exp.viewer.walk import WalkShow

EVERY_S = 0.1


class Telling(WalkShow):
    """A show that says how it goes."""

    def __init__(self, session: Session, window: DriveWindow) -> None:
        super().__init__(session)
        self._window, self._said = window, 0.0

    def tick(self) -> float:
        moment = super().tick()
        if time.monotonic() - self._said > EVERY_S:
            self._said = time.monotonic()
            s = self.session
            told = {"time": s.time, "command": s.command, "x": s.qpos()[0], "velocity": s.velocity(1.0).tolist()}
            sideways = s.history.last("true", min(s.time - s.push.time, 5.0))[:, 1] if s.push.impulse else [0.0]
            told |= {"pushed": s.push.time if s.push.impulse else None, "sideways": max(sideways)}
            seen = len(self._window.view.pushes) if self._window.view is not None else 0
            told |= {"marked": float(s.history.series("push").max()), "seen": seen, "places": self._window.places}
            print(json.dumps(told), flush=True)
        return moment


def main() -> None:
    torch.set_num_threads(1)
    first = driver(named(None, "trot", None, None, "play.mp4"), {})
    subject = named(None, "trot", None, None, "play.mp4")
    robots = Robots(_drivers(subject, first, {}), _grounds(None)[1], _effects(first.task, False)[0])
    session, window = Session(robots, "trot", Setup(), (0.0, 0.0, 0.0)), DriveWindow()
    web.run(
        Telling(session, window),
        [window],
        title="test",
        host="127.0.0.1",
        port=0,
        on_open=lambda text: print(json.dumps({"address": text.split()[1]}), flush=True),
    )


if __name__ == "__main__":
    main()
