"""Errors of a net and of simple reference models on held-out episodes, by joint and kind of motion."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from go1exp.base.report.table import aligned
from go1exp.gap.actuator_net.dataset import Rows, Split
from go1exp.gap.actuator_net.train import ridge

STILL, FAST, HIGH = 0.05, 0.5, 0.7
"""Share of a joint's speed scale below which it is still; above which it is fast; share of its torque scale that is
high."""

QUANTILE = 0.99
"""The scales are this quantile of |speed| and |torque| over all recordings, so that rare spikes have no effect."""

REVERSAL = 0.02  # s; rows this close to a change of the velocity's sign count as reversal

REGIMES = ("all", "still", "slow", "fast", "reversal", "high torque")


@dataclass(frozen=True)
class Thresholds:
    """Limits of the regimes of one joint: speeds rad/s, torque N m, time s; None if there is no velocity."""

    joint: str
    still_below: float | None
    fast_above: float | None
    reversal_within: float
    high_torque_above: float


def thresholds(rows: Rows, joints: tuple[str, ...]) -> list[Thresholds]:
    """Compute the limits of each joint from ``rows``, which should be those of all recordings."""
    limits = []
    for j, joint in enumerate(joints):
        joint_rows = rows.take(rows.joint == j)
        known = len(joint_rows) > 0 and bool(np.isfinite(joint_rows.speed).all())
        speed = float(np.quantile(np.abs(joint_rows.speed), QUANTILE)) if known else None
        torque = float(np.quantile(np.abs(joint_rows.y), QUANTILE)) if len(joint_rows) else 0.0
        slow, fast = (None, None) if speed is None else (STILL * speed, FAST * speed)
        limits.append(Thresholds(joint, slow, fast, REVERSAL, HIGH * torque))
    return limits


def masks(rows: Rows, limits: list[Thresholds]) -> dict[str, np.ndarray]:
    """Return which rows belong to each regime ``(R,)``. Still, slow and fast exclude each other; the others do not."""

    def per_row(values: list[float | None]) -> np.ndarray:
        return np.array([np.nan if v is None else v for v in values])[rows.joint]

    speed = np.abs(rows.speed)  # NaN where it is unknown: compares as false
    still, fast = per_row([x.still_below for x in limits]), per_row([x.fast_above for x in limits])
    return {
        "all": np.ones(len(rows), bool),
        "still": speed < still,
        "slow": (speed >= still) & (speed < fast),
        "fast": speed >= fast,
        "reversal": rows.since_reversal <= REVERSAL,
        "high torque": np.abs(rows.y) > per_row([x.high_torque_above for x in limits]),
    }


def as_text(limits: list[Thresholds]) -> list[str]:
    """Return one line per joint with its limits."""
    speeds = "still below {still_below:.3g} rad/s, fast from {fast_above:.3g} rad/s, reversal within "
    speeds += "{reversal_within:g} s of a sign change"
    unknown = "speed unknown: no still, slow, fast or reversal"
    text = "{joint}: %s; high torque above {high_torque_above:.3g} N m"
    return [(text % (unknown if x.still_below is None else speeds)).format(**asdict(x)) for x in limits]


NAMES = {
    "command": "the command as torque: tau_cmd, or kp e where targets were commanded",
    "pd": "kp e - kd qd with the recordings' gains",
    "linear": "least squares (ridge) in the net's inputs",
    "half_net": "a net of half the width, trained likewise",
}


@dataclass(frozen=True, eq=False)
class Reference:
    """Torque of a reference at the held-out rows ``(R,)``, N m; or None, and the reason."""

    name: str
    torque: np.ndarray | None
    reason: str = ""


def recorded(rows: Rows) -> list[Reference]:
    """Return the commanded torque (kp e if targets were commanded), and the torque of the firmware's PD law."""
    without = {
        "command": "no tau_cmd, and no q_target with known kp",
        "pd": "kp and kd, or q_target and qd, are not in all recordings",
    }
    torque = {name: getattr(rows, name) for name in without}
    return [Reference(n, None, without[n]) if np.isnan(v).any() else Reference(n, v) for n, v in torque.items()]


def linear(train: Rows, train_group: np.ndarray, rows: Rows, group: np.ndarray) -> Reference:
    """Fit one affine map per group of joints to the training rows and apply it to ``rows``; groups (R,) are by row."""
    torque = np.full(len(rows), np.nan)
    for k in np.unique(group):
        train_rows, predicted = train.take(train_group == k), group == k
        # as the net: normalised by the training rows of the same group
        mean, std = train_rows.x.mean(axis=0), train_rows.x.std(axis=0)
        std = np.where(std > 0, std, 1.0)
        weights = ridge((train_rows.x - mean) / std, train_rows.y - train_rows.y.mean())
        torque[predicted] = train_rows.y.mean() + (rows.x[predicted] - mean) / std @ weights
    return Reference("linear", torque)


@dataclass(frozen=True)
class Cell:
    """Errors on the rows of one joint (or ``all``), regime and episode (or ``all``)."""

    joint: str  # its name
    regime: str  # its name
    episode: str  # its name
    rows: int  # number of rows
    rms: float  # root mean square of the target itself, N m
    rmse: dict[str, float]  # model -> root mean square error, N m; ``net`` and the available references


@dataclass(frozen=True)
class Report:
    """Errors on the held-out episodes."""

    target: str  # predicted quantity, ``tau_est`` or ``joint_torque``
    split: Split  # which episodes trained, validated and were held out
    cells: tuple[Cell, ...]  # one for each joint and for all, in each regime that occurs, over all held-out episodes
    episodes: tuple[Cell, ...]  # one for each joint and held-out episode, in the regime ``all``
    missing: dict[str, str]  # unavailable reference -> reason
    thresholds: tuple[Thresholds, ...]  # limits of the regimes

    def cell(self, joint: str = "all", regime: str = "all") -> Cell:
        """Return a cell over all held-out episodes; KeyError without rows of that joint and regime."""
        for cell in self.cells:
            if (cell.joint, cell.regime) == (joint, regime):
                return cell
        raise KeyError(f"{joint}, {regime}")


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
    """Compare predictions on held-out rows: the net's (R,), N m, and the references'; ``episodes`` are their names."""
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


WORTH = 0.95  # share of the error of zero, PD law and linear map below which a net is worth more (chosen)


def useless(report: Report) -> list[str]:
    """Return why a net should not train a policy, a phrase each; empty if it is better than every simple model."""
    wrong = []
    for regime in ("all", "high torque"):
        if not any((c.joint, c.regime) == ("all", regime) for c in report.cells):
            continue
        cell = report.cell("all", regime)
        simple = {"zero": cell.rms, **{name: error for name, error in cell.rmse.items() if name in ("pd", "linear")}}
        for name, error in simple.items():
            # At high torque alone a net may tie; it must not be worse.
            if cell.rmse["net"] > error * (WORTH if regime == "all" else 1.0):
                where = "" if regime == "all" else " at high torque"
                wrong.append(f"no better than {name}{where} ({cell.rmse['net']:.3g} against {error:.3g} N m)")
    return wrong


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
