"""Matplotlib figures of one width, legible at the width of a phone, with the colours that all reports share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 4.7
"""Inches. At 360 CSS pixels, a phone, type of 8 points appears with 8.5 pixels."""

WIDE = 7.0
"""Inches, of figures that take the page's width on a screen."""

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5a6169")
"""Okabe and Ito's, which people of all kinds of colour vision tell apart."""

MEASURED, COMMANDED, ERROR, NOMINAL = "#0072b2", "#1d2125", "#d55e00", "#009e73"

AXES = ("vx (m/s)", "vy (m/s)", "yaw rate (rad/s)")


def panels(
    rows: int, columns: int = 1, height: float = 1.5, width: float = WIDTH, **options: Any
) -> tuple[Figure, Any]:
    """Return a figure and its axes, rows x columns as ``squeeze=False`` gives them; ``height`` in inches of a row."""
    from matplotlib.figure import Figure as Made

    figure = Made(figsize=(width, rows * height + 0.35), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def band(axes: Axes, x: Any, low: Any, high: Any, colour: str) -> None:
    """Shade what lies between two lines."""
    axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)


def intervals(axes: Axes, x: Any, entries: Any, name: str, colour: str, label: str, **options: Any) -> None:
    """Draw a figure with its interval over x, one for each entry of a summary; those without it are left out."""
    points = [(at, e["figures"].get(name)) for at, e in zip(x, entries, strict=True)]
    shown = [(at, f) for at, f in points if f and f["estimate"] is not None]
    if not shown:
        return
    at = [p for p, _ in shown]
    middle = [f["estimate"] for _, f in shown]
    below = [m - (m if f["low"] is None else f["low"]) for m, (_, f) in zip(middle, shown, strict=True)]
    above = [(m if f["high"] is None else f["high"]) - m for m, (_, f) in zip(middle, shown, strict=True)]
    style = {"marker": "o", "ms": 3.5, "lw": 1.2, "capsize": 2, "elinewidth": 0.9, **options}
    axes.errorbar(
        at,
        middle,
        yerr=[[max(v, 0.0) for v in below], [max(v, 0.0) for v in above]],
        color=colour,
        label=label,
        **style,
    )


def legend(figure: Figure, axes: Axes, columns: int = 3) -> None:
    """Put the legend of some axes above the figure."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False, fontsize=7.5)
