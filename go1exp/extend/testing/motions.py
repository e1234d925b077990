"""What an excitation promises."""

from __future__ import annotations

from typing import Any

import numpy as np

from go1exp import robot
from go1exp.config.schema.registry import Entry
from go1exp.extend.testing.description import checked, expect
from go1exp.logs.excitations import Motion

RATE_HZ, SECONDS = 200.0, 20.0


def check_excitation(entry: Entry, parameters: dict[str, Any], exact: bool) -> None:
    """A motion of the Go1's joints within their limits; the same for the same seed."""
    values = checked(entry, parameters)
    t = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    centre, limits = robot.NOMINAL_STANCE.copy(), robot.JOINT_POS_LIMITS.copy()

    def make(seed: int) -> Motion:
        motion = entry.target(t, centre, limits, np.random.default_rng(seed), **values)
        expect(entry, isinstance(motion, Motion), "it must return a Motion")
        return motion

    motion, again = make(0), make(0)
    expect(entry, motion.target.shape == (len(t), len(centre)), "its targets must be (T, J)")
    expect(entry, motion.torque_enable.shape == (len(t),), "torque_enable must be (T,)")
    expect(entry, motion.torque_enable.dtype == bool, "torque_enable must be true or false")
    expect(entry, motion.start.shape == centre.shape, "its start must be (J,)")
    for angles in (motion.target, motion.start):
        within = np.isfinite(angles).all() and (angles >= limits[:, 0]).all() and (angles <= limits[:, 1]).all()
        expect(entry, within, "it must stay within the joints' limits")
    same = np.array_equal(motion.target, again.target) and np.array_equal(motion.torque_enable, again.torque_enable)
    expect(entry, same, "the same seed must give the same motion")
    kept = np.array_equal(centre, robot.NOMINAL_STANCE) and np.array_equal(limits, robot.JOINT_POS_LIMITS)
    expect(entry, kept, "it must leave centre and limits as they are")
