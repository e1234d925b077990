"""Errors of a net and of the references on held-out episodes, per joint and regime: as text, JSON and plots."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from go1exp.base.files import replacing
from go1exp.base.report.plots import COLOURS
from go1exp.base.report.table import aligned
from go1exp.gap.actuator_net.dataset import Rows, Split
from go1exp.gap.actuator_net.references import NAMES, Reference
from go1exp.gap.actuator_net.regimes import REGIMES, Thresholds, as_text, masks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from go1exp.gap.actuator_net.fitting import FitResult


@dataclass(frozen=True)
class Cell:
    """Errors on the rows of one joint (or ``all``), regime and episode (or ``all``).

    Attributes:
        joint: its name.
        regime: its name.
        episode: its name.
        rows: number of rows.
        rms: root mean square of the target itself, N m.
        rmse: model -> root mean square error, N m; ``net`` and the available references.
    """

    joint: str
    regime: str
    episode: str
    rows: int
    rms: float
    rmse: dict[str, float]


@dataclass(frozen=True)
class Report:
    """Errors on the held-out episodes.

    Attributes:
        target: predicted quantity, ``tau_est`` or ``joint_torque``.
        split: which episodes trained, validated and were held out.
        cells: one for each joint and for all, in each regime that occurs, over all held-out episodes.
        episodes: one for each joint and held-out episode, in the regime ``all``.
        missing: unavailable reference -> reason.
        thresholds: limits of the regimes.
    """

    target: str
    split: Split
    cells: tuple[Cell, ...]
    episodes: tuple[Cell, ...]
    missing: dict[str, str]
    thresholds: tuple[Thresholds, ...]

    def cell(self, joint: str = "all", regime: str = "all") -> Cell:
        """Return a cell over all held-out episodes; KeyError without rows of that joint and regime."""
        for cell in self.cells:
            if (cell.joint, cell.regime) == (joint, regime):
                return cell
        raise KeyError(f"{joint}, {regime}")

    def as_dict(self) -> dict[str, Any]:
        """Return plain lists, dicts, strings and numbers, ready for JSON."""
        return asdict(self)


def rmse(error: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(error))))


def report(
    rows: Rows,
    net: np.ndarray,
    references: list[Reference],
    limits: list[Thresholds],
    episodes: tuple[str, ...],
    split: Split,
    target: str,
) -> Report:
    """Compare predictions on held-out rows.

    Args:
        rows: the held-out rows.
        net: the net's torque for each ``(R,)``, N m.
        references: torques of the references.
        limits: limits of the regimes.
        episodes: names that ``rows.episode`` points to.
        split: which episodes trained, validated and were held out.
        target: ``tau_est`` or ``joint_torque``.
    """
    torques = {"net": net} | {r.name: r.torque for r in references if r.torque is not None}
    regimes = masks(rows, limits)
    every = np.ones(len(rows), bool)
    joints = {limit.joint: rows.joint == j for j, limit in enumerate(limits)} | {"all": every}

    def cell(joint: str, regime: str, episode: str, which: np.ndarray) -> Cell:
        errors = {name: rmse(torque[which] - rows.y[which]) for name, torque in torques.items()}
        return Cell(joint, regime, episode, int(which.sum()), rmse(rows.y[which]), errors)

    cells, by_episode = [], []
    for joint, joint_rows in joints.items():
        for regime in REGIMES:
            if (joint_rows & regimes[regime]).any():
                cells.append(cell(joint, regime, "all", joint_rows & regimes[regime]))
        for index in np.unique(rows.episode):
            which = joint_rows & (rows.episode == index)
            if which.any():
                by_episode.append(cell(joint, "all", episodes[index], which))
    missing = {r.name: r.reason for r in references if r.torque is None}
    return Report(target, split, tuple(cells), tuple(by_episode), missing, tuple(limits))


def text(report: Report) -> str:
    """Return a report as text for a terminal; errors in N m, the smallest of each line marked with a star."""
    parts = [
        f"{report.target}: RMSE in N m on held-out episodes: {', '.join(report.split.held_out)}",
        f"trained on {', '.join(report.split.train)}; early stopping on {', '.join(report.split.validation)}",
        "",
        _table(report.cells, "regime"),
        "",
        _table(tuple(c for c in report.episodes if c.joint != "all" or len(report.thresholds) > 1), "episode"),
        "",
        *(f"{name}: {NAMES[name]}" for name in NAMES if name in report.cells[0].rmse),
        *(f"{name}: none ({reason})" for name, reason in report.missing.items()),
        *as_text(list(report.thresholds)),
    ]
    return "\n".join(parts)


def _table(cells: tuple[Cell, ...], key: str) -> str:
    models = list(cells[0].rmse)
    lines = [["joint", key, "rows", "rms", *models]]
    for cell in cells:
        best = min(cell.rmse.values())
        errors = [f"{cell.rmse[m]:.4f}{'*' if cell.rmse[m] == best else ' '}" for m in models]
        lines.append([cell.joint, getattr(cell, key), str(cell.rows), f"{cell.rms:.3f}", *errors])
    return "\n".join(aligned(lines, 2))


# ---------------------------------------------------------------------- plots

STRETCH = 1.0
"""Duration of a plot, s (chosen: a few strides, with fast transients still visible)."""

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
