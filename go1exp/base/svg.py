"""Matplotlib figures as SVG that may stand inside a page: nothing to load, ids of their own."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE_INCHES = 11.2
"""Width of a figure that fills the page: its type then appears 1.4 times its points in CSS pixels."""

STYLE: dict[str, Any] = {
    "svg.fonttype": "none",  # words stay words: searchable, and the page stays small
    "font.family": "sans-serif",
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.0,
    "axes.edgecolor": "#777777",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "text.parse_math": False,  # names come from users: a dollar is a dollar
    "axes.unicode_minus": True,
    "path.simplify": True,
}


def draw(name: str, alt: str, paint: Callable[[], Figure]) -> Markup:
    """Return the figure that ``paint`` makes as an ``svg`` element.

    Args:
        name: unique in the page; ids inside the figure begin with it.
        alt: what the figure shows, for those who cannot see it.
        paint: makes the figure, under this module's style.
    """
    import matplotlib

    buffer = io.StringIO()
    style: Any = {**STYLE, "svg.hashsalt": name}  # its type would list all settings of Matplotlib
    with matplotlib.rc_context(style), warnings.catch_warnings():
        # A glyph that this machine's font lacks is drawn by the reader's browser all the same.
        warnings.filterwarnings("ignore", message=r"Glyph \d+", category=UserWarning)
        nothing = {"Date": None, "Creator": None, "Format": None, "Type": None}
        paint().savefig(buffer, format="svg", metadata=nothing)
    source = buffer.getvalue()
    source = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", source[source.index("<svg") :], flags=re.DOTALL)
    head, rest = source.split(">", 1)
    box = re.search(r'viewBox="[\d. -]+"', head)
    assert box is not None
    rest = _own_ids(rest, name)
    # Hundredths of a point are finer than any screen.
    rest = re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path.group()), rest)
    rest = re.sub(r"\n\s*", "\n", rest)
    return Markup('<svg {} role="img" aria-label="{}">').format(Markup(box.group()), alt) + Markup(rest.strip())


def _own_ids(source: str, name: str) -> str:
    """Number the ids that something refers to, under ``name``, and drop the others."""
    used = dict.fromkeys(re.findall(r'(?:url\(#|href="#)([\w-]+)', source))
    numbered = {old: f"{name}-{k}" for k, old in enumerate(used)}

    def unique(match: re.Match[str]) -> str:
        return f' id="{numbered[match[1]]}"' if match[1] in numbered else ""

    source = re.sub(r' id="([^"]*)"', unique, source)
    return re.sub(r'(url\(#|href="#)([\w-]+)', lambda match: match[1] + numbered[match[2]], source)
