"""What every way of looking at a Go1 has in common: its drives, and which logs of it can be compared."""

from __future__ import annotations

from typing import ClassVar

from go1exp import robot
from go1exp.config.schema.registry import Term
from go1exp.gap.replay.machine import pd
from go1exp.gap.robots.go1_logs import go1_flaws
from go1exp.logs.audit import AuditReport
from go1exp.logs.recording import Recording
from go1exp.robot.config import RobotConfig


class Go1:
    """Base of the Go1's kinds of comparison.

    Attributes:
        config: of the robot.
        joints: names.
        on_ground: whether it stands on its feet.
        free_trunk: whether its trunk moves.
    """

    config: RobotConfig
    joints: tuple[str, ...]
    on_ground: bool
    free_trunk: ClassVar[bool]

    @property
    def effort(self) -> tuple[float, ...]:
        """Peak torque (J,), N m."""
        return tuple(float(v) for v in robot.per_joint(self.config.effort_limit))

    def drive(self) -> Term:
        """Return the ideal PD law."""
        return pd()

    def flaws(self, recording: Recording, report: AuditReport) -> list[str]:
        """Return why a recording cannot be compared, a line each."""
        return go1_flaws(recording, report, self.joints, free=self.free_trunk)
