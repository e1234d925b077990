"""Before recordings are cut: their clock, spacing, ground contact and fingerprint."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import savgol_filter

from go1exp.base.wording import counted, listed
from go1exp.config.schema.physics import MUJOCO_CONTACT, ContactConfig, contact_text
from go1exp.config.schema.registry import ConfigError
from go1exp.gap.result import GapResult, GapSettings
from go1exp.logs.recording import Recording
from go1exp.sim.effects.tolerances import Tolerances

SMOOTH = 5  # samples of the parabola whose slope is the speed where none was recorded, or none that can be trusted
CLOCK_SPEED = 0.5  # speed, rad/s, from which a moving joint tells the time
CLOCK_ROWS = 401  # rows around a step over which the clock hardly changes its rate
MOST_WINDOWS = 360  # windows beyond which more would only cost time; they are then spread over all recordings
MOST_STEPS = 250_000  # the same as physics steps of all windows, times joints of a group: some minutes of work

HINT = "give the robot of the logs: model=NAME or model=FILE.yaml (go1exp list model, docs/own_robot.md)"
"""What to do where logs are of another robot than the model."""

TELLING = ("delay", "torque")  # checks of the audit that a missing effect may fail; they say nothing against the log


@dataclass(frozen=True)
class Ready:
    """Recordings that can be compared with a robot."""

    recordings: tuple[Recording, ...]  # in the robot's order of joints, with gains, commands and speeds
    settings: GapSettings  # with windows that suit the robot, as far apart as their number asks
    ignored: tuple[str, ...] = ()  # quantities that are present and not compared
    warnings: tuple[str, ...] = ()  # what was chosen, a sentence each
    impossible: int = 0  # rows that were left out since their neighbours rule them out


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
    steps = (top + about * CLOCK_SPEED**2) / (bottom + CLOCK_SPEED**2)
    return np.concatenate([t[:1], t[0] + np.cumsum(steps.clip(0.3 * about, 3.0 * about))])


def noise_in_time(recordings: Sequence[Recording]) -> np.ndarray:
    """Return the noise of unevenly sampled angles (J,), rad, about quartics through nine: median over all places."""
    size, degree = 9, 4
    noises = []
    for r in recordings:
        t, q = (sliding_window_view(x, size, axis=0)[::3] for x in (r.t, r.joint("q")))
        x = (t - t.mean(1, keepdims=True)) / np.ptp(t, axis=1)[:, None]
        basis = np.linalg.qr(x[..., None] ** np.arange(degree + 1))[0]  # P 9 5
        rest = q - np.einsum("pab,pjb->pja", basis, np.einsum("pab,pja->pjb", basis, q))
        noises.append(np.sqrt((rest**2).sum(2) / (size - degree - 1)))
    return np.asarray(np.median(np.concatenate(noises), axis=0)).clip(1e-9)


def slope(t: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the speed (T,), rad/s, of angles (T,) at times (T,): of a parabola through a few samples around each."""
    size = min(SMOOTH, len(q) - (1 - len(q) % 2))
    if size < 3:
        return np.zeros_like(q)
    change, step = (savgol_filter(x, size, 2, deriv=1) for x in (q, t))
    return np.asarray(change / step)


def spaced(recordings: Sequence[Recording], settings: GapSettings, joints: int) -> tuple[GapSettings, list[str]]:
    """Return settings with so many windows as cost no more than minutes, and what there is to say about it."""
    total = sum(float(r.t[-1] - r.t[0]) for r in recordings)
    most = MOST_STEPS * settings.physics_dt / (settings.burn_s + settings.window_s) / joints
    stride = max(settings.stride_s, total / min(most, MOST_WINDOWS))
    if stride == settings.stride_s:
        return settings, []
    warning = f"Of {total:.0f} s, {settings.window_s:g} s in every {stride:.3g} s are compared."
    return dataclasses.replace(settings, stride_s=stride), [warning]


CHOOSE = "contact=stiff (conf/contact, docs/contact.md)"  # how one is chosen


def on_feet(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings of a trunk that is free: one that is held feels no ground, whatever its recording names."""
    return [r for r in recordings if r.meta.base == "floating"]


def contact_of(recordings: Sequence[Recording], chosen: ContactConfig | None) -> ContactConfig:
    """Return the contact of the model that recordings of one robot are compared with.

    That is the ``chosen`` one, else the one that recordings on the ground name, or MuJoCo's own if none does.
    ConfigError if they name different ones and none is chosen.
    """
    if chosen is not None:
        return chosen
    by_contact: dict[ContactConfig, list[str]] = {}
    for recording in on_feet(recordings):
        if recording.meta.contact is not None:
            by_contact.setdefault(recording.meta.contact, []).append(recording.meta.episode)
    if len(by_contact) > 1:
        each = "; ".join(f"{listed(names)}: {contact_text(contact)}" for contact, names in by_contact.items())
        raise ConfigError(
            [
                f"logs: recordings on the ground name different contacts of the feet ({each}), and a model has one; "
                f"compare them one by one, or choose one for all: {CHOOSE}"
            ]
        )
    return next(iter(by_contact), MUJOCO_CONTACT)


def contact_warnings(recordings: Sequence[Recording], contact: ContactConfig) -> list[str]:
    """Return what a reader must know of the contact that the model has, a sentence each."""
    standing = on_feet(recordings)
    others = [r.meta.episode for r in standing if r.meta.contact not in (None, contact)]
    if others:
        return [f"The feet have the contact that was chosen, {contact_text(contact)}; {listed(others)} name another."]
    unnamed = [r.meta.episode for r in standing if r.meta.contact is None]
    if not unnamed:
        return []
    if len(unnamed) == len(standing):
        return [f"No recording names a contact of the feet; the model has {contact_text(contact)}. Another: {CHOOSE}."]
    return [
        f"{counted(len(unnamed), 'recording')} of {len(standing)} without a contact of the feet ({listed(unnamed)}) "
        f"are taken to have that of the others, {contact_text(contact)}."
    ]


def too_coarse(contact: ContactConfig | None, dt: float) -> list[str]:
    """Return what is wrong with a physics step, s, whose double is that of derivatives; nothing without a contact."""
    if contact is None or 4.0 * dt <= contact.time_constant * (1.0 + 1e-3):
        return []
    return [
        f"search.physics_dt = {dt:g} s is coarse for a contact of {1e3 * contact.time_constant:g} ms: derivatives are "
        f"taken at twice that step, at which MuJoCo has no contact below {4e3 * dt:g} ms; "
        f"{0.25 * contact.time_constant:g} s would do."
    ]


def tolerances_of(result: GapResult) -> Tolerances:
    """Return the tolerances of a search, about the values of its model; an older result's contact was MuJoCo's own."""
    return Tolerances.from_effects(result.tolerances, result.contact or MUJOCO_CONTACT)


def fingerprint(recording: Recording) -> str:
    """Return a SHA-256 over a recording's columns, independent of how a file packs them."""
    digest = hashlib.sha256()
    for name in sorted(recording.channels):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(recording.channels[name]).tobytes())
    return digest.hexdigest()
