"""The stage ``check``: how good can any model be on these logs, where is ours wrong, and what could they not show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.base.tensors.threads import one_thread
from go1exp.gap.answer import can_stand, not_excited
from go1exp.gap.comparison import NotComparable, Progress, compare, robot_from
from go1exp.gap.result import EXIT_CODES, Floors, GapSettings, Localisation
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.score.angle_errors import localise
from go1exp.gap.score.likelihood import excess
from go1exp.gap.search.fit import residuals
from go1exp.gap.search.state import begun
from go1exp.gap.search.stepwise import with_signals
from go1exp.logs.recording import Recording
from go1exp.robot.config import RobotConfig

UNITS = {"q": "rad", "qd": "rad/s", "tau_est": "N m", "imu_gyro": "rad/s", "imu_acc": "m/s2"}


@dataclass(frozen=True)
class CheckResult:
    """What a first look showed.

    Attributes:
        flaws: why the logs cannot be compared; empty if they can.
        floors: what no model can get below.
        windows: number of windows.
        excess: of the plain model, over all windows (floor 0).
        where: it is wrong.
        not_excited: effect -> excitation to record next.
        warnings: what was chosen, a sentence each.
    """

    flaws: tuple[str, ...]
    floors: Floors | None = None
    windows: int = 0
    excess: float = float("nan")
    where: Localisation | None = None
    not_excited: dict[str, str] | None = None
    warnings: tuple[str, ...] = ()

    @property
    def exit_code(self) -> int:
        """0, or that of a bad log."""
        return EXIT_CODES["bad log"] if self.flaws else 0

    def text(self) -> str:
        """Return it as lines for people."""
        if self.flaws or self.floors is None:
            return "\n".join(["these logs cannot be compared with the model:", *(f"  {f}" for f in self.flaws)])
        lines = [f"{self.windows} windows; the plain model's error is {1 + self.excess:.3g} times the floor"]
        lines = [*self.warnings, *lines]
        for name, value in self.floors.noise.items():
            line = f"  {name}: noise {value:.2g} {UNITS[name]}, error of the step {self.floors.numerical[name]:.2g}"
            if self.floors.repeatability and name in self.floors.repeatability:
                line += f", repetitions differ by {self.floors.repeatability[name]:.2g}"
            lines.append(line)
        if self.not_excited:
            lines.append("not identifiable from these logs; record next:")
            lines += [f"  {effect}: {excitation}" for effect, excitation in self.not_excited.items()]
        return "\n".join(lines)


def check(
    recordings: Sequence[Recording],
    robot: RobotConfig | Robot,
    settings: GapSettings,
    on_progress: Progress = lambda what, share: None,
    screen: bool = True,
) -> CheckResult:
    """Take a first look at recordings of a robot."""
    robot = robot_from(robot)
    with one_thread():
        try:
            comparison = compare(recordings, robot, settings, on_progress)
        except NotComparable as error:
            return CheckResult(error.flaws)
        on_progress("where it is wrong", 0.4)
        score, everything = comparison.scorer, comparison.everything
        rng = np.random.default_rng(settings.seed)
        plain = residuals(score, [{}], everything, comparison.dt)[0]
        where = localise(score, plain, everything, rng)
        unexcited = None
        if screen:
            on_progress("what these logs can show", 0.6)
            parts = comparison.split(rng)
            search = with_signals(begun(score, parts, comparison.settings, comparison.dt, rng))
            unexcited = not_excited(search.signal, held=can_stand(comparison.robot))
    on_progress("done", 1.0)
    error_of_all = excess(score.chi2(plain, everything))
    return CheckResult(
        (), comparison.floors(), len(everything), error_of_all, where, unexcited, comparison.ready.warnings
    )
