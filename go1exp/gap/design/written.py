"""A designed recording as a file that a robot can play: time, targets and gains, row by row."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from go1exp.base.files import write_text
from go1exp.gap.design.rehearsal import Rehearsal
from go1exp.logs.recording import FLAG, joint_channels


def table(played: Rehearsal, joints: tuple[str, ...], period: float) -> str:
    """Return a design as a CSV: t in s, targets in rad, gains in N m/rad and N m s/rad, and whether drives are on.

    ``go1exp record`` plays it as the excitation ``playback``, and takes the gains from its own setting ``gains``.
    """
    rows = len(played.motion.target)
    names = ["t", *joint_channels("q_target", joints), *joint_channels("kp", joints), *joint_channels("kd", joints)]
    gains = np.tile(np.concatenate([played.kp, played.kd]), (rows, 1))
    t = np.arange(rows)[:, None] * period
    values = np.concatenate([t, played.motion.target, gains], axis=1)
    lines = [",".join([*names, FLAG])]
    for row, on in zip(values, played.motion.torque_enable, strict=True):
        lines.append(",".join([f"{row[0]:.6f}", *(f"{v:.5f}".rstrip("0").rstrip(".") for v in row[1:]), str(int(on))]))
    return "\n".join(lines) + "\n"


def write(played: Rehearsal, joints: tuple[str, ...], period: float, path: Path) -> Path:
    """Write a design and return its file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, table(played, joints, period))
    return path
