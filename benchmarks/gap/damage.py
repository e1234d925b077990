"""Logs that went wrong after the robot: what a careful reader must notice before looking for physics."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from go1exp.logs.recording import Recording, joint_channel


def damage(recordings: list[Recording], kind: str, rng: np.random.Generator) -> list[Recording]:
    """Return damaged copies of all episodes of a case; the same joint and direction in each.

    ``truncated`` is done to the file, see ``truncate``.

    Raises:
        ValueError: if there is no such kind.
    """
    joints = recordings[0].meta.joints
    first, second = rng.choice(len(joints), 2, replace=False)
    mine, other = joints[first], joints[second]
    return [_one(recording, kind, mine, other, rng) for recording in recordings]


def _one(recording: Recording, kind: str, mine: str, other: str, rng: np.random.Generator) -> Recording:
    channels = dict(recording.channels)
    measured = [c for c in channels if c.startswith(("q_", "qd_")) and not c.startswith("q_target")]
    rows = len(recording.t)
    if kind == "swapped_joints":
        for quantity in ("q", "qd"):
            a, b = joint_channel(quantity, mine), joint_channel(quantity, other)
            channels[a], channels[b] = channels[b], channels[a]
    elif kind == "flipped_sign":
        for quantity in ("q", "qd"):
            channels[joint_channel(quantity, mine)] = -channels[joint_channel(quantity, mine)]
    elif kind == "dropped":
        kept = rng.random(rows) >= 0.3
        kept[0] = True
        channels = {c: values[kept] for c, values in channels.items()}
    elif kind == "shifted_commands":  # commands have a clock of their own, set anew for every episode
        shift = int(rng.choice((-1, 1)) * rng.integers(15, 50))
        for c in (c for c in channels if c.startswith("q_target")):
            source = np.clip(np.arange(rows) - shift, 0, rows - 1)
            channels[c] = channels[c][source]
    elif kind == "degrees":
        for c in measured:
            channels[c] = np.degrees(channels[c])
    elif kind == "frozen":
        for quantity in ("q", "qd"):
            name = joint_channel(quantity, mine)
            stuck = channels[name].copy()
            stuck[rows // 2 :] = stuck[rows // 2]
            channels[name] = stuck
    elif kind == "repeated":  # stale packets are logged again under a new time
        stale = rng.random(rows) < 0.3
        stale[0] = False
        source = np.maximum.accumulate(np.where(stale, 0, np.arange(rows)))
        for c in measured:
            channels[c] = channels[c][source]
    elif kind != "truncated":
        raise ValueError(f"no damage {kind!r}")
    return dataclasses.replace(recording, channels={c: np.ascontiguousarray(v) for c, v in channels.items()})


def truncate(path: Path, share: float) -> None:
    """Cut a file off after ``share`` of its bytes."""
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
