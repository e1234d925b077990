"""Drawings of the page of a comparison."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

import go1exp.gap.report.words as words
from go1exp.base.report.plots import COLOURS, GREY, PAGE, SHADE, WIDE, WIDTH, Drawing, listing
from go1exp.base.report.table import number, share
from go1exp.gap.data.prepare import tolerances_of
from go1exp.gap.result import GapResult, NamedEffect, Overlay

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER, MEASURED = COLOURS[1], COLOURS[0], "#333333"

SHOWN_JOINTS = 3  # joints of a window that are drawn: those with the largest error of the nominal model
POINTS = 500  # most samples of a curve that are drawn
LINEAR = 3.0  # error up to which its scale is linear, in standard deviations of the noise; logarithmic beyond
LEAST = 1e-2  # smallest normalised chi2 of a logarithmic axis


# ---------------------------------------------------------------------- windows


def split_channel(channel: str) -> tuple[str, str]:
    """Return quantity and joint of a channel such as ``q_FR_calf``, or quantity and axis of ``imu_acc_x``."""
    for quantity in sorted(words.ALL_UNITS, key=len, reverse=True):
        if channel.startswith(f"{quantity}_"):
            return quantity, channel[len(quantity) + 1 :]
    return "", channel


def shown_joints(overlay: Overlay) -> list[str]:
    """Return the joints with the largest error of the nominal model, in units of noise, worst first."""
    squares: dict[str, float] = {}
    for channel, measured in overlay.measured.items():
        quantity, joint = split_channel(channel)
        if quantity in words.TRUNK_UNITS:
            continue
        scaled = _scaled(overlay, channel, overlay.before.get(channel, measured))
        square = float(np.mean(scaled[np.isfinite(scaled)] ** 2)) if np.isfinite(scaled).any() else 0.0
        squares[joint] = squares.get(joint, 0.0) + square
    return sorted(squares, key=lambda joint: -squares[joint])[:SHOWN_JOINTS]


def rows_of(overlay: Overlay) -> dict[str, list[str]]:
    """Return the channels to draw by quantity, one column per shown joint or axis of the trunk, if there are curves."""
    given = {c for c, values in overlay.measured.items() if np.isfinite(values).any()}
    joints = shown_joints(overlay)
    rows: dict[str, list[str]] = {}
    for quantity in dict.fromkeys(split_channel(c)[0] for c in overlay.measured):
        trunk = quantity in words.TRUNK_UNITS
        columns = "xyz" if trunk else joints
        channels = [f"{quantity}_{column}" if quantity else column for column in columns]
        if (given & {*overlay.before} if trunk else given).intersection(channels):
            rows[quantity] = channels
    return rows


def _scaled(overlay: Overlay, channel: str, model: np.ndarray) -> np.ndarray:
    """Return the error of the model in standard deviations of the noise; NaN where the noise is unknown."""
    noise = overlay.noise.get(channel, math.nan)
    return (model - overlay.measured[channel]) / (noise if noise > 0 else math.nan)


def overlay(window: Overlay, name: str) -> Drawing:
    """Draw one window: each quantity with the models' curves, and below it their errors in units of noise."""
    trunk = ["the trunk"] if words.TRUNK_UNITS.keys() & rows_of(window) else []
    title = f"{window.episode}, {number(window.t[0], 4)} to {number(window.t[-1], 4)} s"
    caption = f"Measured and predicted curves of {', '.join(shown_joints(window) + trunk)}."
    return Drawing(name, title, caption, partial(_overlay, window), wide=True)


def _overlay(window: Overlay) -> Figure:
    from matplotlib.figure import Figure

    rows, every = rows_of(window), slice(None, None, max(1, math.ceil(len(window.t) / POINTS)))
    height = 0.85 + 2.2 * len(rows)
    figure = Figure(figsize=(PAGE, height))  # constrained layout would take most of the time
    edges = {"left": 0.058, "right": 0.998, "bottom": 0.45 / height, "top": 1 - 0.4 / height}
    figure.subplots_adjust(**edges, wspace=0.17, hspace=0.16)
    shape = (2 * len(rows), max(map(len, rows.values())))
    axes = figure.subplots(*shape, sharex=True, sharey=False, squeeze=False, height_ratios=[2.0, 1.2] * len(rows))
    for row, (quantity, channels) in enumerate(rows.items()):
        above, below = axes[2 * row], axes[2 * row + 1]
        for column, channel in enumerate(channels):
            _window(above[column], below[column], window, channel, every)
            if row == 0 or quantity in words.TRUNK_UNITS:  # joints above the first row, axes above the trunk's
                pad = None if row == 0 else 2.0
                above[column].set_title(split_channel(channel)[1], loc="left", fontweight="bold", pad=pad)
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


def _window(above: Axes, below: Axes, window: Overlay, channel: str, every: slice) -> None:
    if not np.isfinite(window.measured.get(channel, math.nan)).any():
        above.text(0.5, 0.5, "not recorded", ha="center", va="center", transform=above.transAxes, color=GREY)
        return
    t, y, noise = window.t[every], window.measured[channel], window.noise.get(channel, math.nan)
    if noise > 0:
        bounds = (y - 2 * noise)[every], (y + 2 * noise)[every]
        above.fill_between(t, *bounds, color="#cccccc", lw=0, label="± 2 sd noise")
    above.plot(t, y[every], color="#8f8f8f", lw=3.0, label="measured")
    below.axhspan(-2, 2, color=SHADE, lw=0)
    below.axhline(0, color=GREY, lw=0.6)
    for curves, colour, dash, label in (
        (window.before, BEFORE, (0, (4, 1.6)), "nominal model"),
        (window.after, AFTER, "-", "fitted model"),
    ):
        if channel in curves:
            above.plot(t, curves[channel][every], color=colour, ls=dash, lw=1.2, label=label)
            below.plot(t, _scaled(window, channel, curves[channel])[every], color=colour, ls=dash, lw=0.9)
    above.margins(x=0)


def _same_errors(row: Sequence[Axes]) -> None:
    """Give the errors of a row one scale, linear within a few sd of the noise and logarithmic beyond."""
    values = [np.abs(np.asarray(line.get_ydata(), dtype=float)) for axes in row for line in axes.lines]
    finite = np.concatenate([v[np.isfinite(v)] for v in values] or [np.zeros(0)])
    top = max(LINEAR, 1.3 * float(finite.max())) if len(finite) else LINEAR
    decades = [10.0**k for k in range(1, 8) if 10.0**k <= top]
    marks = decades[-2:] or [2.0]
    ticks = [*(-m for m in reversed(marks)), 0.0, *marks]
    for axes in row:
        axes.set_yscale("symlog", linthresh=LINEAR)
        axes.set_ylim(-top, top)
        axes.set_yticks(ticks, [f"{v:g}".replace("-", "−") for v in ticks])
        axes.minorticks_off()


# ---------------------------------------------------------------------- the search


def waterfall(result: GapResult) -> list[Drawing]:
    """Draw how the error falls from the nominal model to the residual, on a logarithmic scale."""
    steps = [(label, 1.0 + excess) for label, excess in result.waterfall if math.isfinite(excess)]
    caption = (
        "Numbers are normalised chi2 (1 = noise level), in brackets their change by the step. The scale is logarithmic:"
        " equal lengths are equal ratios."
    )
    paint = partial(_waterfall, steps, 1.0 + words.limit(result, "adequate"))
    return [Drawing("waterfall", "Held-out error, step by step", caption, paint, heading=False)] if steps else []


def _waterfall(steps: Sequence[tuple[str, float]], adequate: float) -> Figure:
    labels = [steps[0][0], *(_step(label) for label, _ in steps[1:]), "residual"]
    xlabel = "held-out normalised chi2 (line: noise level; dotted: adequate)"
    figure, axes = listing(labels, WIDE, 0.3, xlabel)
    low = max(LEAST, 0.8 * min(1.0, *(v for _, v in steps)))
    shown = [max(v, low) for _, v in steps]
    for k, value in enumerate(shown):
        start = 1.0 if k == 0 else shown[k - 1]
        colour = GREY if k == 0 else (AFTER if value <= start else BEFORE)
        axes.barh(k, value - start, left=start, color=colour, height=0.62)
        if k:
            axes.plot([start, start], [k - 1.31, k + 0.31], color=GREY, lw=0.7)
        change = f"   ({number(100 * (value / start - 1), 2)} %)" if k and start > 0 else ""
        _note(axes, max(value, start, 1.0), k, number(steps[k][1]) + change)
    axes.barh(len(steps), shown[-1] - 1.0, left=1.0, color=MEASURED, height=0.62)
    _note(axes, max(shown[-1], 1.0), len(steps), number(steps[-1][1]))
    axes.axvline(1.0, color="black", lw=1.2)
    axes.axvline(adequate, color="black", lw=0.8, ls=":")
    axes.set_xscale("log")
    axes.set_xlim(low, max(2.0, *shown) ** 1.12 * 1.2)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()
    return figure


def _note(axes: Axes, x: float, row: int, text: str) -> None:
    axes.annotate(text, (x, row), (4, 0), textcoords="offset points", va="center")


def _step(label: str) -> str:
    return label if label.startswith(("within", "without", "with ")) else f"with {label}"


def forest(result: GapResult, named: NamedEffect, name: str, index: int) -> Drawing:
    """Draw the values of one parameter with their 95 % intervals, over the tolerance about null."""
    unit = words.unit(named.effect, name)
    label = f"{name}, {unit}" if unit else name
    return Drawing(f"forest{index}", f"{named.effect}: {name}", "", partial(_forest, result, named, name, label))


def _forest(result: GapResult, named: NamedEffect, name: str, label: str) -> Figure:
    declared, values = words.param(named.effect, name, tolerances_of(result)), named.params[name]
    figure, axes = listing(list(values), WIDTH, 0.19, label)
    if declared and math.isfinite(declared.tolerance):
        axes.axvspan(declared.null - declared.tolerance, declared.null + declared.tolerance, color=SHADE, lw=0)
    if declared:
        axes.axvline(declared.null, color="black", lw=0.9, ls=":")
    for row, (joint, value) in enumerate(values.items()):
        interval = named.interval.get(name, {}).get(joint)
        if interval:
            axes.plot(interval, [row, row], color=AFTER, lw=2.0, solid_capstyle="butt")
        axes.plot([value], [row], "o", color=AFTER, ms=4.5)
    axes.margins(x=0.08)
    return figure


def box(result: GapResult) -> list[Drawing]:
    """Draw the parameters that may move within their tolerances, in tolerances from null, a dot per joint."""
    rows = []
    for effect, by_name in result.box.items():
        for name, values in by_name.items():
            declared = words.param(effect, name, tolerances_of(result))
            if declared and math.isfinite(declared.tolerance):
                label = f"{effect} {name} (± {number(declared.tolerance)} {words.unit(effect, name)}".rstrip() + ")"
                deviation = (np.array(list(values.values()), dtype=float) - declared.null) / declared.tolerance
                rows.append((label, deviation[np.isfinite(deviation)]))
    return [Drawing("box", "Parameters within their tolerances", "", partial(_box, rows))] if rows else []


def _box(rows: Sequence[tuple[str, np.ndarray]]) -> Figure:
    xlabel = "deviation from null, tolerances (diamond: at the limit)"
    figure, axes = listing([label for label, _ in rows], WIDE, 0.2, xlabel)
    axes.axvspan(-1, 1, color=SHADE, lw=0)
    axes.axvline(0, color="black", lw=0.9, ls=":")
    for row, (_, values) in enumerate(rows):
        at_limit = np.abs(values) > 0.98
        for chosen, marker, colour in ((~at_limit, "o", AFTER), (at_limit, "D", BEFORE)):
            axes.plot(values[chosen], np.full(chosen.sum(), row), marker, color=colour, ms=4, alpha=0.7, mec="none")
    furthest = 1.1 * max([1.0, *(float(np.abs(values).max()) for _, values in rows if len(values))])
    axes.set_xlim(-furthest, furthest)
    return figure


def bootstraps(result: GapResult) -> list[Drawing]:
    """Draw the share of bootstrap resamples that selected each effect, with the threshold of certification."""
    rows = sorted(((n, v) for n, v in result.bootstrap_share.items() if math.isfinite(v)), key=lambda pair: -pair[1])
    paint = partial(_bootstraps, rows, words.limit(result, "certified"))
    return [Drawing("bootstraps", "Stability over bootstrap resamples", "", paint, heading=False)] if rows else []


def _bootstraps(rows: Sequence[tuple[str, float]], certified: float) -> Figure:
    xlabel = f"bootstrap resamples that selected the effect, % (dashed: certified from {share(certified)})"
    figure, axes = listing([name for name, _ in rows], WIDE, 0.27, xlabel)
    for row, (_, value) in enumerate(rows):
        stable = value >= certified
        colour, hatch = (AFTER, None) if stable else (GREY, "///")
        axes.barh(row, 100 * value, height=0.6, ec="white", color=colour, hatch=hatch)
        _note(axes, 100 * value, row, share(value))
    axes.axvline(100 * certified, color="black", lw=1.0, ls="--")
    axes.set_xlim(0, 112)
    axes.set_xticks(range(0, 101, 20))
    return figure
