"""MuJoCo Studio's page in a process of its own, so that drawing panels takes no time from the robot.

Studio itself offers a thread. A robot's period is thousands of short calls, each of which lets go of the interpreter's
lock; a thread that draws panels then holds that lock for up to 5 ms each time, and the robot waits.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection

from mujoco.studio import endpoints, messages, viewer_handle
from mujoco.studio.plugin import SimPlugin

from go1exp.base.errors import Expected
from go1exp.base.signals import ending


class Mailbox:
    """One end of a pipe for Studio's messages.

    Events are sent in order. Of snapshots only the newest of each type is kept, until the other end has taken the ones
    before, so that neither end waits for the other one.
    """

    def __init__(self, pipe: Connection) -> None:
        self._pipe, self._free = pipe, True
        self.waiting: dict[type[messages.Snapshot], messages.Snapshot] = {}
        self._came: list[messages.Event] = []
        self.newest: dict[type[messages.Snapshot], messages.Snapshot] = {}
        self.over = False
        self.events, self.snapshots = _Events(self), _Snapshots(self)

    def send(self, kind: str, load: messages.Event | list[messages.Snapshot] | None = None) -> None:
        """Send something at once; nothing where the other end has gone."""
        try:
            self._pipe.send((kind, load))
        except OSError:
            self.over = True

    def pass_on(self) -> None:
        """Send the snapshots that wait, if the other end is free."""
        if self._free and self.waiting:
            self._free = False
            self.send("snapshots", list(self.waiting.values()))
            self.waiting.clear()

    def new_events(self) -> list[messages.Event]:
        """Take in all that has come, and return its events; an end of Studio where the other end has gone."""
        try:
            while self._pipe.poll():
                kind, load = self._pipe.recv()
                if kind == "event":
                    self._came.append(load)
                elif kind == "snapshots":
                    self.newest |= {type(snapshot): snapshot for snapshot in load}
                    self.send("taken")
                else:
                    self._free = True
        except (EOFError, OSError):
            self.over = True
        self.pass_on()
        if self.over:
            self._came.append(messages.ExitEvent())
        events, self._came = self._came, []
        return events

    def close(self) -> None:
        """Close this end."""
        self._pipe.close()


class _Channel:
    """One kind of a mailbox's messages by Studio's interface."""

    def __init__(self, box: Mailbox) -> None:
        self._box = box

    def close(self) -> None:
        self._box.close()


class _Events(_Channel, messages.EventChannel):
    def put(self, event: messages.Event) -> None:
        self._box.send("event", event)

    def get(self) -> list[messages.Event]:
        return self._box.new_events()


class _Snapshots(_Channel, messages.SnapshotChannel):
    def put(self, snapshot: messages.Snapshot) -> None:
        self._box.waiting[type(snapshot)] = snapshot
        self._box.pass_on()

    def reclaim_unconsumed(self, snapshot_type: type[messages.Snapshot]) -> messages.Snapshot | None:
        return self._box.waiting.pop(snapshot_type, None)

    def get(self) -> list[messages.Snapshot]:
        """Return the snapshots that arrived with the last events: never one of a model that is not loaded yet."""
        newest, self._box.newest = list(self._box.newest.values()), {}
        return newest


def _ends(box: Mailbox) -> dict[str, _Events | _Snapshots]:
    """Return a mailbox as the four channels of an endpoint of Studio: it carries both ways."""
    ways = ("s2v", "v2s")
    return {f"{way}_events": box.events for way in ways} | {f"{way}_snapshot": box.snapshots for way in ways}


def launch(target: Callable[[endpoints.ViewerEndpoint], None], plugins: list[SimPlugin]) -> viewer_handle.ViewerHandle:
    """Run a viewer in a fork, and return our handle, whose use raises ``Expected`` when the page ended by an error."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()

    def live() -> None:
        for number in ending():
            signal.signal(number, signal.SIG_IGN)  # Ctrl-C is for the robot's process, which then ends this one
        ours.close()
        target(endpoints.ViewerEndpoint(**_ends(Mailbox(theirs))))

    process = context.Process(target=live, daemon=True)
    process.start()
    theirs.close()

    def end(seconds: float) -> None:
        process.join(seconds)
        if process.is_alive():
            process.kill()
            process.join()

    def complain() -> None:
        if process.exitcode == 1:  # of an exception, which it has printed
            raise Expected("the page's process ended by an error, printed above")

    return viewer_handle.ViewerHandle(
        endpoints.SimEndpoint(**_ends(Mailbox(ours))),
        is_alive_fn=process.is_alive,
        shutdown_fn=end,
        forward_error_fn=complain,
        sim_plugins=plugins,
    )
