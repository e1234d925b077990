"""The robot in the browser: frames that reach one, with the robot in real time, and time to the first picture.

    taskset -c 0,1 python -m benchmarks.viewer [--seconds 30] [--drawn]

Chromium without a graphics card draws one or two pictures a second on two cores and leaves nothing for the robot. So
its drawing calls do nothing here and its page has few pixels, as if a card drew it: what is counted is what the server
sends and the page takes in, by the messages on its two connections. ``--drawn`` leaves drawing as it is, for the time
to the first picture.
"""

from __future__ import annotations

import argparse
import time

from tests.browser import Browser, wait_until
from tests.test_viewer_browser import shown

COUNT = """
window.counted = {ui: 0, state: 0, bytes: 0};
const Usual = window.WebSocket;
window.WebSocket = function (address, ...rest) {
  const socket = new Usual(address, ...rest), kind = address.includes("/ui") ? "ui" : "state";
  socket.addEventListener("message", (e) => {
    if (typeof e.data !== "string") { counted[kind] += 1; counted.bytes += e.data.byteLength || e.data.size || 0; }
  });
  return socket;
};
Object.assign(window.WebSocket, Usual);
window.WebSocket.prototype = Usual.prototype;
"""

NO_DRAWING = """
for (const name of ["drawElements", "drawArrays", "drawElementsInstanced", "drawArraysInstanced", "drawRangeElements",
                    "clear", "blitFramebuffer", "generateMipmap"])
  WebGL2RenderingContext.prototype[name] = function () {};
"""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="how long to count")
    parser.add_argument("--drawn", action="store_true", help="let Chromium draw in software")
    options = parser.parse_args()
    with shown() as page, Browser(1280, 800, scale=1.0 if options.drawn else 0.1) as browser:
        script = COUNT + ("" if options.drawn else NO_DRAWING)
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=script)
        start = time.monotonic()
        browser.go(page["address"])
        wait_until(lambda: bool(page.last.get("places")), 120.0, "panels")
        print(f"panels sent after {time.monotonic() - start:.1f} s")
        if options.drawn:
            wait_until(lambda: browser.screenshot().std() > 15.0, 120.0, "picture")
            print(f"first picture after {time.monotonic() - start:.1f} s")
        time.sleep(5.0)
        before, before_values, then = browser.evaluate("({...counted})"), dict(page.last), time.monotonic()
        time.sleep(options.seconds)
        after, elapsed = browser.evaluate("({...counted})"), time.monotonic() - then
        rate = {name: (after[name] - before[name]) / elapsed for name in before}
        passed = {name: page[name] - before_values[name] for name in ("time", "robot_cpu_s", "page_cpu_s")}
        print(f"robot: {passed['time'] / elapsed:.2f} s per s, over {elapsed:.0f} s")
        print(
            f"processor time of the robot: {passed['robot_cpu_s'] / passed['time']:.2f} s for each of its seconds; "
            f"of the page: {passed['page_cpu_s'] / elapsed:.2f} s per s"
        )
        print(
            f"to the browser: {rate['state']:.1f} states/s, {rate['ui']:.1f} panels/s, {rate['bytes'] / 1e3:.0f} kB/s"
        )


if __name__ == "__main__":
    main()
