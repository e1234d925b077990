"""Drawings of a report: learning curves with bands, figures with intervals, what goes with error and falls."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from go1exp.evaluate.protocol.base import Drawing
from go1exp.evaluate.protocol.report.paint import COLOURS, WIDE, WIDTH, band, legend, panels
from go1exp.evaluate.quantities import Column
from go1exp.evaluate.report.curves import AXES, Curve
from go1exp.evaluate.report.figures import Figure
from go1exp.evaluate.report.sensitivity import Sensitivity

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Painting

FEW = 6
"""More groups than these are drawn without bands, but for the baseline's."""

STYLES = ("-", "--", ":", "-.")

MOST = 12
"""Quantities of a sensitivity that are drawn, and letters of a name are cut at twice as many."""


def label(column: Column) -> str:
    """Return a figure with its unit."""
    return f"{column.name} ({column.unit})" if column.unit else column.name


def short(name: str, letters: int = 42) -> str:
    """Return a name that fits beside a drawing."""
    return name if len(name) <= letters else f"{name[: letters - 1]}…"


def learning(curves: Sequence[Curve], baseline: str) -> list[Drawing]:
    """Return one drawing for each metric, over steps and over time."""
    drawings = []
    for number, metric in enumerate(dict.fromkeys(c.metric for c in curves)):
        of_metric = [c for c in curves if c.metric == metric]
        caption = (
            "Interquartile mean over runs; band: its 95 % interval over runs. Each group ends where the first of its"
            " runs does."
        )
        if len({c.group for c in of_metric}) > FEW:
            caption += f" With so many groups, only the band of the baseline ({baseline}) is drawn."
        drawings.append(Drawing(f"curve{number}", metric, caption, _learning(of_metric, baseline), wide=True))
    return drawings


def _learning(curves: Sequence[Curve], baseline: str) -> Any:
    def paint() -> Painting:
        axes_drawn = [axis for axis in AXES if any(c.axis == axis for c in curves)]
        names = list(dict.fromkeys(c.group for c in curves))
        figure, axes = panels(1, len(axes_drawn), height=2.9, width=WIDE, sharey=True)
        looks = dict(zip(names, cycle([(c, s) for s in STYLES for c in COLOURS]), strict=False))
        for panel, axis in zip(axes[0], axes_drawn, strict=True):
            for curve in (c for c in curves if c.axis == axis):
                colour, style = looks[curve.group]
                if len(names) <= FEW or curve.group == baseline:
                    band(panel, curve.x, curve.low, curve.high, colour)
                width = 1.8 if curve.group == baseline else 1.1
                name = f"{short(curve.group)} (n {curve.runs})"
                panel.plot(curve.x, curve.middle, style, color=colour, lw=width, label=name)
            panel.set_xlabel(AXES[axis])
            _show_all(panel, [c for c in curves if c.axis == axis], baseline, len(names))
        axes[0][0].set_ylabel(curves[0].metric)
        legend(figure, axes[0][0], columns=2)
        return figure

    return paint


def _show_all(axes: Any, curves: Sequence[Curve], baseline: str, count: int) -> None:
    """Let the middles fill the drawing: bands of two or three runs are so wide that nothing else would be seen."""
    shown = [c.middle for c in curves]
    shown += [v for c in curves if count <= FEW or c.group == baseline for v in (c.low, c.high)]
    middles = np.concatenate([c.middle for c in curves])
    low, high = float(middles.min()), float(middles.max())
    room = 0.75 * (high - low) or 1.0
    every = np.concatenate(shown)
    every = every[np.isfinite(every)]
    axes.set_ylim(max(low - room, float(every.min()) - 0.05 * room), min(high + room, float(every.max()) + 0.05 * room))


def forests(figures: Sequence[Figure], main: Sequence[str], baseline: str, key: str) -> list[Drawing]:
    """Return one drawing for each main figure: groups from top to bottom with their intervals."""
    drawings = []
    for name in main:
        those = [f for f in figures if f.column.name == name]
        if those:
            caption = (
                f"{those[0].column.meaning}. Dots: runs; bar: interquartile mean with its 95 % interval over runs. "
                f"Dashed: {baseline}."
            )
            title = f"{key}: {label(those[0].column)}"
            drawings.append(Drawing(f"forest{key}{name}".replace("_", ""), title, caption, _forest(those, baseline)))
    return drawings


def _forest(figures: Sequence[Figure], baseline: str) -> Any:
    def paint() -> Painting:
        figure, axes = panels(1, height=0.55 + 0.27 * len(figures), width=WIDTH)
        panel = axes[0, 0]
        for place, f in enumerate(figures):
            colour = COLOURS[1] if f.group == baseline else COLOURS[0]
            panel.plot(f.values, np.full(len(f.values), place), ".", color=colour, alpha=0.45, ms=5, mec="none")
            r = f.runs
            if np.isfinite(r.low):
                panel.plot([r.low, r.high], [place, place], color=colour, lw=1.6)
            panel.plot([r.estimate], [place], "|", color=colour, ms=9, mew=2)
            if f.group == baseline:
                panel.axvline(r.estimate, color="#777777", lw=0.8, ls="--")
        values = np.concatenate([f.values for f in figures])
        values = values[np.isfinite(values)]
        if len(values):
            room = 0.6 * float(np.ptp(values)) or 0.1 * abs(float(values[0])) or 0.1
            panel.set_xlim(values.min() - room, values.max() + room)
        panel.set_yticks(range(len(figures)), [short(f.group, 34) for f in figures], fontsize=7.5)
        panel.invert_yaxis()
        panel.grid(axis="y", visible=False)
        panel.set_xlabel(label(figures[0].column))
        return figure

    return paint


def importances(entries: Sequence[Sensitivity], key: str) -> list[Drawing]:
    """Return one drawing for each figure: what goes with it, by importance."""
    drawings = []
    for name in dict.fromkeys(e.column.name for e in entries):
        those = [e for e in entries if e.column.name == name and np.isfinite(e.association.importance)]
        those = sorted(those, key=lambda e: -e.association.importance)[:MOST]
        if those:
            caption = (
                "Share of the figure's variance that the quantity explains in a linear model of ranks, by shuffling it;"
                " dark: told from chance (p after Holm at most 0.05). Swept settings are over runs, draws over robots."
            )
            title = f"{key}: what goes with {name}"
            drawings.append(Drawing(f"goes{key}{name}".replace("_", ""), title, caption, _bars(those)))
    return drawings


def _bars(entries: Sequence[Sensitivity]) -> Any:
    def paint() -> Painting:
        figure, axes = panels(1, height=0.5 + 0.22 * len(entries), width=WIDTH)
        panel = axes[0, 0]
        clear = [e.adjusted_p <= 0.05 for e in entries]
        colours = [COLOURS[0] if c else "#b9c6d0" for c in clear]
        panel.barh(range(len(entries)), [max(e.association.importance, 0.0) for e in entries], color=colours)
        names = [f"{short(e.association.name, 34)}, {e.source}" for e in entries]
        panel.set_yticks(range(len(entries)), names, fontsize=7.5)
        panel.invert_yaxis()
        panel.grid(axis="y", visible=False)
        panel.set_xlabel("importance")
        return figure

    return paint
