"""Sphinx configuration of the documentation: ``make docs``. No page loads anything from another computer."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import reference  # noqa: E402  (docs/reference.py)

from go1exp import __version__  # noqa: E402

reference.write(HERE / "reference")

project = "go1exp"
author = "go1exp developers"
copyright = "2026, the go1exp developers"
release = __version__
extensions = ["myst_parser"]
exclude_patterns = ["results"]
highlight_language = "none"
suppress_warnings = ["misc.highlighting_failure"]  # there is no highlighter of CSV

myst_heading_anchors = 4
myst_enable_extensions = ["deflist"]

html_theme = "furo"
html_title = f"go1exp {release}"
html_static_path: list[str] = []
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {"footer_icons": [], "navigation_with_keys": True}
