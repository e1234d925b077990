"""A first look: how good can any model be on these logs, where is ours wrong, and what could they not tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from go1exp.gap import answer as words
from go1exp.gap.data.prepare import prepare
from go1exp.gap.data.splits import splits
from go1exp.gap.replay.machine import Machine
from go1exp.gap.result import EXIT_CODES, Floors, GapSettings, Localisation
from go1exp.gap.robots.hung import hung
from go1exp.gap.score.floors import measured, repeatability
from go1exp.gap.score.localise import localise
from go1exp.gap.search.fit import residuals
from go1exp.gap.search.stepwise import Progress, Search
from go1exp.gap.search.trial import excess
from go1exp.gap.stages.explain import FEWEST
from go1exp.recording import Recording, RecordingError
from go1exp.robot import RobotConfig

UNITS = {"q": "rad", "qd": "rad/s", "tau_est": "N m", "imu_gyro": "rad/s", "imu_acc": "m/s2"}


@dataclass(frozen=True)
class Survey:
    """What a first look found.

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
        """Say it in lines."""
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
            lines.append("not excited, so not to be judged from these logs; record next:")
            lines += [f"  {effect}: {more}" for effect, more in self.not_excited.items()]
        return "\n".join(lines)


def survey(
    recordings: Sequence[Recording],
    config: RobotConfig | Machine,
    settings: GapSettings,
    on_progress: Progress = lambda what, share: None,
    screen: bool = True,
) -> Survey:
    """Take a first look at recordings of a held robot; ``screen`` also asks what they could not tell."""
    machine = hung(config) if isinstance(config, RobotConfig) else config
    return _survey(recordings, machine, settings, on_progress, screen)


def _survey(
    recordings: Sequence[Recording], machine: Machine, settings: GapSettings, on_progress: Progress, screen: bool
) -> Survey:
    on_progress("auditing the logs", 0.0)
    ready = prepare(recordings, machine, settings)
    if ready.flaws:
        return Survey(ready.flaws)
    recordings, settings = ready.recordings, ready.settings
    try:
        windows = ready.windows()
    except RecordingError as error:
        return Survey((str(error),))
    if len(windows) < FEWEST:
        return Survey((f"{len(windows)} windows of {settings.window_s:g} s; {FEWEST} are needed",))
    dt = float(windows.period / np.ceil(windows.period / settings.physics_dt - 1e-3))
    on_progress("measuring the floors", 0.1)
    score, numerical = measured(ready, windows, dt, 2.0 * dt)
    rng = np.random.default_rng(settings.seed)
    everything = np.arange(len(windows))
    noise = {name: value for name, value in windows.by_quantity(windows.scale).items() if np.isfinite(value)}
    floors = Floors(noise, numerical, repeatability(recordings))
    on_progress("where it is wrong", 0.4)
    plain = residuals(score, [{}], everything, dt)[0]
    where = localise(score, plain, everything, rng)
    silent = None
    if screen:
        on_progress("what these logs can tell", 0.6)
        parts = splits([r.meta for r in recordings], windows.episode, settings.confirm_fraction, rng)
        search = Search(score, parts, settings, dt, rng, lambda what, share: None)
        search.listen()
        silent = words.not_excited(search.signal, held=not ready.machine.base_probe)
    on_progress("done", 1.0)
    return Survey((), floors, len(windows), excess(score.chi2(plain, everything)), where, silent, ready.warnings)
