"""What a robot must know of itself to be compared with recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from go1exp.gap.data.prepare import Ready
from go1exp.gap.data.windows import Windows
from go1exp.gap.replay.replayer import Replayer
from go1exp.gap.replay.rows import Machine
from go1exp.gap.result import GapSettings, Phase
from go1exp.logs.audit import AuditReport
from go1exp.logs.recording import Recording


class Robot(Machine, Protocol):
    """A robot that can be replayed, and that knows which recordings can be compared with it, and how."""

    def suited(self, recordings: Sequence[Recording], phase: Phase = "whole") -> Robot:
        """Return the robot as it is in these recordings: suspended, standing, or its legs while they are in the air."""

    def flaws(self, recording: Recording, report: AuditReport) -> list[str]:
        """Return why a recording cannot be compared with this robot, a line each."""

    def prepared(self, recordings: Sequence[Recording], reports: Sequence[AuditReport], settings: GapSettings) -> Ready:
        """Return recordings without flaws as they are compared, and what had to be chosen."""

    def windows(self, ready: Ready) -> Windows:
        """Cut recordings into windows, what is ignored with infinite noise; RecordingError if they are too short."""

    def replayer(self, windows: Windows, quats: np.ndarray, max_rows: int, threads: int) -> Replayer:
        """Return what runs this robot through its windows; a held base has attitudes ``quats`` (W, 4), w-x-y-z."""
