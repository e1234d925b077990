"""Recordings, a robot and settings made into a comparison: what every stage of the workflow begins with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.audit import audit
from go1exp.errors import Expected
from go1exp.gap.data.prepare import Ready
from go1exp.gap.data.splits import Splits, splits
from go1exp.gap.data.windows import Windows
from go1exp.gap.result import Floors, GapSettings
from go1exp.gap.robots.hung import hung
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.score.floors import measured, repeatability
from go1exp.gap.score.likelihood import Scorer
from go1exp.recording import Recording, RecordingError
from go1exp.robot import RobotConfig

Progress = Callable[[str, float], None]
"""Called with what is being done, and which share of all is finished."""

FEWEST_WINDOWS = 8
"""Windows below which nothing is judged."""

FEWEST_RECORDINGS = 3
"""Recordings that must remain if others are left out."""

LEVEL = (1.0, 0.0, 0.0, 0.0)


class NotComparable(Expected):
    """Recordings that cannot be compared with a robot.

    Attributes:
        flaws: why, a line each.
        warnings: what a reader must know, a sentence each.
    """

    def __init__(self, sentence: str, flaws: Sequence[str], warnings: Sequence[str]) -> None:
        """Take the reason as one ``sentence`` and as lines."""
        super().__init__(sentence)
        self.flaws, self.warnings = tuple(flaws), tuple(warnings)


@dataclass(frozen=True)
class Comparison:
    """Recordings beside a robot's model, ready to be scored.

    Attributes:
        robot: as it is in the recordings.
        ready: the recordings as they are compared, settings that suit them, and what was chosen.
        windows: the recordings cut.
        dt: physics step, s.
        scorer: scores models on the windows.
        numerical: error of the physics step by quantity, SI units.
    """

    robot: Robot
    ready: Ready
    windows: Windows
    dt: float
    scorer: Scorer
    numerical: dict[str, float]

    @property
    def recordings(self) -> tuple[Recording, ...]:
        """The recordings as they are compared."""
        return self.ready.recordings

    @property
    def settings(self) -> GapSettings:
        """The user's, with windows that suit the recordings."""
        return self.ready.settings

    @property
    def everything(self) -> np.ndarray:
        """(W,) numbers of all windows."""
        return np.arange(len(self.windows))

    def floors(self) -> Floors:
        """Return what no model can get below."""
        noise = self.windows.by_quantity(self.windows.scale)
        known = {name: value for name, value in noise.items() if np.isfinite(value)}
        return Floors(known, self.numerical, repeatability(self.recordings))

    def split(self, rng: np.random.Generator, confirm: float | None = None) -> Splits:
        """Return which windows are for what; ``confirm`` is the share kept for a last check, the settings' if None."""
        share = self.settings.confirm_fraction if confirm is None else confirm
        return splits([r.meta for r in self.recordings], self.windows.episode, share, rng)


def robot_from(robot: RobotConfig | Robot) -> Robot:
    """Return a robot; from its configuration a Go1, hung."""
    return hung(robot) if isinstance(robot, RobotConfig) else robot


def prepare(recordings: Sequence[Recording], robot: Robot, settings: GapSettings) -> tuple[Robot, Ready]:
    """Return the robot as it is in the recordings, and those of them that can be compared with it.

    Raises:
        NotComparable: if too many of them cannot.
    """
    robot = robot.suited(recordings, settings.phase)
    reports = [audit(r) for r in recordings]
    flaws = [robot.flaws(r, report) for r, report in zip(recordings, reports, strict=True)]
    good = [k for k, lines in enumerate(flaws) if not lines]
    lines = tuple(line for each in flaws for line in each)
    if not good or (lines and (len(good) < FEWEST_RECORDINGS or 2 * len(good) < len(recordings))):
        sentence = f"These logs cannot be compared with the model: {'; '.join(lines[:3])}."
        raise NotComparable(sentence, lines, lines)
    ready = robot.prepared([recordings[k] for k in good], [reports[k] for k in good], settings)
    omitted = (f"Left out: {line}." for line in lines)
    return robot, Ready(ready.recordings, ready.settings, ready.ignored, (*omitted, *ready.warnings))


def compare(
    recordings: Sequence[Recording],
    robot: Robot,
    settings: GapSettings,
    on_progress: Progress = lambda what, share: None,
    physics_dt: float | None = None,
    fewest: int = FEWEST_WINDOWS,
) -> Comparison:
    """Prepare recordings, cut them into windows, and measure the floors.

    Args:
        recordings: of one robot.
        robot: the model.
        settings: the user's.
        on_progress: called with what is being done, and which share of the work is finished.
        physics_dt: longest step of the simulation, s, to score at exactly that step; that of the settings if None, for
            which the influence of initial states may be measured at twice the step.
        fewest: windows that are needed.

    Raises:
        NotComparable: if the recordings do not suit the robot, or are too short.
    """
    on_progress("auditing the logs", 0.0)
    robot, ready = prepare(recordings, robot, settings)
    try:
        windows = robot.windows(ready)
    except RecordingError as error:
        raise NotComparable(f"{error}.", [str(error)], ready.warnings) from None
    if len(windows) < fewest:
        short = f"{len(windows)} windows of {ready.settings.window_s:g} s"
        sentence = f"These logs are too short: {short}, {fewest} are needed."
        raise NotComparable(sentence, [f"{short}; {fewest} are needed"], [sentence])
    longest = settings.physics_dt if physics_dt is None else physics_dt
    dt = float(windows.period / np.ceil(windows.period / longest - 1e-3))
    on_progress("measuring the floors", 0.02)
    quats = np.array([ready.recordings[e].meta.base_quat or LEVEL for e in windows.episode])
    replayer = robot.replayer(windows, quats, settings.max_rows, settings.threads)
    scorer, numerical = measured(replayer, dt, 2.0 * dt if physics_dt is None else dt, settings.clock_s)
    return Comparison(robot, ready, windows, dt, scorer, numerical)
