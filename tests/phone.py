"""A page of a report in a frame of a phone's width: a window of a browser cannot be that narrow everywhere."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest

PHONE = 390
"""Width, CSS pixels."""

needs_chromium = pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")

MEASURE = """
<script>addEventListener("load", () => {
  const all = [...document.querySelectorAll("body, body *:not(svg *), svg text")];
  const wide = all.filter(e => { const r = e.getBoundingClientRect();
    return r.right > innerWidth + 0.5 || r.left < -0.5 || !e.closest("svg") && e.scrollWidth > e.clientWidth + 1; });
  const say = e => e.tagName + " " + e.textContent.trim().slice(0, 40);
  parent.postMessage({width: innerWidth, all: all.length, drawings: document.querySelectorAll("figure svg").length,
    verdicts: document.querySelectorAll("td .word").length, page: document.documentElement.scrollWidth,
    empty: [...document.querySelectorAll("svg")].filter(e => e.getBoundingClientRect().height < 20).length,
    wide: wide.filter(e => !e.closest(".heat, .scroll")).map(say)}, "*");
});</script>
"""

FRAME = f"""<!DOCTYPE html><body><script>addEventListener("message", e => {{
  const text = document.createElement("pre"); text.textContent = JSON.stringify(e.data);
  document.body.append(text); }});
</script><iframe src="page.html" style="width:{PHONE}px;height:2000px;border:0"></iframe></body>"""


def on_a_phone(text: str, folder: Path) -> dict[str, Any]:
    """Return counts of elements of a page, and those that are wider than the screen."""
    (folder / "page.html").write_text(text.replace("</body>", f"{MEASURE}</body>"))
    (folder / "frame.html").write_text(FRAME)
    with tempfile.TemporaryDirectory() as profile:
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]
        where = [f"--user-data-dir={profile}", "--virtual-time-budget=5000", "--dump-dom"]
        command = ["chromium", *flags, *where, (folder / "frame.html").as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    found = re.search(r"<pre>(.*?)</pre>", done.stdout, re.DOTALL)
    assert found, done.stderr
    measured: dict[str, Any] = json.loads(html.unescape(found[1]))
    return measured
