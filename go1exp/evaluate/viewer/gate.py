"""Who may look: a token in the address, which becomes a cookie; and the socket that is listened on.

MuJoCo Studio's server asks nobody who they are and listens on every interface. Whoever reaches it drives the robot.
"""

from __future__ import annotations

import http
import secrets
import socket
import urllib.parse
from collections.abc import Awaitable, Callable, Coroutine
from http.cookies import CookieError, SimpleCookie
from typing import Any

from go1exp.base.errors import Expected

FIRST_PORT, PORTS = 8080, 20
"""Where a free port is looked for, and among how many."""

REFUSAL = "go1exp: open the address that the command printed; without the token in it nothing is shown\n"

LOOPBACK = ("127.0.0.1", "::1", "localhost")


class Gate:
    """Lets in requests that carry the token: in the address, or as the cookie that a page with it was given.

    Another page in the same browser can neither read the cookie nor open a connection with it: the cookie is of this
    server's pages alone, and a connection from a page of another origin is refused.
    """

    def __init__(self, port: int) -> None:
        """Make a token that nobody can guess."""
        self.token = secrets.token_urlsafe(16)
        self._cookie = f"go1exp_{port}"  # cookies are shared by all ports of a host

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

    @property
    def header(self) -> str:
        """Value of ``Set-Cookie``: of this site's own requests alone, and not for the page's scripts."""
        return f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def guarded(self, process: Callable[..., Awaitable[Any] | Any]) -> Callable[..., Coroutine[Any, Any, Any]]:
        """Return a ``process_request`` of a server of the package ``websockets`` that answers 403 to the others."""

        async def process_request(connection: Any, request: Any) -> Any:
            headers = request.headers
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

    Raises:
        Expected: if there is none, or the host is not of this machine.
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


def words(host: str, port: int, token: str) -> str:
    """Say where to look, and how to get there from another computer."""
    everywhere = host in ("", "0.0.0.0", "::")
    name = "127.0.0.1" if host in LOOPBACK else socket.gethostname() if everywhere else host
    name = f"[{name}]" if ":" in name else name
    address = f"http://{name}:{port}/?token={token}"
    lines = [f"open   {address}"]
    if host in LOOPBACK:
        tunnel = f"ssh -L {port}:127.0.0.1:{port} {socket.gethostname()}"
        lines.append(f"from another computer: {tunnel}   and open the same address there")
    else:
        lines.append(f"anyone who can reach {name}:{port} and knows the token can drive it; nothing is encrypted")
    return "\n".join([*lines, "Ctrl-C ends it"])
