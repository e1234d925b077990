"""``protocol=kicks``: kicks of rising strength while walking (paper, Fig. 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from go1exp.base.report import plots
from go1exp.config.schema.registry import NonNegative, Positive, protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.protocol.base import Cause, Length, Played, Protocol, bands, lives, repeated, rounded
from go1exp.evaluate.protocol.plan import Array, Impulse, Impulses, Motion, Plan, Point, Signal
from go1exp.evaluate.quantities import Column, Row, Summaries, Summary

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.stage import Stage

COARSE = 0.04  # period of the paper's plot, 25 Hz, s
PEAK_WITHIN = 1.0  # time after a kick in which its largest speed is looked for, s
BEFORE = 2.0  # time before a kick whose mean is the height and velocity to come back to, s
LEAST = 2.0  # shortest time before a kick, s


@settings
class Recovery:
    """When a robot has come back.

    Attributes:
        height: largest difference of the trunk's height to that before the kick, m.
        speed: largest difference of its horizontal velocity to that before the kick, m/s.
        hold_s: time for which both must hold, s.
        smooth_s: both are means over so much time, about a stride, s: the gait itself is no disturbance.
    """

    height: Positive
    speed: Positive
    hold_s: Positive
    smooth_s: NonNegative


@protocol("kicks")
@settings
class Kicks(Protocol):
    """Kicks of rising strength while walking: lowest height, recovery, success (paper, Fig. 6).

    Attributes:
        command: commanded velocity.
        impulses: of the kicks one after the other, N s; 12.74 kg gain 1 m/s by 12.7.
        push_s: duration of the half-sine force, s.
        direction_deg: of the force from the heading, counter-clockwise; 90 is to the left. Odd robots the other way.
        point: where it acts, from the trunk's origin in its frame, m.
        first_s: time of the first kick, s.
        every_s: time from one kick to the next, s; also what is watched after the last.
        jitter_s: the robots are kicked evenly spread over so much time, so that all phases of the gait are met, s.
        recovery: when a robot has come back.
    """

    command: Signal
    impulses: Annotated[tuple[Impulse, ...], Field(min_length=1)]
    push_s: Positive
    direction_deg: float
    point: Point
    first_s: Annotated[float, Field(ge=LEAST)]
    every_s: Annotated[float, Field(ge=LEAST)]
    jitter_s: NonNegative
    recovery: Recovery

    identical: ClassVar[bool] = False
    keys: ClassVar[tuple[str, ...]] = ("impulse",)
    robot_columns: ClassVar[tuple[Column, ...]] = (
        Column("survived", "", "survival rate of the robots still standing before this kick", "share", "higher"),
        Column("up", "", "still standing after this kick, of all", "share", "higher"),
        Column("recovered", "", "recovered before the next kick, of those standing before", "share", "higher"),
        Column("recovery_s", "s", "recovery time of the robots that recovered", better="lower"),
        Column("min_height", "m", "lowest height of the trunk, excluding falls", better="higher"),
        Column("min_height_25hz", "m", "the same of samples at 25 Hz, as the paper plots"),
        Column("peak_speed", "m/s", "largest change of the horizontal velocity, excluding falls"),
        Column("peak_speed_25hz", "m/s", "the same of samples at 25 Hz"),
    )

    def __post_init__(self) -> None:
        if wrong := repeated("impulses", self.impulses):
            raise ValueError(wrong[0])
        if self.push_s > self.every_s:
            raise ValueError(f"push_s = {self.push_s}: must be at most every_s = {self.every_s}")

    @property
    def seconds(self) -> float:
        """Length, s."""
        return self.first_s + len(self.impulses) * self.every_s + self.jitter_s

    def lengths(self) -> list[Length]:
        """Return that of all kicks, one after the other."""
        count, first, every, jitter = len(self.impulses), self.first_s, self.every_s, self.jitter_s
        causes = [
            Cause("first_s", first, LEAST, lambda seconds: seconds - count * every - jitter),
            Cause("every_s", every, LEAST, lambda seconds: (seconds - first - jitter) / count),
            Cause("jitter_s", jitter, 0.0, lambda seconds: seconds - first - count * every),
        ]
        return [Length(self.seconds, self.robots, causes, recorded=bool(self.terms()))]

    def starts(self) -> Array:
        """Return when each robot is kicked (N, P), s."""
        spread = self.jitter_s * np.arange(self.robots) / self.robots
        return spread[:, None] + self.first_s + self.every_s * np.arange(len(self.impulses))

    def play(self, stage: Stage) -> Played:
        """Kick all robots, odd ones from the other side."""
        t = stage.times(self.seconds)
        side = self._sides()
        count = len(self.impulses)
        sizes = np.tile(np.array(self.impulses), (self.robots, 1))
        kicks = Impulses(self.starts(), sizes, np.repeat(side[:, None], count, 1), self.push_s, self.point)
        command = np.repeat(self.command.at(t)[:, None], self.robots, 1)
        listen = 0 if self.terms() else None
        motion = stage.run(Plan(command, impulses=kicks, listen_from=listen))
        every = lives(motion)
        self.measure(motion, every)
        rows = [self._row(motion, n, k, every[n]) for k in range(count) for n in range(self.robots)]
        return Played(rows, {"run": self._run(motion), "kicks": [self._after(motion, k) for k in range(count)]})

    def _row(self, motion: Motion, n: int, k: int, of_robot: Row) -> Row:
        start = self.starts()[n, k]
        begin, end = (round(float(s) / motion.dt) for s in (start, start + self.every_s))
        end = min(end, len(motion.t))
        alive = motion.alive[:end, n]
        row = {**of_robot, "impulse": float(self.impulses[k]), "robot": n, "up": bool(alive[-1])}
        row["moving_s"] = round(float(alive[begin:].sum() * motion.dt), 4)
        if not alive[begin - 1]:
            return {**row, "fell": None, "left_map": None, **dict.fromkeys(("survived", "recovered"))}
        row |= {"fell": bool(motion.fell[n] and not alive[-1]), "survived": bool(alive[-1])}
        if not alive[-1]:
            return {**row, "recovered": False}
        height, velocity = motion.height[:end, n], motion.velocity[:end, n, :2]
        rest = slice(begin - round(BEFORE / motion.dt), begin)
        speed = np.linalg.norm(velocity - velocity[rest].mean(0), axis=-1)
        coarse = np.round(np.arange(0.0, end * motion.dt, COARSE) / motion.dt).astype(int)  # from the run's start on
        coarse = coarse[(coarse >= begin) & (coarse < end)]
        near = coarse[coarse < begin + PEAK_WITHIN / motion.dt]
        row |= {"min_height": float(height[begin:].min()), "min_height_25hz": float(height[coarse].min())}
        row["peak_speed"] = float(speed[begin : begin + round(PEAK_WITHIN / motion.dt)].max())
        row["peak_speed_25hz"] = float(speed[near].max())
        back = self.back(height, velocity, begin, rest, motion.dt)
        return {**row, "recovered": back is not None, "recovery_s": back}

    def back(self, height: Array, velocity: Array, begin: int, rest: slice, dt: float) -> float | None:
        """Return the time (s) after step ``begin`` from which height (T,) and velocity (T, 2) stay near.

        Near their means over the steps ``rest``. None if they do not for ``recovery.hold_s``.
        """
        rule = self.recovery
        near = np.abs(_smooth(height, rule.smooth_s, dt) - height[rest].mean()) < rule.height
        away = _smooth(velocity, rule.smooth_s, dt) - velocity[rest].mean(0)
        near &= np.linalg.norm(away, axis=-1) < rule.speed
        hold = max(1, round(rule.hold_s / dt))
        good = near[begin:]
        if len(good) < hold:
            return None
        held = np.convolve(good, np.ones(hold), "valid") > hold - 0.5
        # The force is still rising at the very start: a robot comes back only from where it was not near.
        left = int(np.argmin(good)) if not good.all() else 0
        later = np.flatnonzero(held[left:]) if left < len(held) else np.array([])
        return round(float((later[0] + left) * dt), 4) if len(later) else None

    def _run(self, motion: Motion) -> dict[str, object]:
        """Return one robot's whole run, of one that stays up if there is any."""
        up = np.flatnonzero(motion.alive[-1])
        n = int(up[0]) if len(up) else 0
        alive = motion.alive[:, n]
        speed = np.linalg.norm(motion.velocity[:, n, :2], axis=-1)
        rest = slice(round((self.first_s - BEFORE) / motion.dt), round(self.first_s / motion.dt))
        plain = {"t": motion.t, "height": motion.height[:, n], "speed": speed}
        kept = {k: rounded(v[alive]) for k, v in plain.items()}
        kicks, nominal = self.starts()[n].round(3).tolist(), float(motion.height[rest, n].mean())
        return {**kept, "kicks": kicks, "nominal": nominal, "dt": motion.dt}

    def _sides(self) -> Array:
        """(N,) direction of the force on each robot, from its heading counter-clockwise, rad."""
        return np.where(np.arange(self.robots) % 2, np.pi, 0.0) + np.radians(self.direction_deg)

    def _after(self, motion: Motion, k: int) -> dict[str, object]:
        """Return height, and velocity to the pushed side, around one kick, of the robots that are up before it."""
        starts, dt = self.starts()[:, k], motion.dt
        steps = np.arange(-round(1.0 / dt), round((self.every_s - 0.5) / dt))
        rows = np.round(starts / dt).astype(int)[None, :] + steps[:, None]
        robots = np.arange(self.robots)[None, :]
        keep = motion.alive[np.round(starts / dt).astype(int) - 1, robots[0]]
        rows = np.minimum(rows, len(motion.t) - 1)
        alive = motion.alive[rows, robots][:, keep]
        side = self._sides()
        along = motion.velocity[..., 0] * np.cos(side) + motion.velocity[..., 1] * np.sin(side)
        curves = {"impulse": float(self.impulses[k]), "t": rounded(steps * dt), "n": int(keep.sum())}
        for name, values in (("height", motion.height), ("speed", along)):
            each = np.where(alive, values[rows, robots][:, keep], np.nan)
            curves[name] = rounded(bands(each, np.nanmedian))
        return curves

    def compared(self, plays: Mapping[str, Played], summaries: Summaries) -> list[plots.Drawing]:
        """Draw the success of all subjects."""
        text = "Shares of robots with Wilson's 95 % interval."
        return [plots.Drawing("success", "Success", text, partial(_success, summaries))]

    def details(self, played: Played, summary: Summary) -> list[plots.Drawing]:
        """Draw the figure of the paper, at the rate of the policy and at 25 Hz, and the response of all robots."""
        run, around = played.curves["run"], played.curves["kicks"]
        rate, coarse = f"{1.0 / run['dt']:.0f} Hz", round(COARSE / run["dt"])
        one = "One robot: height of the trunk, its nominal height before the first kick, speed; dotted: kicks."
        every = "Robots standing before a kick, by the time since it: median, 10th to 90th percentile."
        return [
            plots.Drawing("run", f"Height and speed under kicks, at {rate}", one, partial(_run, run, 1)),
            plots.Drawing("coarse", "The same at 25 Hz, as the paper plots", one, partial(_run, run, coarse)),
            plots.Drawing("around", "Around each kick", every, partial(_around, around)),
        ]


def _smooth(values: Array, width: float, dt: float) -> Array:
    """Return the running mean over ``width`` s around each row; shorter at the ends."""
    count = max(1, round(width / dt))
    kernel, ones = np.ones(count), np.ones(len(values))
    weight = np.convolve(ones, kernel, "same")
    flat = values.reshape(len(values), -1)
    means = np.stack([np.convolve(column, kernel, "same") / weight for column in flat.T], axis=-1)
    return means.reshape(values.shape)


def _run(run: Mapping[str, Any], every: int) -> plots.Figure:
    figure, axes = plots.panels(2, height=1.6, sharex=True)
    t, height, speed = (run[k][:: max(every, 1)] for k in ("t", "height", "speed"))
    axes[0, 0].plot(t, height, color=plots.MEASURED, lw=1.1, label="trunk height")
    axes[0, 0].axhline(run["nominal"], color=plots.NOMINAL, lw=1.3, label="nominal height")
    axes[1, 0].plot(t, speed, color="#c1272d", lw=1.0, label="speed")
    for ax in axes[:, 0]:
        for kick in run["kicks"]:
            ax.axvline(kick, color="#777777", lw=0.9, ls=":")
    axes[0, 0].set_ylabel("height (m)")
    axes[0, 0].set_ylim(bottom=0.0)
    axes[1, 0].set(ylabel="speed (m/s)", xlabel="time (s)")
    handles = [*axes[0, 0].get_legend_handles_labels()[0], *axes[1, 0].get_legend_handles_labels()[0]]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False, fontsize=7.5)
    return figure


def _around(kicks: Sequence[Mapping[str, Any]]) -> plots.Figure:
    figure, axes = plots.panels(2, height=1.6, sharex=True)
    for k, kick in enumerate(kicks):
        colour = plots.COLOURS[k % len(plots.COLOURS)]
        for ax, name in ((axes[0, 0], "height"), (axes[1, 0], "speed")):
            middle, low, high = (np.array(b, dtype=float) for b in kick[name])
            plots.band(ax, kick["t"], low, high, colour)
            ax.plot(kick["t"], middle, color=colour, lw=1.1, label=f"{kick['impulse']:g} N s (n {kick['n']})")
    axes[0, 0].set_ylabel("height (m)")
    axes[1, 0].set(ylabel="velocity to\nthat side (m/s)", xlabel="time since the kick (s)")
    plots.legend(figure, axes[0, 0])
    return figure


def _success(summaries: Summaries) -> plots.Figure:
    figure, axes = plots.panels(1, height=2.2)
    ax = axes[0, 0]
    names = (("survived", "survival rate"), ("up", "still standing"), ("recovered", "recovered"))
    for w, (who, summary) in enumerate(summaries.items()):
        at = [e["condition"]["impulse"] * (1.0 + 0.01 * w) for e in summary]
        for k, (name, text) in enumerate(names if len(summaries) == 1 else names[1:2]):
            plots.intervals(
                ax, [x * 1.015**k for x in at], summary, name, plots.COLOURS[w + k], f"{who}: {text}" if who else text
            )
    ax.set(xlabel="impulse (N s)", ylabel="share of robots", ylim=(-0.03, 1.03))
    plots.legend(figure, ax, columns=2)
    return figure
