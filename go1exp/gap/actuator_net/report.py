"""Errors of a net and of the references on held-out episodes, per joint and regime: as text and JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from go1exp.base.report.table import aligned
from go1exp.gap.actuator_net.dataset import Rows, Split
from go1exp.gap.actuator_net.references import NAMES, Reference
from go1exp.gap.actuator_net.regimes import REGIMES, Thresholds, as_text, masks


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
