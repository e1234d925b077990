"""Whether a recording of a Go1 can be compared with its model."""

from __future__ import annotations

from go1exp import robot
from go1exp.gap.data.prepare import HINT, TELLING
from go1exp.gap.data.standing import missing
from go1exp.logs.audit import AuditReport
from go1exp.logs.recording import Recording

GO1 = "go1"
ONE_GROUP = (tuple(range(robot.NUM_JOINTS)),)
"""Legs feel each other through a trunk that is free: all joints are one group."""

NEEDED = ("t", "q", "qd", "q_target")
"""Channels, or quantities, without which nothing can be replayed."""


def go1_flaws(recording: Recording, report: AuditReport, joints: tuple[str, ...], free: bool) -> list[str]:
    """Return why a recording cannot be compared with a model of the Go1, a line each.

    Args:
        recording: to compare.
        report: of its audit.
        joints: of the model.
        free: whether the model's trunk is free; a recording of a held one can then be compared as well.
    """
    meta, name = recording.meta, recording.meta.episode
    flaws = []
    if meta.robot != GO1:
        flaws.append(f"{name}: is of the robot {meta.robot!r}; the model is of {GO1!r}; {HINT}")
    if meta.joints != joints:
        flaws.append(f"{name}: has joints {', '.join(meta.joints)}; the model has {', '.join(joints)}")
        return flaws
    if meta.base != "fixed" and not free:
        flaws.append(f"{name}: the trunk is free; only robots with a fixed base can be compared")
    if meta.kp is None or meta.kd is None:
        flaws.append(f"{name}: says no gains (kp, kd)")
    flaws += [f"{name}: no {q}" for q in ("q", "qd", "q_target") if not recording.has(q)]
    if free:
        flaws += [f"{name}: no {quantity}" for quantity in missing(recording)]
    # On its feet a robot's weight moves joints against their targets; a flipped sign is for the comparison to show.
    telling = (*TELLING, "sign") if meta.base == "floating" else TELLING
    if not flaws:
        for flaw in report.flaws:
            needed = flaw.channel in (*NEEDED, "all") or flaw.channel.startswith(("q_", "qd_"))
            if flaw.verdict == "bad" and needed and flaw.check not in telling:
                flaws.append(f"{name}: {flaw.channel}: {flaw.message}")
    return flaws
