"""Recordings, a robot and settings made into a comparison: what every stage of the workflow begins with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import get_args

import numpy as np

from go1exp.base.errors import Expected
from go1exp.base.wording import listed
from go1exp.gap.data.prepare import Ready, too_coarse
from go1exp.gap.data.windows import Splits, Windows, splits, stretches
from go1exp.gap.replay.replayer import LEVEL
from go1exp.gap.result import DEFAULT_CLOCK, Clock, ClockChoice, Floors, GapSettings
from go1exp.gap.robots.fixed_base import FixedBase
from go1exp.gap.robots.go1 import suspended
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.score.initial_state import measured, repeatability
from go1exp.gap.score.likelihood import Scorer
from go1exp.gap.search.clocks import OF_CLOCK, Contestant, contest, details, rows_of, same_rows
from go1exp.logs.audit import AuditReport, audit, clock_flaws, clock_kinds
from go1exp.logs.audit.impossible import without
from go1exp.logs.recording import Recording, RecordingError
from go1exp.robot.config import RobotConfig

Progress = Callable[[str, float], None]
"""Called with what is being done, and which share of all is finished."""

FEWEST_WINDOWS = 8  # windows below which nothing is tested
FEWEST_RECORDINGS = 3  # recordings that must remain if others are left out

DOUBTFUL = 1e-3  # share of impossible rows above which a gap that nothing explains is laid to the log

FEWEST_STRETCHES = 8
"""Stretches of held-out windows below which no sign-flip test of two clocks comes to p < 0.01: 2 / 2^8."""

USABLE = 0.5  # share of the windows that must be without holes by a clock for it to compete


class NotComparable(Expected):
    """Recordings that cannot be compared with a robot: why, a line each, and what a reader must know, in sentences."""

    def __init__(self, sentence: str, flaws: Sequence[str], warnings: Sequence[str]) -> None:
        """Take the reason as one ``sentence`` and as lines."""
        super().__init__(sentence)
        self.flaws, self.warnings = tuple(flaws), tuple(warnings)


@dataclass(frozen=True)
class Comparison:
    """Recordings beside a robot's model, ready to be scored."""

    robot: Robot  # as it is in the recordings
    ready: Ready  # the recordings as they are compared, settings that suit them, and what was chosen
    windows: Windows  # the recordings cut
    dt: float  # physics step, s
    scorer: Scorer  # scores models on the windows
    numerical: dict[str, float]  # error of the physics step by quantity, SI units
    clock: ClockChoice | None = None  # which of two clocks the recordings are read by; None if the model says which

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

    @property
    def doubtful(self) -> bool:
        """Whether so many rows were impossible that others like them may remain."""
        rows = sum(len(r.t) for r in self.recordings)
        return self.ready.impossible > DOUBTFUL * rows

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
    """Return a robot; from its configuration a Go1, suspended."""
    return suspended(robot) if isinstance(robot, RobotConfig) else robot


def prepare(recordings: Sequence[Recording], robot: Robot, settings: GapSettings) -> tuple[Robot, Ready]:
    """Return the robot as it is in recordings, and those that can be compared; NotComparable if too many cannot."""
    robot = robot.suited(recordings, settings.phase)
    reports = [audit(r) for r in recordings]
    left_out = sum(len(report.impossible) for report in reports)
    recordings, reports, removed = _without_impossible_rows(recordings, reports)
    clocks = clock_flaws(reports)
    flaws = [
        robot.flaws(r, report) + ([f"{report.episode}: {clocks[report.episode]}"] if report.episode in clocks else [])
        for r, report in zip(recordings, reports, strict=True)
    ]
    good = [k for k, lines in enumerate(flaws) if not lines]
    lines = tuple(line for each in flaws for line in each)
    merged = _merged(lines)
    if not good or (lines and (len(good) < FEWEST_RECORDINGS or 2 * len(good) < len(recordings))):
        sentence = f"These logs cannot be compared with the model: {'; '.join(merged[:3])}."
        raise NotComparable(sentence, lines, merged[3:])
    kept = [reports[k] for k in good]
    copied = [f for report in kept for f in report.by_check("copy") if f.channel.startswith("tau_est_")]
    if settings.torque and copied:
        settings = replace(settings, torque=False)
        removed.append(f"tau_est: {copied[0].channel} {copied[0].message}")
    ready = robot.prepared([recordings[k] for k in good], kept, settings)
    notes = [*(f"Left out: {line}." for line in (*removed, *merged)), *filter(None, [clock_kinds(kept)])]
    return robot, replace(ready, warnings=(*notes, *ready.warnings), impossible=left_out)


def _merged(flaws: Sequence[str]) -> list[str]:
    """Return ``name: flaw`` lines, those of the same flaw as one line with the names of its recordings."""
    names: dict[str, list[str]] = {}
    for line in flaws:
        name, _, flaw = line.partition(": ")
        names.setdefault(flaw, []).append(name)
    return [f"{listed(of_flaw)}: {flaw}" for flaw, of_flaw in names.items()]


def _without_impossible_rows(
    recordings: Sequence[Recording], reports: Sequence[AuditReport]
) -> tuple[list[Recording], list[AuditReport], list[str]]:
    """Return recordings and reports without such rows, and a line for each kind; one with many stays as it is."""
    kept, sound, lines = [], [], []
    for r, report in zip(recordings, reports, strict=True):
        if report.impossible:
            lines += [f"{report.episode}: {f.channel}: {f.message}" for f in report.by_check("impossible")]
            report = replace(report, findings=tuple(f for f in report.findings if f.check != "impossible"))
            r = without(r, np.isin(np.arange(len(r.t)), report.impossible))
        kept.append(r)
        sound.append(report)
    return kept, sound, lines


def compare(
    recordings: Sequence[Recording],
    robot: Robot,
    settings: GapSettings,
    on_progress: Progress = lambda what, share: None,
    physics_dt: float | None = None,
    fewest: int = FEWEST_WINDOWS,
) -> Comparison:
    """Prepare recordings of one robot, cut them into windows, and measure the floors.

    Where the model leaves open which clock they are read by, that is decided first, which takes as long as four short
    searches. At least ``fewest`` windows are needed.

    ``physics_dt`` is the longest step of the simulation, s, to score at exactly that step. None takes that of the
    settings, for which the influence of initial states may be measured at twice the step. NotComparable if the
    recordings do not suit the robot, or are too short. ConfigError if recordings on the ground name different contacts,
    and none was chosen.
    """
    robot, clock = clock_taken(recordings, robot, settings, on_progress)
    on_progress("auditing the logs", 0.0)
    robot, ready = prepare(recordings, robot, settings)
    if clock is not None:
        ready = replace(ready, warnings=(details(clock), *ready.warnings))
    try:
        windows = robot.windows(ready)
    except RecordingError as error:
        raise NotComparable(f"{error}.", [str(error)], ready.warnings) from None
    if len(windows) < fewest:
        short = f"{len(windows)} windows of {ready.settings.window_s:g} s"
        sentence = f"These logs are too short: {short}, {fewest} are needed."
        raise NotComparable(sentence, [f"{short}; {fewest} are needed"], [sentence])
    on_progress("measuring the floors", 0.02)
    dt, scorer, numerical = _scored(robot, ready, windows, settings, physics_dt)
    if physics_dt is None:
        ready = replace(ready, warnings=(*ready.warnings, *too_coarse(robot.tolerances.contact, dt)))
    return Comparison(robot, ready, windows, dt, scorer, numerical, clock)


def _scored(
    robot: Robot, ready: Ready, windows: Windows, settings: GapSettings, physics_dt: float | None = None
) -> tuple[float, Scorer, dict[str, float]]:
    """Return the physics step, s, what scores windows at that step, and its error by quantity."""
    longest = settings.physics_dt if physics_dt is None else physics_dt
    dt = float(windows.period / np.ceil(windows.period / longest - 1e-3))
    quats = np.array([ready.recordings[e].meta.base_quat or LEVEL for e in windows.episode])
    replayer = robot.replayer(windows, quats, settings.max_rows, settings.threads)
    scorer, numerical = measured(replayer, dt, 2.0 * dt if physics_dt is None else dt, settings.clock_s)
    return dt, scorer, numerical


# ---------------------------------------------------------------------- two clocks


def clock_taken(
    recordings: Sequence[Recording],
    robot: Robot,
    settings: GapSettings,
    on_progress: Progress = lambda what, share: None,
) -> tuple[Robot, ClockChoice | None]:
    """Return the robot whose recordings are read by one clock, and how that was chosen; None if its model says which.

    With ``clock: compare`` both compete on windows that a later search does not keep for its last check, by either
    clock. Only angles are compared there: the speeds make one of the clocks. NotComparable if too many recordings do
    not suit the robot.
    """
    if not (isinstance(robot, FixedBase) and robot.config.clock == "compare"):
        return robot, None
    choice = _compared_clocks(recordings, robot, settings, on_progress)
    return robot.by_clock(choice.taken), choice


def _compared_clocks(
    recordings: Sequence[Recording], robot: FixedBase, settings: GapSettings, on_progress: Progress
) -> ClockChoice:
    """Return which clock is taken, and the figures that it rests on."""
    names: tuple[Clock, ...] = get_args(Clock)
    ready = {name: prepare(recordings, robot.by_clock(name, "ignored"), settings)[1] for name in names}
    written = ready["recorded"].recordings
    steps = np.concatenate([np.diff(r.t) / np.median(np.diff(r.t)) for r in written])
    low, high = np.quantile(steps, (0.05, 0.95))
    rates = {n: [(len(r.t) - 1) / float(r.t[-1] - r.t[0]) for r in each.recordings] for n, each in ready.items()}
    rate_hz = {name: (min(each), max(each)) for name, each in rates.items()}
    default = ClockChoice(DEFAULT_CLOCK, False, rate_hz=rate_hz, steps=(float(low), float(high)))
    compared = {r.meta.episode for r in written}
    without = [r.meta.episode for r in recordings if r.meta.episode in compared and not r.has("qd")]
    if without:
        reason = f"{len(without)} of {len(written)} recordings have no speeds, so there is one clock only"
        return replace(default, reason=reason)
    kept = [_last_check(recordings, robot.by_clock(name), settings) for name in names]
    spared = [np.logical_or(*masks) for masks in zip(*kept, strict=True)]
    cuts = {name: partial(robot.by_clock(name, "ignored").windows, ready[name]) for name in names}
    plan = ready["recorded"].settings
    try:
        windows, left = same_rows({name: r.recordings for name, r in ready.items()}, cuts, plan, spared)
    except RecordingError as error:
        return replace(default, reason=str(error))
    most, worst = max(left.values()), min(left, key=lambda name: left[name])
    if left[worst] < USABLE * most:
        taken: Clock = "speeds" if worst == "recorded" else "recorded"
        reason = f"by {OF_CLOCK[worst]} only {left[worst]} of {most} windows are without holes"
        return replace(default, taken=taken, reason=reason)
    episode = windows["recorded"].episode
    parts = splits([r.meta for r in written], episode, 0.0, np.random.default_rng(settings.seed))
    tested = len(np.unique(stretches(episode)[np.concatenate([parts.train, parts.select])]))
    if tested < FEWEST_STRETCHES:
        reason = f"only {tested} stretches of held-out windows remain, and {FEWEST_STRETCHES} are needed"
        return replace(default, reason=reason)
    sides: dict[Clock, Contestant] = {}
    for name in names:
        dt, scorer, _ = _scored(robot.by_clock(name), ready[name], windows[name], plan)
        sides[name] = Contestant(scorer, dt)
    choice = contest(sides, parts, plan, lambda what, share: on_progress(what, 0.0))
    return replace(choice, rate_hz=default.rate_hz, steps=default.steps)


def _last_check(recordings: Sequence[Recording], robot: FixedBase, settings: GapSettings) -> list[np.ndarray]:
    """Return the rows (T,) bool of each comparable recording that a search by the robot's clock keeps for its last."""
    _, ready = prepare(recordings, robot, settings)
    try:
        windows = robot.windows(ready)
    except RecordingError:  # too short by this clock, so there is no last check to spare
        return [np.zeros(len(r.t), dtype=bool) for r in ready.recordings]
    share, rng = settings.confirm_fraction, np.random.default_rng(settings.seed)
    parts = splits([r.meta for r in ready.recordings], windows.episode, share, rng)
    return rows_of(windows, parts.confirm, ready.recordings)
