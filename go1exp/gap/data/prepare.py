"""Recordings as they come -> recordings and windows that can be compared with a machine, and what had to be chosen.

The hung Go1 takes recordings as they are. Those of other robots lack gains or speeds, or have speeds that disagree with
their own angles: what is then compared, and what is taken for granted, is said in ``warnings``.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import savgol_filter

from go1exp.audit import AuditReport, audit
from go1exp.audit.related import SPEED_CHECKS
from go1exp.gap.data.standing import cut_standing, for_feet, missing
from go1exp.gap.data.windows import Windows, cut
from go1exp.gap.replay.machine import Machine
from go1exp.gap.result import GapSettings
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.standing import StandingGo1, on_feet
from go1exp.recording import Recording, joint_channel, joint_channels

SMOOTH = 5
"""Samples of the parabola whose slope is the speed where none was recorded, or none that can be trusted."""

CLOCK_SPEED = 0.5
"""Speed, rad/s, from which a moving joint tells the time."""

CLOCK_ROWS = 401
"""Rows around a step over which the clock hardly changes its rate."""

MOST_WINDOWS = 360
"""Windows beyond which more would only cost time; they are then spread over all recordings."""

MOST_STEPS = 250_000
"""The same as physics steps of all windows, times joints of a group: some minutes of work."""

TELLING = ("delay", "torque")
"""Checks of the audit that a missing effect may fail; they say nothing against the log."""

NEEDED = ("t", "q", "qd", "q_target")
"""Channels, or quantities, without which nothing can be replayed."""

GO1 = "go1"

FEWEST = 3
"""Recordings that must be left if others are left out."""


@dataclass(frozen=True)
class Ready:
    """Recordings that can be compared.

    Attributes:
        recordings: in the machine's order of joints, with gains, commands and speeds.
        machine: what they are compared with.
        settings: with the windows as far apart as their number asks.
        ignored: quantities that are there and not compared.
        warnings: what was chosen, a sentence each.
        flaws: why nothing can be compared, a line each; the rest is then empty.
    """

    recordings: tuple[Recording, ...]
    machine: Machine
    settings: GapSettings
    ignored: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    flaws: tuple[str, ...] = ()

    def windows(self) -> Windows:
        """Cut them; what is ignored has infinite noise.

        Raises:
            RecordingError: if they are too short.
        """
        if isinstance(self.machine, StandingGo1):
            return cut_standing(self.recordings, self.settings, self.machine.config)
        found = cut(self.recordings, self.settings)
        if isinstance(self.machine, FixedBase) and self.machine.config.clock == "speeds":
            found.scale[:, 0] = noise_in_time(self.recordings)
        for c, quantity in enumerate(found.quantities):
            if quantity in self.ignored:
                found.scale[:, c] = np.inf
        return found


def prepare(recordings: Sequence[Recording], machine: Machine, settings: GapSettings) -> Ready:
    """Make recordings comparable with a machine, or say why they are not; the Go1 takes them as they are."""
    machine = on_feet(machine, recordings)
    reports = [audit(r) for r in recordings]
    if isinstance(machine, FixedBase):
        flaws = [_flaws(r, a, machine) for r, a in zip(recordings, reports, strict=True)]
    else:
        flaws = [unusable(r, a, machine) for r, a in zip(recordings, reports, strict=True)]
    good = [k for k, lines in enumerate(flaws) if not lines]
    lines = tuple(line for own in flaws for line in own)
    if not good or (lines and (len(good) < FEWEST or 2 * len(good) < len(recordings))):
        return Ready((), machine, settings, flaws=lines)
    warnings = [f"Left out: {line}." for line in lines]
    kept = [recordings[k] for k in good]
    if isinstance(machine, StandingGo1):
        return Ready(tuple(kept), machine, for_feet(settings, kept), warnings=tuple(warnings))
    if not isinstance(machine, FixedBase):
        return Ready(tuple(kept), machine, settings, warnings=tuple(warnings))
    wrong = _wrong_speeds(kept, [reports[k] for k in good], machine)
    if wrong:
        warnings.append(f"Speeds are not compared, and first speeds come from the angles: {wrong}.")
    found = tuple(_completed(r, machine, bool(wrong)) for r in kept)
    warnings += [*_clocks(kept, found, machine), *_guesses(kept, machine)]
    spaced, said = _spaced(found, settings, len(machine.groups[0]))
    return Ready(found, machine, spaced, ("qd",) if wrong else (), (*warnings, *said))


def unusable(recording: Recording, report: AuditReport, machine: Machine) -> list[str]:
    """Return why a recording cannot be compared with a model of the Go1, a line each."""
    meta, name = recording.meta, recording.meta.episode
    found = []
    if meta.robot != GO1:
        found.append(f"{name}: is of the robot {meta.robot!r}; the model is of {GO1!r}")
    if meta.joints != machine.joints:
        found.append(f"{name}: has joints {', '.join(meta.joints)}; the model has {', '.join(machine.joints)}")
        return found
    if meta.base != "fixed" and not machine.base_probe:
        found.append(f"{name}: the trunk is free; only robots with a fixed base can be compared")
    if meta.kp is None or meta.kd is None:
        found.append(f"{name}: says no gains (kp, kd)")
    found += [f"{name}: no {q}" for q in ("q", "qd", "q_target") if not recording.has(q)]
    if isinstance(machine, StandingGo1):
        found += [f"{name}: no {quantity}" for quantity in missing(recording)]
    # On its feet a robot's weight moves joints against their targets; a flipped sign is for the comparison to show.
    telling = (*TELLING, "sign") if meta.base == "floating" else TELLING
    if not found:
        for flaw in report.flaws:
            needed = flaw.channel in (*NEEDED, "all") or flaw.channel.startswith(("q_", "qd_"))
            if flaw.verdict == "bad" and needed and flaw.check not in telling:
                found.append(f"{name}: {flaw.channel}: {flaw.message}")
    return found


def _flaws(recording: Recording, report: AuditReport, machine: FixedBase) -> list[str]:
    """Return why one recording cannot be compared, a line each."""
    meta, config, name = recording.meta, machine.config, recording.meta.episode
    found = []
    if meta.robot not in config.robots:
        found.append(f"{name}: is of the robot {meta.robot!r}; the model is of {', '.join(config.robots)}")
    if sorted(meta.joints) != sorted(machine.joints):
        found.append(f"{name}: has joints {', '.join(meta.joints)}; the model has {', '.join(machine.joints)}")
        return found
    if meta.base != "fixed":
        found.append(f"{name}: the base is free; only robots with a fixed base can be compared")
    command = "tau_cmd" if config.drive == "torque" else "q_target"
    found += [f"{name}: no {quantity}" for quantity in ("q", command) if not recording.has(quantity)]
    if config.drive == "position" and _gains(recording, machine) is None:
        found.append(f"{name}: says no gains (kp, kd), and the model has none")
    needed = {"t", "all", *joint_channels("q", meta.joints), *joint_channels(command, meta.joints)}
    for flaw in report.flaws:
        # Windows with a hole are left out anyway, so holes are bad only where hardly any window is left.
        if flaw.verdict == "bad" and flaw.channel in needed and flaw.check not in (*TELLING, "gaps"):
            found.append(f"{name}: {flaw.channel}: {flaw.message}")
    return found


def _wrong_speeds(recordings: Sequence[Recording], reports: Sequence[AuditReport], machine: FixedBase) -> str:
    """Return why speeds are not compared; empty if they are."""
    if machine.config.clock == "speeds":
        return "they make the clock"
    if machine.config.speeds == "ignored":
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


def _clocks(before: Sequence[Recording], after: Sequence[Recording], machine: FixedBase) -> list[str]:
    """Say what became of the clocks."""
    if machine.config.clock != "speeds":
        return []
    without = [r.meta.episode for r in before if not r.has("qd")]
    rates = [len(r.t) / float(r.t[-1] - r.t[0]) for r in after]
    said = f"Times were worked out from speeds and angles: rows come at {min(rates):.4g} to {max(rates):.4g} Hz."
    return [said, *(f"{name} has no speeds and keeps its clock." for name in without)]


def _gains(recording: Recording, machine: FixedBase) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the gains (J,) in the machine's order; None if one is not known."""
    meta, config = recording.meta, machine.config
    if config.drive == "torque":
        return np.zeros(len(machine.joints)), np.zeros(len(machine.joints))
    order = [meta.joints.index(name) for name in machine.joints]
    kp, kd = config.per_joint("kp"), config.per_joint("kd")
    if config.firmware and (match := re.search(config.firmware.note, meta.notes)):
        kp = np.full(len(machine.joints), config.firmware.kp * float(match.group(1)))
    kp = kp if meta.kp is None else np.array(meta.kp)[order]
    kd = kd if meta.kd is None else np.array(meta.kd)[order]
    return None if np.isnan([kp, kd]).any() else (kp, kd)


def _guesses(recordings: Sequence[Recording], machine: FixedBase) -> list[str]:
    """Say whose gains were taken from the model."""
    if machine.config.drive == "torque":
        return ["Commanded torques are played open loop."]
    own = [name for name in ("kp", "kd") if any(getattr(r.meta, name) is None for r in recordings)]
    if not own:
        return []
    shown = []
    for name, place in (("kp", 0), ("kd", 1)):
        values = np.concatenate([found[place] for r in recordings if (found := _gains(r, machine))])
        if name in own:
            shown.append(f"{name} {' '.join(f'{v:.3g}' for v in np.unique(values.round(6)))}")
    return [f"Gains that the recordings do not say are the model's guess: {', '.join(shown)}."]


def _completed(recording: Recording, machine: FixedBase, speeds: bool) -> Recording:
    """Return a recording with joints in order, gains, a command in the place of the target, and speeds from angles."""
    gains = _gains(recording, machine)
    assert gains is not None
    channels = dict(recording.channels)
    if machine.config.drive == "torque":
        for joint in machine.joints:
            channels[joint_channel("q_target", joint)] = channels[joint_channel("tau_cmd", joint)]
    if machine.config.clock == "speeds" and recording.has("qd"):
        q, qd = (recording.block(*joint_channels(name, machine.joints)) for name in ("q", "qd"))
        channels["t"] = clock_of_speeds(recording.t, q, qd)
    if speeds:
        for joint in machine.joints:
            channels[joint_channel("qd", joint)] = slope(channels["t"], channels[joint_channel("q", joint)])
    kp, kd = (tuple(float(v) for v in values) for values in gains)
    limit = tuple(machine.effort)
    meta = dataclasses.replace(recording.meta, joints=machine.joints, kp=kp, kd=kd, tau_limit=limit)
    return Recording(meta, channels)


def clock_of_speeds(t: np.ndarray, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """Return times (T,), s, at which angles (T, J) change as speeds (T, J) say; those of ``t`` where nothing moves.

    Each step is the least-squares ratio of change to mean speed over all joints, drawn to that of the seconds around it
    as if one joint moved there at ``CLOCK_SPEED``. A factor common to all speeds goes into the clock.
    """
    change, mean = np.diff(q, axis=0), 0.5 * (qd[1:] + qd[:-1])
    top, bottom = (change * mean).sum(1), (mean**2).sum(1)
    step, whole = np.diff(t), np.ones(min(CLOCK_ROWS, len(t) - 1))
    near = [np.convolve(x, whole, "same") for x in (top, bottom, step * CLOCK_SPEED**2)]
    about = (near[0] + near[2]) / (near[1] + CLOCK_SPEED**2 * np.convolve(np.ones_like(step), whole, "same"))
    found = (top + about * CLOCK_SPEED**2) / (bottom + CLOCK_SPEED**2)
    return np.concatenate([t[:1], t[0] + np.cumsum(found.clip(0.3 * about, 3.0 * about))])


def noise_in_time(recordings: Sequence[Recording]) -> np.ndarray:
    """Return the noise of the angles (J,), rad, where samples are uneven in time: about quartics through nine of them.

    The median of root mean squares over all places, as such a robot may never be at rest.
    """
    size, degree = 9, 4
    found = []
    for r in recordings:
        t, q = (sliding_window_view(x, size, axis=0)[::3] for x in (r.t, r.joint("q")))
        x = (t - t.mean(1, keepdims=True)) / np.ptp(t, axis=1)[:, None]
        basis = np.linalg.qr(x[..., None] ** np.arange(degree + 1))[0]  # P 9 5
        rest = q - np.einsum("pab,pjb->pja", basis, np.einsum("pab,pja->pjb", basis, q))
        found.append(np.sqrt((rest**2).sum(2) / (size - degree - 1)))
    return np.asarray(np.median(np.concatenate(found), axis=0)).clip(1e-9)


def slope(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the speed (T,), rad/s, of angles (T,) at times (T,): of a parabola through a few samples around each."""
    size = min(SMOOTH, len(q) - (1 - len(q) % 2))
    if size < 3:
        return np.zeros_like(q)
    change, step = (savgol_filter(x, size, 2, deriv=1) for x in (q, t))
    return np.asarray(change / step)


def _spaced(recordings: Sequence[Recording], settings: GapSettings, joints: int) -> tuple[GapSettings, list[str]]:
    """Return settings with so many windows as cost no more than minutes, and what there is to say about it."""
    total = sum(float(r.t[-1] - r.t[0]) for r in recordings)
    most = MOST_STEPS * settings.physics_dt / (settings.burn_s + settings.window_s) / joints
    stride = max(settings.stride_s, total / min(most, MOST_WINDOWS))
    if stride == settings.stride_s:
        return settings, []
    said = f"Of {total:.0f} s, {settings.window_s:g} s in every {stride:.3g} s are compared."
    return dataclasses.replace(settings, stride_s=stride), [said]
