"""Simple models that a net is compared with: the command, the PD law, a linear map of its inputs, a smaller net."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from go1exp.gap.actuator_net.dataset import Rows
from go1exp.gap.actuator_net.train import ridge

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


def command(rows: Rows) -> Reference:
    """Predict the commanded torque; kp e if targets were commanded."""
    if np.isnan(rows.command).any():
        return Reference("command", None, "no tau_cmd, and no q_target with known kp")
    return Reference("command", rows.command)


def pd(rows: Rows) -> Reference:
    """Predict the torque of the firmware's PD law."""
    if np.isnan(rows.pd).any():
        return Reference("pd", None, "kp and kd, or q_target and qd, are not in all recordings")
    return Reference("pd", rows.pd)


def linear(train: Rows, train_group: np.ndarray, rows: Rows, group: np.ndarray) -> Reference:
    """Fit one affine map per group of joints to the training rows and apply it to ``rows``.

    Args:
        train: training rows.
        train_group: index of the net for each training row ``(R,)``.
        rows: held-out rows.
        group: index of the net for each held-out row.
    """
    torque = np.full(len(rows), np.nan)
    for k in np.unique(group):
        train_rows, predicted = train.take(train_group == k), group == k
        # as the net: normalised by the training rows of the same group
        mean, std = train_rows.x.mean(axis=0), train_rows.x.std(axis=0)
        std = np.where(std > 0, std, 1.0)
        weights = ridge((train_rows.x - mean) / std, train_rows.y - train_rows.y.mean())
        torque[predicted] = train_rows.y.mean() + (rows.x[predicted] - mean) / std @ weights
    return Reference("linear", torque)
