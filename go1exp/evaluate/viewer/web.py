"""MuJoCo Studio's web viewer behind a token, on one interface, with windows of our own.

Only this module knows how Studio starts. The loop that moves the robot runs in the calling process, the page in
another (``page_process``); they exchange messages (``Ask`` and ``Shown``), as Studio's own plugins do.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import mujoco

from go1exp.base.errors import Expected
from go1exp.evaluate.viewer.page_server import Gamepad, Gate, instructions, listening
from go1exp.evaluate.viewer.requests import Ended

FRAME_S = 1.0 / 33.0
"""Shortest frame period, s. A browser requests up to 60 frames per second, and each draws all panels."""

SLOWEST_FRAME_S = 0.1  # longest frame period, of a computer that cannot keep real time, s
DECISION_S = 1.0  # period of the adaptation of the frame period, s
LOST_SHARE = 0.02  # share of real time that the simulation may lose before the frame period grows
LONGER, SHORTER = 1.3, 0.95  # factors of the frame period with and without lost time


class PictureRate:
    """Frame period ``every``, s, that grows while the simulation loses time, and slowly shrinks again."""

    def __init__(self, now: float) -> None:
        """Start at the time ``now``, s, with the shortest frame period."""
        self.every, self._begin, self._lost = FRAME_S, now, 0.0

    def note(self, now: float, lost: float) -> bool:
        """Add ``lost`` s of lost time; return whether ``every`` has changed."""
        self._lost += lost
        passed = now - self._begin
        if passed < DECISION_S:
            return False
        before, factor = self.every, LONGER if self._lost > LOST_SHARE * passed else SHORTER
        self.every = min(max(self.every * factor, FRAME_S), SLOWEST_FRAME_S)
        self._begin, self._lost = now, 0.0
        return self.every != before


try:
    from mujoco.studio import endpoints, messages, plugin, viewer_handle, viewer_protocol, web_viewer
    from mujoco.studio.web import web_server
    from websockets.exceptions import ConnectionClosed

    from go1exp.evaluate.viewer import page_process
except ImportError as error:
    raise Expected(
        f"viewer=web needs MuJoCo Studio, which comes with the package mujoco and not with mujoco-core ({error}): "
        "pip install 'mujoco>=4'"
    ) from None

READY_S = 20.0  # longest time until the server answers, s
LAG_S = 0.1  # delay behind real time from which it is not made up, s


@dataclass(frozen=True)
class Ask(messages.Event):
    """From the window to the loop: a request of the user."""

    request: object


@dataclass(frozen=True)
class Shown(messages.Snapshot):
    """From the loop to the window: the content of the panels. Only the newest one is drawn."""

    view: object


@dataclass(frozen=True)
class Draw(messages.Event):
    """From the loop to the page: the frame period, s."""

    every: float


class Show(Protocol):
    """A simulation or a recording with its scene."""

    model: mujoco.MjModel
    data: mujoco.MjData

    def ask(self, request: Any) -> None:
        """Apply a request of the user."""

    def tick(self) -> float:
        """Advance; return the real time until the next call, s; raise ``Ended`` at the end."""

    def view(self) -> object:
        """Return the content of the panels; None if nothing has changed."""


class _Viewer(web_viewer.WebViewer):
    """Studio's viewer without models from the browser, terminal output, and with a frame period."""

    _due, _every = 0.0, FRAME_S

    def prepare_next_frame(self) -> bool:
        """Wait until a frame is due, then for the browser; return whether to draw."""
        time.sleep(max(0.0, self._due - time.monotonic()))
        wanted = super().prepare_next_frame()
        self._due = time.monotonic() + self._every
        return bool(wanted)

    def get_drop_file(self) -> str:
        """Return no file: a file dropped onto the page would replace the robot."""
        while not self._drop_queue.empty():
            self._drop_queue.get_nowait()
        return ""

    @messages.handler(priority=messages.Priority.INTERNAL)
    def _on_post_model(self, event: messages.PostModelEvent) -> None:
        self._update_model()

    @messages.handler
    def _on_draw(self, event: Draw) -> None:
        self._every = event.every


_opening = threading.Lock()


@contextmanager
def _behind(gate: Gate, pad: Gamepad, sock: socket.socket) -> Iterator[None]:
    """Let the server that is created inside use ``sock``, ``gate`` and ``pad``: Studio has no settings for them."""
    usual = web_server.serve, web_server.bind_public_socket, web_viewer._print_url_banner
    started = threading.Event()

    def serve(handler: Any, **options: Any) -> Any:
        started.set()
        guarded = gate.guarded(pad.served(options["process_request"]))
        return usual[0](handler, **{**options, "process_request": guarded})

    with _opening:
        web_server.serve = serve
        web_server.bind_public_socket = lambda host, port=0: sock
        web_viewer._print_url_banner = lambda host, port: None
        try:
            yield
            started.wait(READY_S)
        finally:
            web_server.serve, web_server.bind_public_socket, web_viewer._print_url_banner = usual


class _Messenger(plugin.SimPlugin):
    def __init__(self, show: Show) -> None:
        self._show = show

    @messages.handler
    def _on_ask(self, event: Ask) -> None:
        self._show.ask(event.request)

    @messages.handler(priority=messages.Priority.CRITICAL)
    def _on_load(self, event: messages.LoadModelEvent) -> bool:
        return True  # nothing replaces the robot


def _not_a_browser_that_left(record: logging.LogRecord) -> bool:
    """Return whether a message of the server's loop is not about a closed page."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, ConnectionClosed | ConnectionError)


def _opened(
    title: str, gate: Gate, pad: Gamepad, sock: socket.socket, windows: list[plugin.ViewerPlugin], show: Show
) -> viewer_handle.ViewerHandle:
    logging.getLogger("WebServer").setLevel(logging.WARNING)
    logging.getLogger("asyncio").addFilter(_not_a_browser_that_left)

    def target(endpoint: endpoints.ViewerEndpoint) -> None:
        with _behind(gate, pad, sock):
            viewer = _Viewer(viewer_protocol.ViewerConfig(title=title, gfx="web"), endpoint, plugins=windows)
        viewer_protocol.run_viewer_loop(viewer)

    return page_process.launch(target, [_Messenger(show)])


def _refuses_strangers(port: int, host: str) -> None:
    """Wait until the server rejects requests without a token; raise Expected if it admits them, or never answers."""
    name = host if host not in ("", "0.0.0.0", "::") else "127.0.0.1"
    address = f"http://{f'[{name}]' if ':' in name else name}:{port}/"
    ends = time.monotonic() + READY_S
    while time.monotonic() < ends:
        try:
            with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(address, timeout=2.0):
                raise Expected("this version of MuJoCo Studio answers without a token: it was closed")
        except urllib.error.HTTPError as error:
            if error.code == 403:
                return
            raise Expected(f"MuJoCo Studio answers {error.code} where it should refuse: it was closed") from None
        except OSError:
            time.sleep(0.05)
    raise Expected(f"MuJoCo Studio does not answer on {address}")


def run(
    show: Show,
    windows: list[plugin.ViewerPlugin],
    *,
    title: str,
    host: str,
    port: int,
    pad: Gamepad | None = None,
    on_open: Callable[[str], None] = print,
) -> None:
    """Run a show in the browser until Ctrl-C.

    ``windows`` are panels, which send ``Ask`` and take ``Shown``, and may read the gamepad ``pad``. ``host`` is the
    interface to listen on, at ``port`` or, for 0, the first free one. ``on_open`` gets the page's address and
    instructions. Raise Expected if the port is taken, or the server cannot be guarded.
    """
    sock = listening(host, port)
    bound = sock.getsockname()[1]
    gate = Gate(bound)
    handle = _opened(title, gate, pad or Gamepad(), sock, windows, show)
    sock.close()  # the page's process has it now
    try:
        with handle:
            handle.set_model(show.model, data=show.data)
            _refuses_strangers(bound, host)
            on_open(instructions(host, bound, gate.token))
            _loop(handle, show)
    except (KeyboardInterrupt, Ended):
        pass  # the regular end


def _loop(handle: viewer_handle.ViewerHandle, show: Show) -> None:
    due = time.perf_counter()
    rate = PictureRate(due)
    while handle.is_running():
        due += show.tick()
        now = time.perf_counter()
        lost = max(0.0, now - LAG_S - due)
        due += lost
        if rate.note(now, lost):
            handle.send_to_viewer(Draw(rate.every))
        if show.model is not handle.model:
            handle.set_model(show.model, data=show.data)
        view = show.view()
        if view is not None:
            handle.send_to_viewer(Shown(view))
        handle.sync()
        time.sleep(max(0.0, due - time.perf_counter()))
