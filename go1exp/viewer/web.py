"""MuJoCo Studio's web viewer behind a token, on one interface, with windows of our own.

Only this module knows how Studio starts. The loop that moves the robot runs in the calling thread, the window's in
another; they exchange messages (``Ask`` and ``Shown``), as Studio's own plugins do.
"""

from __future__ import annotations

import logging
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import mujoco

from go1exp.errors import Expected
from go1exp.viewer.gate import Gate, listening, words
from go1exp.viewer.requests import Ended

try:
    from mujoco.studio import launch_thread, messages, plugin, viewer_handle, viewer_protocol, web_viewer
    from mujoco.studio.web import web_server
    from websockets.exceptions import ConnectionClosed
except ImportError as error:
    raise Expected(
        f"viewer=web needs MuJoCo Studio, which comes with the package mujoco and not with mujoco-core ({error}): "
        "pip install 'mujoco>=4'"
    ) from None

READY_S = 20.0
"""How long the server may take to answer, s."""

LAG_S = 0.1
"""Time by which the robot may be late before that time is given up, s."""


@dataclass(frozen=True)
class Ask(messages.Event):
    """From the window to the loop: what a user asks for."""

    request: Any


@dataclass(frozen=True)
class Shown(messages.Snapshot):
    """From the loop to the window: what is to be drawn. The newest one counts."""

    view: Any


class Show(Protocol):
    """Something that passes time and is seen: ``session.Session`` with its scene, or a recording."""

    model: mujoco.MjModel
    data: mujoco.MjData

    def ask(self, request: Any) -> None:
        """Do what a user asks for."""

    def tick(self) -> float:
        """Let a moment pass, and return how long it is in real time, s; raises ``Ended`` when all is over."""

    def view(self) -> Any | None:
        """Return what the window shall draw; None if nothing has changed."""


class _Viewer(web_viewer.WebViewer):
    """Studio's viewer, which takes no models from the browser and says nothing on the terminal."""

    def get_drop_file(self) -> str:
        """Return no file: what is dropped onto the page would replace the robot."""
        while not self._drop_queue.empty():
            self._drop_queue.get_nowait()
        return ""

    @messages.handler(priority=messages.Priority.INTERNAL)
    def _on_post_model(self, event: messages.PostModelEvent) -> None:
        self._update_model()


_opening = threading.Lock()


@contextmanager
def _behind(gate: Gate, sock: Any) -> Iterator[None]:
    """Let the server that is made inside use ``sock`` and ask ``gate``.

    Studio has settings for neither yet. ``_refuses_strangers`` sees to it that the gate is in force in what runs.
    """
    usual = web_server.serve, web_server.bind_public_socket, web_viewer._print_url_banner
    started = threading.Event()

    def serve(handler: Any, **options: Any) -> Any:
        started.set()
        return usual[0](handler, **{**options, "process_request": gate.guarded(options["process_request"])})

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
    """Collects what the window asks for."""

    def __init__(self, show: Show) -> None:
        self._show = show

    @messages.handler
    def _on_ask(self, event: Ask) -> None:
        self._show.ask(event.request)

    @messages.handler(priority=messages.Priority.CRITICAL)
    def _on_load(self, event: messages.LoadModelEvent) -> bool:
        return True  # the robot is ours: nothing is loaded over it


def _not_a_browser_that_left(record: logging.LogRecord) -> bool:
    """Return whether a message of the server's loop is about anything else than a page that was closed."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, ConnectionClosed | ConnectionError)


def _opened(
    title: str, gate: Gate, sock: Any, windows: list[plugin.ViewerPlugin], show: Show
) -> viewer_handle.ViewerHandle:
    """Start Studio's viewer in a thread of its own."""
    logging.getLogger("WebServer").setLevel(logging.WARNING)
    logging.getLogger("asyncio").addFilter(_not_a_browser_that_left)

    def target(endpoint: Any) -> None:
        with _behind(gate, sock):
            viewer = _Viewer(viewer_protocol.ViewerConfig(title=title, gfx="web"), endpoint, plugins=windows)
        viewer_protocol.run_viewer_loop(viewer)

    return launch_thread.launch_thread(target, sim_plugins=[_Messenger(show)])


def _refuses_strangers(port: int, host: str) -> None:
    """Wait for the server and make sure that it refuses who has no token.

    Raises:
        Expected: if it does not answer, or shows itself to anyone.
    """
    name = host if host not in ("", "0.0.0.0", "::") else "127.0.0.1"
    address = f"http://{f'[{name}]' if ':' in name else name}:{port}/"
    ends = time.monotonic() + READY_S
    while time.monotonic() < ends:
        try:
            with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(address, timeout=2.0):
                raise Expected("this version of MuJoCo Studio shows itself without a token: it was closed")
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
    on_open: Callable[[str], None] = print,
) -> None:
    """Show something in the browser until Ctrl-C.

    Args:
        show: what.
        windows: panels, which send ``Ask`` and take ``Shown``.
        title: of the page.
        host: interface to listen on.
        port: to listen on; 0 takes the first free one.
        on_open: called with the text that says where to look.

    Raises:
        Expected: if the port is taken, or the server cannot be guarded.
    """
    sock = listening(host, port)
    bound = sock.getsockname()[1]
    gate = Gate(bound)
    handle = _opened(title, gate, sock, windows, show)
    try:
        with handle:
            handle.set_model(show.model, data=show.data)
            _refuses_strangers(bound, host)
            on_open(words(host, bound, gate.token))
            _loop(handle, show)
    except (KeyboardInterrupt, Ended):
        pass  # the way to end it, or its time is over


def _loop(handle: viewer_handle.ViewerHandle, show: Show) -> None:
    """Let time pass, in step with the clock."""
    due = time.perf_counter()
    while handle.is_running():
        due = max(due + show.tick(), time.perf_counter() - LAG_S)
        if show.model is not handle.model:
            handle.set_model(show.model, data=show.data)
        view = show.view()
        if view is not None:
            handle.send_to_viewer(Shown(view))
        handle.sync()
        time.sleep(max(0.0, due - time.perf_counter()))
