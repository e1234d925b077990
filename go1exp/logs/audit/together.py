"""Checks of several recordings of one robot together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import go1exp.logs.audit.limits as limits
from go1exp.logs.audit.report import AuditReport

EXCEPTION = 3
"""Times as many recordings that must agree before others are exceptions."""


@dataclass(frozen=True)
class CommandDelay:
    """After how long the joints of one recording answer, s, and the standard error of it, s."""

    episode: str
    time: float
    error: float

    def __str__(self) -> str:
        """Return it in words."""
        return f"{1e3 * self.time:.1f} ± {1e3 * self.error:.1f} ms ({self.episode})"

    def differs_from(self, other: CommandDelay) -> bool:
        """Return whether two recordings differ by more than one robot's can."""
        return abs(self.time - other.time) - 2 * float(np.hypot(self.error, other.error)) > limits.DELAY_RECORDINGS

    @property
    def ahead(self) -> bool:
        """Whether joints answer before they are told to."""
        return self.time + 2 * self.error < -limits.DELAY


def command_delays(reports: Sequence[AuditReport]) -> list[CommandDelay]:
    """Return the delay of commands of each recording that shows it at enough of its joints: their median."""
    known = []
    for report in reports:
        angles = [c for c in report.channels if c.name.startswith("q_") and not c.name.startswith("q_target")]
        pairs = [(c.delay_ms, c.delay_sd_ms) for c in angles if c.delay_ms is not None and c.delay_sd_ms is not None]
        if pairs and len(pairs) >= limits.DELAY_JOINTS * len(angles):
            time, error = np.median(np.array(pairs) * 1e-3, axis=0)
            known.append(CommandDelay(report.episode, float(time), float(error)))
    return known


def clock_flaws(reports: Sequence[AuditReport]) -> dict[str, str]:
    """Return what is wrong with recordings whose commands have a clock that is not that of the readings, by episode.

    A robot answers its commands after the same time in every recording, up to what gains and motion change of it. Where
    recordings differ by more, or joints answer before they are told to, commands and readings were not stamped by
    one clock. Single recordings are named where ``EXCEPTION`` times as many agree. Otherwise all are: a clock that is
    set anew for each recording is so in those that do not show it, too.
    """
    known = command_delays(reports)
    groups = [[other for other in known if not one.differs_from(other)] for one in known if not one.ahead]
    agreeing = [one for one in max(groups, key=len, default=[]) if not one.ahead]
    apart = [one for one in known if one not in agreeing]
    if not apart:
        return {}
    why = "commands and readings have clocks of their own"
    if len(agreeing) >= EXCEPTION * len(apart):
        usual = f"{1e3 * float(np.median([one.time for one in agreeing])):.1f} ms in the others"
        return {one.episode: f"joints answer their commands after {one}, {usual}: {why}" for one in apart}
    ordered = sorted(known, key=lambda one: one.time)
    ends = " to ".join(str(one) for one in dict.fromkeys((ordered[0], ordered[-1])))
    return {report.episode: f"joints answer their commands after {ends}: {why}" for report in reports}
