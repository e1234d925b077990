"""Excitations that are no motion of their own: targets of a file, and walks in closed loop; motions in real time.

A file of targets is a CSV with a header: ``t`` in s, ``q_target_J`` in rad for every joint J, and where actuators are
off at times ``torque_enable`` (0 or 1). Other columns, such as gains for a player of a laboratory, are left alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from go1exp import robot
from go1exp.base import memory
from go1exp.config.schema.registry import ConfigError, bind, excitation
from go1exp.logs.excitations.motion import ExcitationError, Motion
from go1exp.logs.record.plan import MOTION_BYTES, make_motion
from go1exp.logs.recording import FLAG, joint_channels
from go1exp.robot import JOINTS
from go1exp.robot.messages import LowCmd, LowState
from go1exp.sim.task import MANY_TERMS

ROUNDING = 1e-4  # rad by which a target may lie beyond a limit: a file has a few digits


def written(path: Path) -> dict[str, np.ndarray]:
    """Return columns (T,) by name of a file of targets; ExcitationError, naming a column, if it is no such table."""
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

    A longer recording holds the last target, a shorter one leaves the rest out. The robot is suspended.

    Args:
        t: when commands are sent (T,), s.
        centre: not used; it says how many joints there are (J,).
        limits: lowest and highest target (J, 2), rad.
        rng: not used.
        file: CSV with t, q_target_JOINT of every joint and, if actuators are off at times, torque_enable.

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
    return Motion(target, enabled, target[0].copy(), "suspended")


@excitation("policy", closed_loop=True)
def policy(*_: object) -> None:
    """A trained policy walks under random commands (needs ``run``)."""
    raise NotImplementedError("a policy is played in closed loop, by go1exp.logs.record.simulate.play_policy")


@excitation("mpc", closed_loop=True)
def mpc(*_: object) -> None:
    """A model predictive controller walks under random commands, by position targets alone; needs no policy."""
    raise NotImplementedError("a controller is played in closed loop, by go1exp.logs.record.simulate.play_policy")


# ---------------------------------------------------------------------- in real time

BLEND_S = 2.0
"""Time in which the robot moves from the nominal stance, where standing up ends, to the first target, s (chosen)."""

RATE_HZ = 400.0  # targets per second of a motion that is no file
SECONDS = 20.0  # length of a motion that is no file, if none is given
GAINS = (20.0, 0.5)  # kp, N m/rad, and kd, N m s/rad, of a motion without gains of its own: those of the paper

Gains = tuple[np.ndarray, np.ndarray]


class PlayedMotion:
    """Sends the targets of a motion, one a cycle, at constant gains; moves to the first one before that.

    Attributes:
        name: of the excitation.
        rate: cycles per second.
        seconds: how long it takes, the way to the first target included, s.
        gains: kp, N m/rad, and kd, N m s/rad, (J,) each.
    """

    def __init__(self, name: str, motion: Motion, rate: float, gains: Gains) -> None:
        """Take a suspended robot's motion, rows ``1 / rate`` s apart; ConfigError if another or with drives off."""
        if motion.support == "ground":
            raise ConfigError(
                [f"motion = {name!r}: is for a robot on the ground; deploy plays what a suspended one can do"]
            )
        if not motion.torque_enable.all():
            raise ConfigError([f"motion = {name!r}: switches actuators off, which deploy cannot do"])
        self.name, self.rate, self.gains = name, rate, gains
        self._target, self._blend = motion.target, round(BLEND_S * rate)
        self.seconds = (self._blend + len(motion.target)) / rate
        self._cycle = 0

    def step(self, velocity: np.ndarray, state: LowState, base_lin_vel: np.ndarray) -> LowCmd:
        """Return the command of a cycle; arguments as those of ``go1exp.deploy.runtime.controller.Mover``."""
        row, self._cycle = self._cycle - self._blend, self._cycle + 1
        if row < 0:
            share = 1.0 + row / self._blend
            target = robot.NOMINAL_STANCE + share * (self._target[0] - robot.NOMINAL_STANCE)
        else:
            target = self._target[min(row, len(self._target) - 1)]
        return LowCmd(target, *self.gains)


def played(
    source: str, seconds: float | None, rate: float | None, gains: tuple[float, float] | None, seed: int
) -> PlayedMotion:
    """Return the motion that is asked for.

    Args:
        source: an excitation's name, or a CSV of targets (see the module), whose gains and times count.
        seconds: of an excitation; a file's own length if None.
        rate: of the targets, Hz; that of the file, or 400, if None.
        gains: kp, N m/rad, and kd, N m s/rad; those of the file, or ``GAINS``, if None.
        seed: of an excitation's random numbers.

    Raises:
        ConfigError: if there is no such motion, it is not for a suspended robot, or it does not fit into memory.
        go1exp.logs.excitations.ExcitationError: if the file is no table of targets, or leaves the joints' range.
    """
    table = written(Path(source)) if source.endswith(".csv") else None
    chosen: Gains | None = None
    if table is None:
        name, given = source, {}
        rate, seconds = rate or RATE_HZ, seconds or SECONDS
    else:
        name, given = "playback", {"file": source}
        period = float(np.median(np.diff(table["t"]))) if len(table["t"]) > 1 else 1.0 / RATE_HZ
        rate, seconds = rate or 1.0 / period, seconds or float(table["t"][-1] - table["t"][0]) + period
        chosen = _gains(source, table)
    if gains is not None or chosen is None:
        kp, kd = gains or GAINS
        chosen = np.full(robot.NUM_JOINTS, kp), np.full(robot.NUM_JOINTS, kd)
    term, problems = bind("excitation", name, given, "motion", MANY_TERMS.get("excitation"))
    if term is None:
        raise ConfigError([f"motion = {source!r}: {problem}" for problem in problems])
    if wrong := memory.too_long(seconds, rate * MOTION_BYTES):
        raise ConfigError([f"seconds = {seconds:g}: the motion {wrong}"])
    return PlayedMotion(name, make_motion(term, seconds, rate, seed), rate, chosen)


def _gains(file: str, table: dict[str, np.ndarray]) -> Gains | None:
    """Return the gains (J,) that a file of targets has, or None."""
    columns = [joint_channels(name, robot.JOINTS) for name in ("kp", "kd")]
    if not any(column in table for names in columns for column in names):
        return None
    if missing := [column for names in columns for column in names if column not in table]:
        raise ConfigError([f"{file}: has gains, but no column {missing[0]}"])
    changing = [column for names in columns for column in names if np.ptp(table[column]) > 0.0]
    if changing:
        raise ConfigError([f"{file}: {changing[0]} changes; a recording has one set of gains"])
    kp, kd = (np.array([table[column][0] for column in names]) for names in columns)
    return kp, kd
