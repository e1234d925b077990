"""What the page's server adds to MuJoCo Studio's: a token, a socket on one interface, and the browser's gamepad.

Studio's server has no authentication and listens on every interface. Its page does not read gamepads, so a script is
added to it. The script uses the Gamepad API (https://www.w3.org/TR/gamepad/) and sends changes in the query of
``/gamepad``, which needs the token too.
"""

from __future__ import annotations

import http
import math
import secrets
import socket
import time
import urllib.parse
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from http.cookies import CookieError, SimpleCookie
from typing import Any

from go1exp.base.errors import Expected

FIRST_PORT, PORTS = 8080, 20  # first port and number of ports of the search for a free one
REFUSAL = "go1exp: open the address that the command printed; without the token in it nothing is shown\n"
LOOPBACK = ("127.0.0.1", "::1", "localhost")


class Gate:
    """Accepts requests with the token: in the address, or as the cookie of a page that was opened with it.

    Another page in the same browser can neither read the cookie nor open a connection with it: the cookie is of this
    server's pages alone, and a connection from a page of another origin is refused.
    """

    def __init__(self, port: int) -> None:
        self.token = secrets.token_urlsafe(16)
        self._cookie = f"go1exp_{port}"  # cookies are shared by all ports of a host
        # Value of ``Set-Cookie``: of this site's own requests alone, and not for the page's scripts.
        self.header = f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def admits(self, path: str, cookie: str, origin: str | None, host: str) -> bool:
        """Return whether a request may pass, by its path with query and three of its headers."""
        if origin is not None and urllib.parse.urlsplit(origin).netloc != host:
            return False
        try:
            kept = SimpleCookie(cookie).get(self._cookie)
        except CookieError:
            kept = None
        query = urllib.parse.parse_qs(urllib.parse.urlsplit(path).query)
        given = [*query.get("token", ()), *([kept.value] if kept else ())]
        return any(secrets.compare_digest(word.encode(), self.token.encode()) for word in given)

    def guarded(self, process: Callable[..., Awaitable[Any] | Any]) -> Callable[..., Coroutine[Any, Any, Any]]:
        """Return a ``process_request`` of a server of the package ``websockets`` that answers 403 to the others."""

        async def process_request(connection: Any, request: Any) -> Any:
            headers = request.headers
            if any(len(headers.get_all(name)) > 1 for name in ("Host", "Origin")):
                return connection.respond(http.HTTPStatus.BAD_REQUEST, "go1exp: one Host and one Origin at most\n")
            cookie = "; ".join(headers.get_all("Cookie"))
            if not self.admits(request.path, cookie, headers.get("Origin"), headers.get("Host", "")):
                return connection.respond(http.HTTPStatus.FORBIDDEN, REFUSAL)
            given = process(connection, request)
            answer = await given if isinstance(given, Awaitable) else given
            if answer is not None:
                answer.headers["Set-Cookie"] = self.header
                answer.headers["Referrer-Policy"] = "no-referrer"
            return answer

        return process_request


def listening(host: str, port: int) -> socket.socket:
    """Return a socket that listens on ``host``, at ``port`` or for 0 at the first free one from ``FIRST_PORT`` on.

    Raise Expected if there is none, or the host is not of this machine.
    """
    try:
        about = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except OSError as error:
        raise Expected(f"host = {host!r}: {error.strerror or error}; 127.0.0.1 is this machine alone") from None
    family, address = about[0], about[4][0]
    problem = ""
    for candidate in [port] if port else range(FIRST_PORT, FIRST_PORT + PORTS):
        sock = socket.socket(family, socket.SOCK_STREAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            sock.bind((address, candidate))
            sock.listen()  # at once: only a socket that listens keeps others from the port
            return sock
        except OSError as error:
            sock.close()
            problem = error.strerror or str(error)
    where = f"port = {port}" if port else f"ports {FIRST_PORT} to {FIRST_PORT + PORTS - 1} of {host}"
    raise Expected(f"{where}: cannot be listened on ({problem}); port=0 takes the first free one from {FIRST_PORT}")


def instructions(host: str, port: int, token: str) -> str:
    """Return the page's address, and the way to it from another computer."""
    everywhere = host in ("", "0.0.0.0", "::")
    name = "127.0.0.1" if host in LOOPBACK else socket.gethostname() if everywhere else host
    name = f"[{name}]" if ":" in name else name
    address = f"http://{name}:{port}/?token={token}"
    lines = [f"open   {address}"]
    if host in LOOPBACK:
        tunnel = f"ssh -L {port}:127.0.0.1:{port} {socket.gethostname()}"
        lines.append(f"from another computer: {tunnel}   and open the same address there")
    else:
        lines.append(f"anyone who can reach {name}:{port} and knows the token can command it; nothing is encrypted")
    return "\n".join([*lines, "Ctrl-C ends it"])


PATH = "/gamepad"  # path to which the script sends

AXES = (1, 0, 2)
"""Axis of each part of the command in the standard mapping: left stick up and left, right stick left are -1."""

DEAD = 0.15  # dead zone of a stick: worn sticks do not return to their centre

SILENT_S = 1.0
"""Time without a message after which a held stick counts as released, s. The script sends twice as often."""

STAND, PUSH = 0, 1  # buttons of the standard mapping: the lower one and the right one of the four

SCRIPT = f"""<script>
(() => {{
  let sent = "", at = 0, busy = false;
  setInterval(() => {{
    const pad = [...navigator.getGamepads()].find((p) => p && p.connected && p.mapping === "standard");
    if (!pad || busy) return;
    const axes = pad.axes.slice(0, 4).map((v) => v.toFixed(2)).join();
    const held = pad.buttons.map((b, k) => (b.pressed ? k : -1)).filter((k) => k >= 0).join();
    const word = `axes=${{axes}}&held=${{held}}`, now = performance.now();
    const resting = pad.axes.every((v) => Math.abs(v) < {DEAD});
    if (word === sent && (resting || now - at < {500.0 * SILENT_S})) return;
    [sent, at, busy] = [word, now, true];
    fetch("{PATH}?" + word).catch(() => {{ sent = ""; }}).finally(() => {{ busy = false; }});
  }}, 40);
}})();
</script>
"""
"""Sends the first gamepad's state at most 25 times a second, while it changes or a stick is held."""


class Gamepad:
    """State of the gamepad. The server's thread writes it, the window's reads it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._heard = clock, -math.inf
        self._axes: tuple[float, ...] = ()
        self._held: frozenset[int] = frozenset()
        self._presses: deque[int] = deque(maxlen=20)

    def hear(self, query: str) -> bool:
        """Parse a message of the script; return whether it is valid."""
        fields = urllib.parse.parse_qs(query)
        try:
            axes = tuple(float(v) for v in fields["axes"][0].split(","))
            held = frozenset(int(k) for k in fields["held"][0].split(",")) if "held" in fields else frozenset()
        except (KeyError, ValueError):
            return False
        if not all(-1.0 <= v <= 1.0 for v in axes):  # NaN too
            return False
        self._presses.extend(sorted(held - self._held))
        self._axes, self._held, self._heard = axes, held, self._clock()
        return True

    def presses(self) -> list[int]:
        """Return the buttons pressed since the last call."""
        return [self._presses.popleft() for _ in range(len(self._presses))]

    def sticks(self) -> tuple[float, ...] | None:
        """Return the stick deflection of each axis of the command, -1 to 1; None while no stick is held."""
        if self._clock() - self._heard > SILENT_S or len(self._axes) <= max(AXES):
            return None
        pushed = tuple(
            -math.copysign(max(0.0, abs(v) - DEAD) / (1.0 - DEAD), v) for v in map(self._axes.__getitem__, AXES)
        )
        return pushed if any(pushed) else None

    def served(self, process: Callable[..., Awaitable[Any] | Any]) -> Callable[..., Coroutine[Any, Any, Any]]:
        """Return a ``process_request`` as in ``gate`` that hears the script, and adds it to the page."""

        async def process_request(connection: Any, request: Any) -> Any:
            parts = urllib.parse.urlsplit(request.path)
            if parts.path == PATH:
                known = self.hear(parts.query)
                return connection.respond(http.HTTPStatus.OK if known else http.HTTPStatus.BAD_REQUEST, "")
            given = process(connection, request)
            answer = await given if isinstance(given, Awaitable) else given
            if answer is not None and parts.path in ("/", "/index.html"):
                answer.body = answer.body.replace(b"</body>", SCRIPT.encode() + b"</body>")
                del answer.headers["Content-Length"]
                answer.headers["Content-Length"] = str(len(answer.body))
            return answer

        return process_request


def steered(pushed: Sequence[float], limits: Sequence[tuple[float, float]]) -> list[float]:
    """Return the command of pushed sticks: a stick at its end commands the slider's end."""
    return [v * high if v > 0.0 else -v * low for v, (low, high) in zip(pushed, limits, strict=True)]
