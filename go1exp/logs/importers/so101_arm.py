"""LeRobot SO-101 arm of six Feetech STS3215 servos (``isaac-sim2real/sage``, Apache 2.0)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from go1exp.config.schema.registry import importer
from go1exp.logs.importers.source import LEVEL, files, joint_columns, load_npz, rate, recording
from go1exp.logs.recording import Quaternion, Recording, RecordingError

JAW = "Jaw"

NOTES = (
    "Command and state were read one after the other over one bus, so a delay of a few tens of milliseconds "
    "includes the bus. The jaw's position is a fraction from 0 to 1, not an angle, and is left out. "
    "Torque is not measured: the source's torque_abs, a scaled current without a sign, is left out. "
    "The servos' gains are unknown. The home pose must be taken from the arm's public description; "
    "the attitude of its base is that of the option base_quat."
)


@importer("so101_arm")
def so101_arm(path: Path, *, base_quat: Quaternion = LEVEL) -> list[Recording]:
    """One motion of a real SO-101 arm, five joints without the jaw, from .npz.

    Args:
        path: a ``.npz``, or a folder of them.
        base_quat: attitude of the arm's base, w-x-y-z.

    Raises:
        RecordingError: if an array is missing or of another shape.
    """
    return [_one(file, base_quat) for file in files(path, "*.npz")]


def _one(path: Path, base_quat: Quaternion) -> Recording:
    data = load_npz(path)
    names = data.names("joint_names")
    if JAW not in names:
        raise RecordingError(f"{path}: joint_names: must have {JAW!r} among them, but are {', '.join(names)}")
    joints = tuple(name for name in names if name != JAW)
    kept = np.flatnonzero([name != JAW for name in names])
    channels = {"t": data.numbers("t")}
    for quantity, key in (("q", "pos"), ("qd", "vel"), ("q_target", "cmd_pos")):
        channels |= joint_columns(quantity, joints, data.numbers(key, len(names))[:, kept])
    return recording(
        path,
        "so101_arm",
        channels,
        robot="so101",
        joints=joints,
        rate_hz=rate(path, channels["t"]),
        base="fixed",
        base_quat=base_quat,
        excitation=path.stem,
        episode=f"so101_{path.stem}",
        notes=NOTES,
    )
