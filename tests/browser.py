"""A real Chromium without a display, driven by its DevTools protocol."""

from __future__ import annotations

import base64
import io
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")

SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
"""WebGL 2 without a graphics card."""

SLOWEST = 180.0
"""How long a page may take to answer that draws without a graphics card beside other work, s."""


class Browser:
    """One page.

    Args:
        width: of the window, pixels.
        height: of the window, pixels.
        scale: pixels that are drawn for each of these, in either direction.
    """

    def __init__(self, width: int = 1280, height: int = 800, scale: float = 1.0) -> None:
        assert CHROMIUM is not None
        self._folder = tempfile.TemporaryDirectory(prefix="chromium_", ignore_cleanup_errors=True)
        flags = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--remote-debugging-port=0", *SOFTWARE_GL)
        size = (f"--window-size={width},{height}", f"--user-data-dir={self._folder.name}")
        self._process = subprocess.Popen(
            [CHROMIUM, *flags, *size, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self._number, self._open = 0, ExitStack()
        self.messages: list[str] = []
        """What the page has written to its console."""
        try:
            self._page = self._connected()
        except BaseException:
            self.close()
            raise
        self.call("Page.enable")
        self.call("Runtime.enable")
        about = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **about)

    def _connected(self) -> ClientConnection:
        """Wait for Chromium to listen, and return a connection to its page."""
        port_file = Path(self._folder.name) / "DevToolsActivePort"
        wait_until(lambda: port_file.is_file() and len(port_file.read_text().splitlines()) > 1, 30.0, "Chromium")
        port = port_file.read_text().splitlines()[0]

        def pages() -> list[dict[str, Any]]:
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=10) as answer:
                return [target for target in json.load(answer) if target["type"] == "page"]

        wait_until(lambda: bool(pages()), 30.0, "a page of Chromium")
        page = connect(pages()[0]["webSocketDebuggerUrl"], max_size=2**26, compression=None, ping_interval=None)
        return self._open.enter_context(page)

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        self._open.close()
        self._process.terminate()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._folder.cleanup()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol and return its answer."""
        self._number += 1
        self._page.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._page.recv(timeout=SLOWEST))
            if answer.get("method") == "Runtime.consoleAPICalled":
                self.messages.append(" ".join(str(a.get("value", "")) for a in answer["params"]["args"]))
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return dict(answer["result"])

    def go(self, address: str) -> None:
        self.call("Page.navigate", url=address)
        wait_until(lambda: self.evaluate("document.body !== null") is True, 60.0, f"page of {address}")

    def evaluate(self, expression: str) -> Any:
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(str(answer["exceptionDetails"]))
        return answer["result"].get("value")

    def screenshot(self) -> NDArray[np.uint8]:
        """Return what is seen, (H, W, 3)."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def hold(self, point: Callable[[], tuple[float, float]], *, until: Callable[[], bool], seconds: float) -> None:
        """Press the left mouse button at a point until something is so, and again each 20 s, as people do.

        A slow page looks at the mouse now and then.
        """
        end = time.monotonic() + seconds
        while True:
            x, y = point()
            about = {"x": x, "y": y, "button": "left", "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
            time.sleep(1.0)
            self.call("Input.dispatchMouseEvent", type="mousePressed", buttons=1, **about)
            try:
                wait_until(until, min(20.0, max(end - time.monotonic(), 0.0)), "answer to the mouse")
                return
            except AssertionError:
                if time.monotonic() > end:
                    raise
            finally:
                self.call("Input.dispatchMouseEvent", type="mouseReleased", **about)
            time.sleep(1.0)

    def hold_key(self, key: str, code: str, number: int, *, until: Callable[[], bool], seconds: float) -> None:
        """Press a key until something is so, by the three names that browsers have for it."""
        about = {"key": key, "code": code, "windowsVirtualKeyCode": number, "nativeVirtualKeyCode": number}
        self.call("Input.dispatchKeyEvent", type="rawKeyDown", **about)
        try:
            wait_until(until, seconds, f"answer to {key}")
        finally:
            self.call("Input.dispatchKeyEvent", type="keyUp", **about)


def wait_until(true: Callable[[], bool], seconds: float, what: str) -> float:
    """Wait until something is so, and return how long that took, s; fail after ``seconds``."""
    start = time.monotonic()
    while not true():
        if time.monotonic() - start > seconds:
            raise AssertionError(f"no {what} within {seconds:g} s")
        time.sleep(0.05)
    return time.monotonic() - start
