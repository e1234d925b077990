"""Double pendulum driven by two T-Motor AK80-6 (``dfki-ric-underactuated-lab/double_pendulum``, BSD 3-Clause)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from go1exp.config.schema.registry import importer
from go1exp.logs.importers.source import LEVEL, Arrays, files, joint_columns, load_npz, rate, recording
from go1exp.logs.recording import Recording, RecordingError

SHOULDER_ELBOW = ("shoulder", "elbow")

NOTES = (
    "Design {design}. The shoulder's angle counts from hanging down, the elbow's from the first link. "
    "tau_est comes from the motor current, not from a torque sensor. The clock jitters by milliseconds. "
    "Joint gains are unknown: the drives were given torques. "
)
OPEN_LOOP = "The torques were played open loop; there is no target."
FOLLOWED = (
    "A controller on the computer followed q_target, with torques up to 8 N m of which the drives report "
    "a part only. Its target velocities have no column."
)


@importer("ak80_double_pendulum")
def ak80_double_pendulum(path: Path, *, design: Literal["A", "C"] | None = None) -> list[Recording]:
    """Shoulder and elbow turned by two AK80-6 quasi-direct drives, from the .npz of one run.

    ``tau_con`` becomes ``tau_cmd``, ``tau_meas`` ``tau_est``, and ``pos_des`` ``q_target`` where the source has one.
    The source's filtered positions and velocities equal the measured ones and are left out.

    Args:
        path: a ``.npz``, or a folder with ``design_A*/*.npz`` and ``design_C*/*.npz`` in it.
        design: links of 0.3 and 0.2 m (A) or 0.2 and 0.3 m (C); by default taken from the name of the file's folder.

    Raises:
        RecordingError: if an array is missing, the design is unknown or time does not increase strictly.
    """
    return [_one(file, design) for file in files(path, "*.npz")]


def _one(path: Path, design: str | None) -> Recording:
    design = design or _design(path)
    data = load_npz(path)
    t = data.numbers("time")
    followed = "pos_des1" in data or "pos_des2" in data
    channels = {"t": t}
    names = {"q": "pos_meas", "qd": "vel_meas", "tau_est": "tau_meas", "tau_cmd": "tau_con"}
    if followed:
        names["q_target"] = "pos_des"
    for quantity, name in names.items():
        channels |= joint_columns(quantity, SHOULDER_ELBOW, _pair(data, name))
    return recording(
        path,
        "ak80_double_pendulum",
        channels,
        robot=f"ak80_double_pendulum_{design.lower()}",
        joints=SHOULDER_ELBOW,
        rate_hz=rate(path, t),
        base="fixed",
        base_quat=LEVEL,
        excitation="tracking" if followed else "open_loop_torque",
        episode=f"ak80_{design.lower()}_{path.stem}",
        notes=NOTES.format(design=design) + (FOLLOWED if followed else OPEN_LOOP),
    )


def _pair(data: Arrays, name: str) -> np.ndarray:
    first, second = data.numbers(f"{name}1"), data.numbers(f"{name}2")
    if len(first) != len(second):
        raise RecordingError(f"{data.path}: {name}1 has {len(first)} values, {name}2 has {len(second)}")
    return np.stack([first, second], axis=1)


def _design(path: Path) -> str:
    for design in ("A", "C"):
        if path.resolve().parent.name.startswith(f"design_{design}"):
            return design
    raise RecordingError(
        f"{path}: set design=A or design=C; the name of its folder is neither design_A... nor design_C..."
    )
