"""Motions of ``go1exp record`` on a robot in real time: hung up, by the runtime of ``go1exp deploy``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from go1exp import robot
from go1exp.base import memory
from go1exp.config.schema.registry import ConfigError, bind
from go1exp.logs.excitations import Motion
from go1exp.logs.record.plan import MOTION_BYTES, make_motion
from go1exp.logs.record.playback import written
from go1exp.logs.recording import joint_channels
from go1exp.robot.messages import LowCmd, LowState
from go1exp.sim.task import MANY_TERMS

BLEND_S = 2.0
"""Time in which the robot moves from the nominal stance, where standing up ends, to the first target, s (chosen)."""

RATE_HZ = 400.0
"""Targets per second of a motion that is no file."""

SECONDS = 20.0
"""Length of a motion that is no file, if none is given."""

GAINS = (20.0, 0.5)
"""kp, N m/rad, and kd, N m s/rad, of a motion for which nobody gives any: those of the paper."""

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
        """Take a motion of a hung robot, whose rows are ``1 / rate`` s apart.

        Raises:
            ConfigError: if the motion is not for a hung robot, or has the drives off at times.
        """
        if motion.support == "ground":
            raise ConfigError([f"motion = {name!r}: is for a robot on the ground; deploy plays what a hung one can do"])
        if not motion.torque_enable.all():
            raise ConfigError([f"motion = {name!r}: has the drives off at times, which a robot here cannot be told"])
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
    wish: str, seconds: float | None, rate: float | None, gains: tuple[float, float] | None, seed: int
) -> PlayedMotion:
    """Return the motion that is asked for.

    Args:
        wish: an excitation's name, or a CSV of targets (``logs/record/playback.py``), whose gains and times count.
        seconds: of an excitation; a file's own length if None.
        rate: of the targets, Hz; that of the file, or 400, if None.
        gains: kp, N m/rad, and kd, N m s/rad; those of the file, or ``GAINS``, if None.
        seed: of an excitation's random numbers.

    Raises:
        ConfigError: if there is no such motion, it is not for a hung robot, or it does not fit into memory.
        go1exp.logs.excitations.ExcitationError: if the file is no table of targets, or leaves the joints' range.
    """
    table = written(Path(wish)) if wish.endswith(".csv") else None
    chosen: Gains | None = None
    if table is None:
        name, given = wish, {}
        rate, seconds = rate or RATE_HZ, seconds or SECONDS
    else:
        name, given = "playback", {"file": wish}
        period = float(np.median(np.diff(table["t"]))) if len(table["t"]) > 1 else 1.0 / RATE_HZ
        rate, seconds = rate or 1.0 / period, seconds or float(table["t"][-1] - table["t"][0]) + period
        chosen = _gains(wish, table)
    if gains is not None or chosen is None:
        kp, kd = gains or GAINS
        chosen = np.full(robot.NUM_JOINTS, kp), np.full(robot.NUM_JOINTS, kd)
    term, problems = bind("excitation", name, given, "motion", MANY_TERMS.get("excitation"))
    if term is None:
        raise ConfigError([f"motion = {wish!r}: {problem}" for problem in problems])
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
