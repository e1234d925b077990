"""The stage ``localise``: where the plain model is wrong, joint by joint and regime by regime."""

from __future__ import annotations

from collections.abc import Sequence

from go1exp.gap.comparison import Progress
from go1exp.gap.result import GapSettings
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.stages.check import CheckResult, check
from go1exp.logs.recording import Recording
from go1exp.robot.config import RobotConfig


def localise(
    recordings: Sequence[Recording],
    robot: RobotConfig | Robot,
    settings: GapSettings,
    on_progress: Progress = lambda what, share: None,
) -> CheckResult:
    """Return a first look at recordings (arguments as for ``check``) without asking what they could not show."""
    return check(recordings, robot, settings, on_progress, screen=False)
