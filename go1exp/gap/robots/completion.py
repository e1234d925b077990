"""Recordings of a robot on a fixed base completed by its description: gains, commands, speeds, clock.

Such recordings may lack gains or speeds, or have speeds that disagree with their own angles. What is then compared, and
what is taken for granted, is written to the warnings.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence

import numpy as np

from go1exp import robot
from go1exp.gap.data.prepare import HINT, TELLING, clock_of_speeds, slope
from go1exp.gap.data.standing import missing
from go1exp.gap.robots.description import ModelConfig
from go1exp.logs.audit import AuditReport
from go1exp.logs.audit.related import SPEED_CHECKS
from go1exp.logs.recording import Recording, joint_channel, joint_channels


def flaws_of(recording: Recording, report: AuditReport, config: ModelConfig) -> list[str]:
    """Return why one recording cannot be compared, a line each."""
    meta, name = recording.meta, recording.meta.episode
    flaws = []
    if meta.robot not in config.robots:
        flaws.append(f"{name}: is of the robot {meta.robot!r}; the model is of {', '.join(config.robots)}; {HINT}")
    if sorted(meta.joints) != sorted(config.joints):
        flaws.append(f"{name}: has joints {', '.join(meta.joints)}; the model has {', '.join(config.joints)}")
        return flaws
    if meta.base != "fixed":
        flaws.append(f"{name}: the base is free; only robots with a fixed base can be compared")
    command = "tau_cmd" if config.drive == "torque" else "q_target"
    flaws += [f"{name}: no {quantity}" for quantity in ("q", command) if not recording.has(quantity)]
    if config.drive != "torque" and gains_of(recording, config) is None:
        flaws.append(f"{name}: says no gains (kp, kd), and the model has none")
    needed = {"t", "all", *joint_channels("q", meta.joints), *joint_channels(command, meta.joints)}
    for flaw in report.flaws:
        # Windows with a hole are left out anyway, so holes are bad only where hardly any window is left.
        if flaw.verdict == "bad" and flaw.channel in needed and flaw.check not in (*TELLING, "gaps"):
            flaws.append(f"{name}: {flaw.channel}: {flaw.message}")
    return flaws


def wrong_speeds(recordings: Sequence[Recording], reports: Sequence[AuditReport], config: ModelConfig) -> str:
    """Return why speeds are not compared; empty if they are."""
    if config.clock == "speeds":
        return "they make the clock"
    if config.speeds == "ignored":
        return "the model says so (speeds: ignored)"
    missing = sum(not r.has("qd") for r in recordings)
    if missing:
        return f"{missing} of {len(recordings)} recordings have none"
    bad = [
        flaw
        for report in reports
        for flaw in report.flaws
        if flaw.channel.startswith("qd_") and (flaw.verdict == "bad" or flaw.check in SPEED_CHECKS)
    ]
    return f"{bad[0].channel} {bad[0].message}, and {len(bad) - 1} more such" if bad else ""


def clock_warnings(before: Sequence[Recording], after: Sequence[Recording], config: ModelConfig) -> list[str]:
    """Return what became of the clocks, a sentence each."""
    if config.clock != "speeds":
        return []
    without = [r.meta.episode for r in before if not r.has("qd")]
    rates = [len(r.t) / float(r.t[-1] - r.t[0]) for r in after]
    rate = f"Times were worked out from speeds and angles: rows come at {min(rates):.4g} to {max(rates):.4g} Hz."
    return [rate, *(f"{name} has no speeds and keeps its clock." for name in without)]


def gains_of(recording: Recording, config: ModelConfig) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the gains (J,) in the robot's order; None if one is not known."""
    meta = recording.meta
    if config.drive == "torque":
        return np.zeros(len(config.joints)), np.zeros(len(config.joints))
    order = [meta.joints.index(name) for name in config.joints]
    kp, kd = config.per_joint("kp"), config.per_joint("kd")
    if config.firmware and (match := re.search(config.firmware.note, meta.notes)):
        kp = np.full(len(config.joints), config.firmware.kp * float(match.group(1)))
    kp = kp if meta.kp is None else np.array(meta.kp)[order]
    kd = kd if meta.kd is None else np.array(meta.kd)[order]
    return None if np.isnan([kp, kd]).any() else (kp, kd)


def gain_warnings(recordings: Sequence[Recording], config: ModelConfig) -> list[str]:
    """Return which gains were taken from the model, a sentence each."""
    if config.drive == "torque":
        return ["Commanded torques are played open loop."]
    guessed = [name for name in ("kp", "kd") if any(getattr(r.meta, name) is None for r in recordings)]
    if not guessed:
        return []
    shown = []
    for name, place in (("kp", 0), ("kd", 1)):
        values = np.concatenate([gains[place] for r in recordings if (gains := gains_of(r, config))])
        if name in guessed:
            shown.append(f"{name} {' '.join(f'{v:.3g}' for v in np.unique(values.round(6)))}")
    return [f"Gains that the recordings do not say are the model's guess: {', '.join(shown)}."]


def completed(recording: Recording, config: ModelConfig, speeds: bool) -> Recording:
    """Return a recording with joints in order, gains, a command in the place of the target, and speeds from angles."""
    gains = gains_of(recording, config)
    assert gains is not None
    channels = dict(recording.channels)
    if config.drive == "torque":
        for joint in config.joints:
            channels[joint_channel("q_target", joint)] = channels[joint_channel("tau_cmd", joint)]
    if config.clock == "speeds" and recording.has("qd"):
        q, qd = (recording.block(*joint_channels(name, config.joints)) for name in ("q", "qd"))
        channels["t"] = clock_of_speeds(recording.t, q, qd)
    if speeds:
        for joint in config.joints:
            channels[joint_channel("qd", joint)] = slope(channels["t"], channels[joint_channel("q", joint)])
    kp, kd = (tuple(float(v) for v in values) for values in gains)
    limit = tuple(float(v) for v in config.per_joint("torque_limit"))
    meta = dataclasses.replace(recording.meta, joints=config.joints, kp=kp, kd=kd, tau_limit=limit)
    return Recording(meta, channels)


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
