"""A motion from a file: targets over time that were designed or written down somewhere else.

The file is a CSV with a header: ``t`` in s, ``q_target_J`` in rad for every joint J, and where drives are off at times
``torque_enable`` (0 or 1). Other columns, such as gains for a player of a laboratory, are left alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from go1exp.config.schema.registry import excitation
from go1exp.logs.excitations.motion import ExcitationError, Motion
from go1exp.logs.recording import FLAG, joint_channels
from go1exp.robot import JOINTS

ROUNDING = 1e-4
"""Rad by which a target may lie beyond a limit: a file has a few digits."""


def written(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a file of targets, by name, each (T,).

    Raises:
        ExcitationError: if it is missing, or no table of numbers with increasing times; the message names the column.
    """
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ExcitationError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    if "t" not in names:
        raise ExcitationError(f"{path}: the first line must name the columns, t among them; it has {names[:4]}")
    try:
        rows = np.loadtxt(lines[1:], delimiter=",", ndmin=2)
    except ValueError as error:
        raise ExcitationError(f"{path}: not a table of numbers ({str(error).splitlines()[0]})") from None
    if rows.shape[1:] != (len(names),) or not len(rows):
        raise ExcitationError(f"{path}: {rows.shape[0]} rows of numbers for {len(names)} columns")
    table = dict(zip(names, rows.T, strict=True))
    for name, values in table.items():
        if not np.isfinite(values).all():
            raise ExcitationError(f"{path}: column {name} has a value that is not finite")
    if np.any(np.diff(table["t"]) <= 0.0):
        raise ExcitationError(f"{path}: column t must increase from row to row")
    return table


@excitation("playback")
def playback(
    t: np.ndarray,
    centre: np.ndarray,
    limits: np.ndarray,
    rng: np.random.Generator,
    *,
    file: Annotated[str, Field(min_length=1)],
) -> Motion:
    """Play the targets of a file, such as the one of ``go1exp gap next``; each holds until the next.

    A longer recording holds the last target, a shorter one leaves the rest out. The robot is hung.

    Args:
        t: when commands are sent (T,), s.
        centre: not used; it says how many joints there are (J,).
        limits: lowest and highest target (J, 2), rad.
        rng: not used.
        file: CSV with t, q_target_JOINT of every joint and, if drives are off at times, torque_enable.

    Raises:
        ExcitationError: if the file is none, has targets of other joints, or goes beyond ``limits``.
    """
    path = Path(file)
    table = written(path)
    named = [name for name in table if name.startswith("q_target_")]
    ours = joint_channels("q_target", JOINTS)
    order = ours if len(centre) == len(JOINTS) and set(named) == set(ours) else named
    if len(order) != len(centre) or (len(centre) == len(JOINTS) and order is not ours):
        raise ExcitationError(f"{path}: has targets of {len(named)} joints; needed are {len(centre)}: q_target_JOINT")
    rows = (np.searchsorted(table["t"] - table["t"][0], t - t[0] + 1e-7, side="right") - 1).clip(0)
    target = np.stack([table[name] for name in order], axis=1)[rows]
    for j in np.flatnonzero(np.any((target < limits[:, 0] - ROUNDING) | (target > limits[:, 1] + ROUNDING), axis=0)):
        low, high = limits[j]
        reach = f"{target[:, j].min():.3g} to {target[:, j].max():.3g} rad"
        raise ExcitationError(f"{path}: {order[j]} goes from {reach}; allowed is [{low:.3g}, {high:.3g}] rad")
    enabled = table[FLAG][rows] > 0.5 if FLAG in table else np.ones(len(t), dtype=bool)
    target = target.clip(limits[:, 0], limits[:, 1])
    return Motion(target, enabled, target[0].copy(), "hung")
