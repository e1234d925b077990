"""Plots of measured and predicted torque on held-out episodes: the worst second, and one with the median error."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from go1exp.base.files import replacing
from go1exp.base.report.plots import COLOURS
from go1exp.gap.actuator_net.dataset import Rows
from go1exp.gap.actuator_net.fitting import FitResult
from go1exp.gap.actuator_net.report import rmse

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STRETCH = 1.0  # duration of a plot, s (chosen: a few strides, with fast transients still visible)

MEASURED, NET, REFERENCE = "0.35", COLOURS[1], COLOURS[0]


def plot(result: FitResult, folder: Path) -> list[Path]:
    """Draw one picture per joint, ``actuator_net_<joint>.png``, from the held-out rows; return the files.

    A picture shows the second with the largest error of the net, and that with the median error: measured torque, that
    of the net and of the best reference that is not a net, and below it the errors of both.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for j, joint in enumerate(result.net.info.joints):
        index = np.flatnonzero(result.rows.joint == j)
        if not len(index):
            continue
        rows = result.rows.take(index)
        torque = {name: values[index] for name, values in result.torque.items()}
        best = min(torque, key=lambda n: (n in ("net", "half_net"), rmse(torque[n] - rows.y)))
        figure = Figure(figsize=(12, 9), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(4, 1, gridspec_kw={"height_ratios": [3, 1, 3, 1]})
        for (what, which), pair in zip(_stretches(rows, torque["net"]), (axes[:2], axes[2:]), strict=False):
            episode = result.episodes[rows.episode[which[0]]]
            _stretch(pair, rows.take(which), torque["net"][which], torque[best][which], best)
            pair[0].set_title(f"{what} stretch: {episode}", loc="left", fontsize=11)
        errors = f"net {rmse(torque['net'] - rows.y):.4f}, {best} {rmse(torque[best] - rows.y):.4f}"
        figure.suptitle(f"{joint}: {result.report.target} on held-out episodes, RMSE in N m: {errors}")
        file = folder / f"actuator_net_{joint}.png"
        with replacing(file, keep_suffix=True) as partial:
            figure.savefig(partial, dpi=110)
        files.append(file)
    return files


def _stretches(rows: Rows, net: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Cut the rows into stretches of one second; return the worst and the median by the net's error."""
    pieces = []
    for index in np.unique(rows.episode):
        in_episode = np.flatnonzero(rows.episode == index)
        number = ((rows.t[in_episode] - rows.t[in_episode[0]]) / STRETCH).astype(int)
        pieces += [in_episode[number == n] for n in np.unique(number)]
    longest = max(len(piece) for piece in pieces)
    # The last piece of an episode may be short; its error says little.
    whole = [piece for piece in pieces if len(piece) > longest / 2]
    order = sorted(whole, key=lambda piece: rmse(net[piece] - rows.y[piece]))
    return [("worst", order[-1]), ("median", order[len(order) // 2])]


def _stretch(pair: list[Axes], rows: Rows, net: np.ndarray, reference: np.ndarray, name: str) -> None:
    above, below = pair
    # NaN breaks the line where rows are missing
    t = np.where(np.concatenate([[False], np.diff(rows.t) > 10 * np.median(np.diff(rows.t))]), np.nan, rows.t)
    above.plot(t, rows.y, color=MEASURED, lw=2.2, alpha=0.6, label="measured")
    above.plot(t, reference, color=REFERENCE, lw=1.0, label=f"{name}, {rmse(reference - rows.y):.4f}")
    above.plot(t, net, color=NET, lw=1.2, label=f"net, {rmse(net - rows.y):.4f}")
    above.set_ylabel("torque, N m")
    above.legend(ncols=3, loc="upper right", fontsize=9)
    below.axhline(0, color="0.7", lw=0.8)
    below.plot(t, reference - rows.y, color=REFERENCE, lw=0.8)
    below.plot(t, net - rows.y, color=NET, lw=0.8)
    below.set_ylabel("error, N m")
    below.set_xlabel("t, s")
    for axes in pair:
        axes.set_xlim(rows.t[0], rows.t[-1])
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    above.tick_params(labelbottom=False)
    above.margins(y=0.25)
