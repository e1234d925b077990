"""Figures of all reports: one style, the colours of Okabe and Ito, and SVG that stands inside a page."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, WIDE, PAGE = 4.7, 7.0, 11.2
"""Inches: of a figure that is legible on a phone, of a wide one, and of one that fills the page."""

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5a6169")
"""Colours of Okabe and Ito, distinguishable with all kinds of colour vision."""

MEASURED, COMMANDED, ERROR, NOMINAL = "#0072b2", "#1d2125", "#d55e00", "#009e73"
GREY, SHADE = "#9a9a9a", "#e8e8e8"

AXES = ("vx (m/s)", "vy (m/s)", "yaw rate (rad/s)")

STYLE: dict[str, Any] = {
    "svg.fonttype": "none",  # text stays text: searchable, and the page stays small
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


@dataclass(frozen=True)
class Drawing:
    """One figure of a report.

    Attributes:
        name: unique in the page; letters and digits.
        title: heading of the figure.
        caption: description below the figure.
        paint: makes the figure.
        wide: whether the figure takes the width of the page.
        heading: whether the page shows the title; it is read aloud in any case.
    """

    name: str
    title: str
    caption: str
    paint: Callable[[], Figure]
    wide: bool = False
    heading: bool = True

    @property
    def svg(self) -> Markup:
        """The figure as an ``svg`` element."""
        return svg(self.name, f"{self.title}. {self.caption}".rstrip(), self.paint)


def svg(name: str, alt: str, paint: Callable[[], Figure]) -> Markup:
    """Return the figure that ``paint`` makes as an ``svg`` element.

    Args:
        name: unique in the page; ids inside the figure begin with it.
        alt: text for readers who cannot see the figure.
        paint: makes the figure, under this module's style.
    """
    import matplotlib

    buffer = io.StringIO()
    style: Any = {**STYLE, "svg.hashsalt": name}  # its type would list all settings of Matplotlib
    with matplotlib.rc_context(style), warnings.catch_warnings():
        # The reader's browser draws glyphs that the fonts of this machine lack.
        warnings.filterwarnings("ignore", message=r"Glyph \d+", category=UserWarning)
        paint().savefig(buffer, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
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
    """Number the ids that are referred to, under ``name``, and drop the others."""
    used = dict.fromkeys(re.findall(r'(?:url\(#|href="#)([\w-]+)', source))
    numbered = {old: f"{name}-{k}" for k, old in enumerate(used)}

    def unique(match: re.Match[str]) -> str:
        return f' id="{numbered[match[1]]}"' if match[1] in numbered else ""

    source = re.sub(r' id="([^"]*)"', unique, source)
    return re.sub(r'(url\(#|href="#)([\w-]+)', lambda match: match[1] + numbered[match[2]], source)


def panels(
    rows: int, columns: int = 1, height: float = 1.5, width: float = WIDTH, **options: Any
) -> tuple[Figure, Any]:
    """Return a figure and its axes (rows, columns); ``height`` in inches of a row."""
    from matplotlib.figure import Figure as Made

    figure = Made(figsize=(width, rows * height + 0.35), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def listing(labels: Sequence[str], width: float = WIDTH, row: float = 0.22, label: str = "") -> tuple[Figure, Axes]:
    """Return a figure with one horizontal row per label, the first on top.

    Args:
        labels: of the rows.
        width: of the figure, inches.
        row: height of a row, inches.
        label: of the x axis.
    """
    figure, axes = panels(1, height=0.4 + row * len(labels), width=width)
    panel = axes[0, 0]
    panel.set_yticks(range(len(labels)), labels, fontsize=7.5)
    panel.set_ylim(len(labels) - 0.4, -0.6)
    panel.grid(axis="y", visible=False)
    panel.locator_params(axis="x", nbins=5)  # numbers of five digits stay apart
    panel.set_xlabel(label)
    return figure, panel


def band(axes: Axes, x: Any, low: Any, high: Any, colour: str) -> None:
    """Shade the area between two curves."""
    axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)


def intervals(axes: Axes, x: Sequence[float], entries: Any, name: str, colour: str, label: str, **options: Any) -> None:
    """Draw one quantity of a summary with its interval over x; entries without the quantity are skipped."""
    points = [(at, e["figures"].get(name)) for at, e in zip(x, entries, strict=True)]
    shown = [(at, f["estimate"], f["low"], f["high"]) for at, f in points if f and f["estimate"] is not None]
    if not shown:
        return
    below = [max(m - (m if low is None else low), 0.0) for _, m, low, _ in shown]
    above = [max((m if high is None else high) - m, 0.0) for _, m, _, high in shown]
    style = {"marker": "o", "ms": 3.5, "lw": 1.2, "capsize": 2, "elinewidth": 0.9, **options}
    at, middle = [s[0] for s in shown], [s[1] for s in shown]
    axes.errorbar(at, middle, yerr=[below, above], color=colour, label=label, **style)


def legend(figure: Figure, axes: Axes, columns: int = 3) -> None:
    """Put the legend of some axes above the figure."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False, fontsize=7.5)
