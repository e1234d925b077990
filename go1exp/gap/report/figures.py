"""The figures of the page. Colours are those of Okabe and Ito, which the colour-blind can tell apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

import go1exp.gap.report.words as words
from go1exp.base.svg import PAGE_INCHES, draw
from go1exp.gap.data.contact import tolerances_of
from go1exp.gap.result import GapResult, NamedEffect, Overlay
from go1exp.sim.effects.tolerances import Tolerances

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, MEASURED, GREY = "#D55E00", "#0072B2", "#333333", "#9a9a9a"
BAND = "#e8e8e8"

SHOWN_JOINTS = 3
"""Joints of a window that are drawn: those with the largest error before."""

POINTS = 500
"""Most samples of a curve that are drawn."""

LINEAR = 3.0
"""Errors up to which the scale of the error is linear, in standard deviations of the noise; logarithmic beyond."""

LEAST = 1e-2
"""Smallest error that a logarithmic axis shows; the floor is 1."""


def split_channel(channel: str) -> tuple[str, str]:
    """Return quantity and joint of a channel such as ``q_FR_calf``, or quantity and axis of ``imu_acc_x``."""
    for quantity in sorted(words.ALL_UNITS, key=len, reverse=True):
        if channel.startswith(f"{quantity}_"):
            return quantity, channel[len(quantity) + 1 :]
    return "", channel


def shown_joints(overlay: Overlay) -> list[str]:
    """Return the joints with the largest error before, in units of noise, worst first."""
    off: dict[str, float] = {}
    for channel, measured in overlay.measured.items():
        quantity, joint = split_channel(channel)
        if quantity in words.TRUNK_UNITS:
            continue
        scaled = _scaled(overlay, channel, overlay.before.get(channel, measured))
        square = float(np.mean(scaled[np.isfinite(scaled)] ** 2)) if np.isfinite(scaled).any() else 0.0
        off[joint] = off.get(joint, 0.0) + square
    return sorted(off, key=lambda joint: -off[joint])[:SHOWN_JOINTS]


def rows_of(overlay: Overlay) -> dict[str, list[str]]:
    """Return the channels to draw by quantity: those of the shown joints, or of the trunk's axes, one a column.

    A quantity that no sensor gave, or of the trunk that no model predicts, has no row.
    """
    given = {c for c, values in overlay.measured.items() if np.isfinite(values).any()}
    joints = shown_joints(overlay)
    rows: dict[str, list[str]] = {}
    for quantity in dict.fromkeys(split_channel(c)[0] for c in overlay.measured):
        if quantity in words.TRUNK_UNITS:
            channels, known = [f"{quantity}_{axis}" for axis in "xyz"], given & {*overlay.before}
        else:
            channels = [f"{quantity}_{joint}" if quantity else joint for joint in joints]
            known = given
        if known.intersection(channels):
            rows[quantity] = channels
    return rows


def _scaled(overlay: Overlay, channel: str, model: np.ndarray) -> np.ndarray:
    """Return the error of the model in standard deviations of the noise; NaN where that is unknown."""
    noise = overlay.noise.get(channel, math.nan)
    return (model - overlay.measured[channel]) / (noise if noise > 0 else math.nan)


def overlay(window: Overlay, name: str) -> Markup:
    """Draw one window: each quantity with the models' curves, and below it their errors in units of noise."""
    rows, joints = rows_of(window), shown_joints(window)
    every = slice(None, None, max(1, math.ceil(len(window.t) / POINTS)))

    def paint() -> Figure:
        from matplotlib.figure import Figure

        ratios = [2.0, 1.2] * len(rows)
        columns = max(map(len, rows.values()))
        height = 0.85 + 2.2 * len(rows)
        figure = Figure(figsize=(PAGE_INCHES, height))  # constrained layout would take most of the time
        edges = {"left": 0.058, "right": 0.998, "bottom": 0.45 / height, "top": 1 - 0.4 / height}
        figure.subplots_adjust(**edges, wspace=0.17, hspace=0.16)
        axes = figure.subplots(len(ratios), columns, sharex=True, sharey=False, squeeze=False, height_ratios=ratios)
        for row, (quantity, channels) in enumerate(rows.items()):
            above, below = axes[2 * row], axes[2 * row + 1]
            for column, channel in enumerate(channels):
                _window((above[column], below[column]), window, channel, every)
            _titles(above, quantity, channels, first=row == 0)
            above[0].set_ylabel(f"{quantity}, {words.ALL_UNITS[quantity]}" if quantity else "")
            below[0].set_ylabel("error, sd")
            _same_errors(below)
            for unused in (*above[len(channels) :], *below[len(channels) :]):
                unused.set_axis_off()
        for axis in axes[-1]:
            axis.set_xlabel("time in the episode, s")
        handles = {label: h for a in axes[0] for h, label in zip(*a.get_legend_handles_labels(), strict=True)}
        figure.legend([*handles.values()], [*handles], loc="upper right", ncols=4, frameon=False, borderaxespad=0.1)
        figure.align_ylabels(axes[:, 0])
        return figure

    trunk = ["the trunk"] if words.TRUNK_UNITS.keys() & rows else []
    return draw(name, f"Measured and predicted curves of {', '.join(joints + trunk)} in {window.episode}", paint)


def _titles(row: Sequence[Axes], quantity: str, channels: Sequence[str], first: bool) -> None:
    """Write what the columns are: joints above the ``first`` row, axes above those of the trunk."""
    if first or quantity in words.TRUNK_UNITS:
        for axes, channel in zip(row, channels, strict=False):
            axes.set_title(split_channel(channel)[1], loc="left", fontweight="bold", pad=None if first else 2.0)


def _window(pair: tuple[Axes, Axes], window: Overlay, channel: str, every: slice) -> None:
    above, below = pair
    if not np.isfinite(window.measured.get(channel, math.nan)).any():
        above.text(0.5, 0.5, "not recorded", ha="center", va="center", transform=above.transAxes, color=GREY)
        return
    t, y, noise = window.t[every], window.measured[channel], window.noise.get(channel, math.nan)
    if noise > 0:
        above.fill_between(
            t, (y - 2 * noise)[every], (y + 2 * noise)[every], color="#cccccc", lw=0, label="± 2 sd noise"
        )
    above.plot(t, y[every], color="#8f8f8f", lw=3.0, label="measured")
    below.axhspan(-2, 2, color=BAND, lw=0)
    below.axhline(0, color=GREY, lw=0.6)
    for curves, colour, dash, what in (
        (window.before, BEFORE, (0, (4, 1.6)), "model before"),
        (window.after, AFTER, "-", "model after"),
    ):
        if channel in curves:
            above.plot(t, curves[channel][every], color=colour, ls=dash, lw=1.2, label=what)
            below.plot(t, _scaled(window, channel, curves[channel])[every], color=colour, ls=dash, lw=0.9)
    above.margins(x=0)


def _same_errors(row: Sequence[Axes]) -> None:
    """Give the errors of a row one scale, linear within a few sd of the noise and logarithmic beyond."""
    values = [np.abs(np.asarray(line.get_ydata(), dtype=float)) for axes in row for line in axes.lines]
    finite = np.concatenate([v[np.isfinite(v)] for v in values] or [np.zeros(0)])
    top = max(LINEAR, 1.3 * float(finite.max())) if len(finite) else LINEAR
    decades = [10.0**k for k in range(1, 8) if 10.0**k <= top]
    marks = decades[-2:] or [2.0]
    for axes in row:
        axes.set_yscale("symlog", linthresh=LINEAR)
        axes.set_ylim(-top, top)
        ticks = [*(-m for m in reversed(marks)), 0.0, *marks]
        axes.set_yticks(ticks, [f"{v:g}".replace("-", "−") for v in ticks])
        axes.minorticks_off()


def waterfall(result: GapResult) -> Markup:
    """Draw how the error falls from the model as it is to what remains, on a logarithmic scale with the floor at 1."""
    steps = [(label, 1.0 + excess) for label, excess in result.waterfall if math.isfinite(excess)]

    def paint() -> Figure:
        from matplotlib.figure import Figure

        rows = len(steps) + 1
        figure = Figure(figsize=(0.8 * PAGE_INCHES, 0.55 + 0.3 * rows), layout="constrained")
        axes = figure.subplots()
        low = max(LEAST, 0.8 * min(1.0, *(v for _, v in steps)))
        shown = [max(v, low) for _, v in steps]
        for k, value in enumerate(shown):
            start = 1.0 if k == 0 else shown[k - 1]
            colour = GREY if k == 0 else (AFTER if value <= start else BEFORE)
            axes.barh(k, value - start, left=start, color=colour, height=0.62)
            if k:
                axes.plot([start, start], [k - 1.31, k + 0.31], color=GREY, lw=0.7)
            caption = words.number(steps[k][1])
            if k and start > 0:
                caption += f"   ({words.number(100 * (value / start - 1), 2)} %)"
            axes.annotate(caption, (max(value, start, 1.0), k), (4, 0), textcoords="offset points", va="center")
        axes.barh(rows - 1, shown[-1] - 1.0, left=1.0, color=MEASURED, height=0.62)
        axes.annotate(
            words.number(steps[-1][1]), (max(shown[-1], 1.0), rows - 1), (4, 0), textcoords="offset points", va="center"
        )
        axes.axvline(1.0, color="black", lw=1.2)
        axes.axvline(1.0 + words.limit(result, "adequate"), color="black", lw=0.8, ls=":")
        labels = [steps[0][0], *(_step(label) for label, _ in steps[1:]), "what remains"]
        axes.set_yticks(range(rows), labels)
        axes.set_xscale("log")
        axes.set_xlim(low, max(2.0, *shown) ** 1.12 * 1.2)
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.minorticks_off()
        axes.set_xlabel("held-out error, times the noise floor (line: floor 1; dotted: what counts as adequate)")
        return figure

    return draw("waterfall", "How the held-out error falls, step by step", paint)


def _step(label: str) -> str:
    return label if label.startswith(("within", "without", "with ")) else f"with {label}"


def forest(named: NamedEffect, name: str, index: int, tolerances: Tolerances) -> Markup:
    """Draw the values of one parameter with their 95 % intervals, over the tolerance about null."""
    declared, values = words.param(named.effect, name, tolerances), named.params[name]
    intervals = named.interval.get(name, {})

    def paint() -> Figure:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(0.49 * PAGE_INCHES, 0.75 + 0.19 * len(values)), layout="constrained")
        axes = figure.subplots()
        if declared and math.isfinite(declared.tolerance):
            low, high = declared.null - declared.tolerance, declared.null + declared.tolerance
            axes.axvspan(low, high, color=BAND, lw=0)
        if declared:
            axes.axvline(declared.null, color="black", lw=0.9, ls=":")
        for row, (joint, value) in enumerate(values.items()):
            if joint in intervals:
                axes.plot(intervals[joint], [row, row], color=AFTER, lw=2.0, solid_capstyle="butt")
            axes.plot([value], [row], "o", color=AFTER, ms=4.5)
        axes.set_yticks(range(len(values)), list(values))
        axes.set_ylim(len(values) - 0.4, -0.6)
        axes.margins(x=0.08)
        axes.grid(axis="y", visible=False)
        unit = words.unit(named.effect, name)
        axes.set_xlabel(f"{name}, {unit}" if unit else name)
        axes.set_title(f"{named.effect}: {name}", loc="left", fontweight="bold")
        return figure

    return draw(f"forest{index}", f"{named.effect} {name} with 95 % intervals", paint)


def box(result: GapResult) -> Markup:
    """Draw where the parameters that may move within their tolerances lie, in tolerances, a dot per joint."""
    rows = []
    for effect, by_name in result.box.items():
        for name, values in by_name.items():
            declared = words.param(effect, name, tolerances_of(result))
            if declared and math.isfinite(declared.tolerance):
                unit = words.unit(effect, name)
                label = f"{effect} {name} (± {words.number(declared.tolerance)}{' ' if unit else ''}{unit})"
                off = (np.array(list(values.values()), dtype=float) - declared.null) / declared.tolerance
                rows.append((label, off[np.isfinite(off)]))

    def paint() -> Figure:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(0.8 * PAGE_INCHES, 0.7 + 0.2 * len(rows)), layout="constrained")
        axes = figure.subplots()
        axes.axvspan(-1, 1, color=BAND, lw=0)
        axes.axvline(0, color="black", lw=0.9, ls=":")
        for row, (_, off) in enumerate(rows):
            at_limit = np.abs(off) > 0.98
            axes.plot(off[~at_limit], np.full((~at_limit).sum(), row), "o", color=AFTER, ms=4, alpha=0.6, mec="none")
            axes.plot(off[at_limit], np.full(at_limit.sum(), row), "D", color=BEFORE, ms=4, alpha=0.8, mec="none")
        axes.set_yticks(range(len(rows)), [label for label, _ in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        furthest = max((float(np.abs(off).max()) for _, off in rows if len(off)), default=1.0)
        axes.set_xlim(-1.1 * max(furthest, 1.0), 1.1 * max(furthest, 1.0))
        axes.set_xlabel("deviation from null, tolerances (diamond: at the limit)")
        return figure

    return draw("box", "Parameters within their tolerances", paint) if rows else Markup()


def bootstraps(result: GapResult) -> Markup:
    """Draw in which share of the bootstraps each effect was named again, with the line from which it is certified."""
    rows = sorted(((n, v) for n, v in result.bootstrap_share.items() if math.isfinite(v)), key=lambda pair: -pair[1])
    certified = words.limit(result, "certified")

    def paint() -> Figure:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(0.7 * PAGE_INCHES, 0.75 + 0.27 * len(rows)), layout="constrained")
        axes = figure.subplots()
        for row, (_, value) in enumerate(rows):
            stable = value >= certified
            axes.barh(
                row,
                100 * value,
                color=AFTER if stable else GREY,
                height=0.6,
                hatch=None if stable else "///",
                ec="white",
            )
            axes.annotate(words.share(value), (100 * value, row), (4, 0), textcoords="offset points", va="center")
        axes.axvline(100 * certified, color="black", lw=1.0, ls="--")
        axes.set_yticks(range(len(rows)), [name for name, _ in rows])
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlim(0, 112)
        axes.set_xticks(range(0, 101, 20))
        axes.grid(axis="y", visible=False)
        axes.set_xlabel(f"bootstraps in which it was named again, % (dashed: certified from {words.share(certified)})")
        return figure

    return draw("bootstraps", "Stability over bootstraps", paint) if rows else Markup()
