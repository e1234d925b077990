"""A gamepad at the browser's computer: the page's script reads it and tells the server.

MuJoCo Studio's page asks no browser for its gamepads, though its panels would know their keys. So a script of ours is
added to the page. It uses the Gamepad API (https://www.w3.org/TR/gamepad/) and tells what has changed in the query of
``/gamepad``, which passes the same gate as everything else.
"""

from __future__ import annotations

import http
import math
import time
import urllib.parse
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import Any

PATH = "/gamepad"
"""Where the page's script tells of it."""

AXES = (1, 0, 2)
"""Axis of each part of the command in the standard mapping: left stick up and left, right stick left are -1."""

DEAD = 0.15
"""Share of a stick's way that counts as let go: worn sticks do not come back to their middle."""

SILENT_S = 1.0
"""After so long without a word a held stick counts as let go, s: its page may be gone. The script says it twice."""

STAND, PUSH = 0, 1
"""Buttons of the standard mapping: the lower one and the right one of the four."""

SCRIPT = f"""<script>
(() => {{
  let said = "", at = 0, busy = false;
  setInterval(() => {{
    const pad = [...navigator.getGamepads()].find((p) => p && p.connected && p.mapping === "standard");
    if (!pad || busy) return;
    const axes = pad.axes.slice(0, 4).map((v) => v.toFixed(2)).join();
    const held = pad.buttons.map((b, k) => (b.pressed ? k : -1)).filter((k) => k >= 0).join();
    const word = `axes=${{axes}}&held=${{held}}`, now = performance.now();
    const resting = pad.axes.every((v) => Math.abs(v) < {DEAD});
    if (word === said && (resting || now - at < {500.0 * SILENT_S})) return;
    [said, at, busy] = [word, now, true];
    fetch("{PATH}?" + word).catch(() => {{ said = ""; }}).finally(() => {{ busy = false; }});
  }}, 40);
}})();
</script>
"""
"""Tells of the first gamepad 25 times a second at most, while something changes or a stick is held."""


class Gamepad:
    """What the gamepad last said. The server's thread writes it, the window's reads it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Know no gamepad yet."""
        self._clock, self._heard = clock, -math.inf
        self._axes: tuple[float, ...] = ()
        self._held: frozenset[int] = frozenset()
        self._presses: deque[int] = deque(maxlen=20)

    def hear(self, query: str) -> bool:
        """Take in what the script says; return whether it is understood."""
        words = urllib.parse.parse_qs(query)
        try:
            axes = tuple(float(v) for v in words["axes"][0].split(","))
            held = frozenset(int(k) for k in words["held"][0].split(",")) if "held" in words else frozenset()
        except (KeyError, ValueError):
            return False
        if not all(-1.0 <= v <= 1.0 for v in axes):  # NaN too
            return False
        self._presses.extend(sorted(held - self._held))
        self._axes, self._held, self._heard = axes, held, self._clock()
        return True

    def presses(self) -> list[int]:
        """Return the buttons that were pressed since the call before."""
        return [self._presses.popleft() for _ in range(len(self._presses))]

    def sticks(self) -> tuple[float, ...] | None:
        """Return how far each part of the command is pushed, -1 to 1; None while no stick is held."""
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
    """Return the command of sticks that are pushed so far: a stick at its end asks for the slider's end."""
    return [v * high if v > 0.0 else -v * low for v, (low, high) in zip(pushed, limits, strict=True)]
