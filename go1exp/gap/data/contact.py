"""Which contact the model of a robot on its feet has: the one that was chosen, else the one that recordings name."""

from __future__ import annotations

from collections.abc import Sequence

from go1exp.base.wording import counted
from go1exp.config.schema.physics import MUJOCO_CONTACT, ContactConfig, contact_text
from go1exp.config.schema.registry import ConfigError
from go1exp.gap.result import GapResult
from go1exp.logs.recording import Recording
from go1exp.sim.effects.tolerances import Tolerances

SHOWN = 3
"""Recordings of one contact that a message lists."""

CHOOSE = "contact=stiff (conf/contact, docs/contact.md)"
"""How one is chosen."""


def on_feet(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings of a trunk that is free: one that is held feels no ground, whatever its recording names."""
    return [r for r in recordings if r.meta.base == "floating"]


def contact_of(recordings: Sequence[Recording], chosen: ContactConfig | None) -> ContactConfig:
    """Return the contact of the model that recordings are compared with.

    Args:
        recordings: of one robot.
        chosen: by the user; None takes the one that recordings on the ground name, or MuJoCo's own if none does.

    Raises:
        ConfigError: if they name different ones and none is chosen.
    """
    if chosen is not None:
        return chosen
    by_contact: dict[ContactConfig, list[str]] = {}
    for recording in on_feet(recordings):
        if recording.meta.contact is not None:
            by_contact.setdefault(recording.meta.contact, []).append(recording.meta.episode)
    if len(by_contact) > 1:
        each = "; ".join(f"{_listed(names)}: {contact_text(contact)}" for contact, names in by_contact.items())
        raise ConfigError(
            [
                f"logs: recordings on the ground name different contacts of the feet ({each}), and a model has one; "
                f"compare them one by one, or choose one for all: {CHOOSE}"
            ]
        )
    return next(iter(by_contact), MUJOCO_CONTACT)


def _listed(names: Sequence[str]) -> str:
    rest = len(names) - SHOWN
    return ", ".join(names[:SHOWN]) + (f" and {rest} more" if rest > 0 else "")


def contact_warnings(recordings: Sequence[Recording], contact: ContactConfig) -> list[str]:
    """Return what a reader must know of the contact that the model has, a sentence each."""
    standing = on_feet(recordings)
    others = [r.meta.episode for r in standing if r.meta.contact not in (None, contact)]
    if others:
        return [f"The feet have the contact that was chosen, {contact_text(contact)}; {_listed(others)} name another."]
    silent = [r.meta.episode for r in standing if r.meta.contact is None]
    if not silent:
        return []
    if len(silent) == len(standing):
        return [f"No recording names a contact of the feet; the model has {contact_text(contact)}. Another: {CHOOSE}."]
    return [
        f"{counted(len(silent), 'recording')} of {len(standing)} without a contact of the feet ({_listed(silent)}) are "
        f"taken to have that of the others, {contact_text(contact)}."
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
    """Return the tolerances that counted in a search, about the values that the model had.

    Results of older versions name no contact; theirs was MuJoCo's own.
    """
    return Tolerances.from_effects(result.tolerances, result.contact or MUJOCO_CONTACT)
