"""``protocol=rate``: rate of the policy, command delay, exact or estimated velocity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from pydantic import Field

from go1exp.base.report import plots
from go1exp.config.schema.registry import NonNegative, Positive, protocol
from go1exp.config.schema.settings import settings
from go1exp.evaluate.controller.types import TrunkVelocity
from go1exp.evaluate.protocol.base import Cause, Length, Played, Protocol, lives, repeated
from go1exp.evaluate.protocol.plan import Array, Motion, Plan, Signal
from go1exp.evaluate.quantities import Column, Derived, Row, Summaries, values

if TYPE_CHECKING:
    from go1exp.evaluate.protocol.stage import Stage

LATEST_MS = 60.0  # upper bound of the effect ``command_delay``, ms


@protocol("rate")
@settings
class Rate(Protocol):
    """Rate of the policy and delay of its targets, with true and with estimated velocity: errors, falls, effort.

    Attributes:
        command: commanded velocity.
        seconds: length, s.
        settle_s: time at its start that counts for falls alone, s.
        rates_hz: of the policy; the physics step is the largest up to that of training that divides its period.
        delays_ms: further command delays, added to those of the robot.
        velocities: what the policy sees of the trunk's velocity, in place of ``trunk_velocity``.
        slower_faster: two of the rates whose error is compared.
    """

    command: Signal
    seconds: Positive
    settle_s: NonNegative
    rates_hz: Annotated[tuple[Annotated[float, Field(ge=10, le=1000)], ...], Field(min_length=1)]
    delays_ms: Annotated[tuple[Annotated[float, Field(ge=0, le=LATEST_MS)], ...], Field(min_length=1)]
    velocities: Annotated[tuple[TrunkVelocity, ...], Field(min_length=1)]
    slower_faster: tuple[float, float]

    keys: ClassVar[tuple[str, ...]] = ("velocity", "rate_hz", "delay_ms")
    derived_names: ClassVar[tuple[str, ...]] = ("faster_is_better",)
    robot_columns: ClassVar[tuple[Column, ...]] = (
        Column("rmse_xy", "m/s", "root mean square error of the horizontal velocity, gait included", better="lower"),
        Column("rmse_yaw", "rad/s", "that of the yaw rate", better="lower"),
        Column("target_rate", "rad/s", "root mean square of the change of targets over time", better="lower"),
        Column("torque_rms", "N m", "root mean square torque over joints", better="lower"),
    )

    def __post_init__(self) -> None:
        wrong = repeated("rates_hz", self.rates_hz) + repeated("delays_ms", self.delays_ms)
        wrong += repeated("velocities", self.velocities)
        if self.settle_s >= self.seconds:
            wrong.append(f"settle_s = {self.settle_s}: must be shorter than seconds = {self.seconds}")
        if missing := [r for r in self.slower_faster if r not in self.rates_hz]:
            wrong.append(f"slower_faster = {list(self.slower_faster)}: rates_hz has no {missing[0]:g}")
        if wrong:
            raise ValueError("\n".join(wrong))

    def policy_velocities(self) -> dict[str, TrunkVelocity]:
        """Return what policies see of the velocity."""
        return {"velocities": "estimated" if "estimated" in self.velocities else "exact"}

    def lengths(self) -> list[Length]:
        """Return that of each velocity and rate, all delays as one batch."""
        causes, robots = [Cause("seconds", self.seconds, least=self.settle_s)], len(self.delays_ms) * self.robots
        return [
            Length(self.seconds, robots, causes, self.settle_s, True, 1.0 / rate)
            for _ in self.velocities
            for rate in self.rates_hz
        ]

    def play(self, stage: Stage) -> Played:
        """Play each rate with each velocity, all delays as one batch."""
        rows: list[Row] = []
        delay = np.repeat(np.array(self.delays_ms) * 1e-3, self.robots)
        for velocity in self.velocities:
            for rate in self.rates_hz:
                t = stage.times(self.seconds, 1.0 / rate)
                command = np.repeat(self.command.at(t)[:, None], len(delay), 1)
                settle = round(self.settle_s * rate)
                plan = Plan(command, delay=delay, policy_dt=1.0 / rate, listen_from=settle, trunk_velocity=velocity)
                motion = stage.run(plan)
                those = self._rows(motion, velocity, rate, settle)
                self.measure(motion, those)
                rows += those
        return Played(rows)

    def _rows(self, motion: Motion, velocity: TrunkVelocity, rate: float, settle: int) -> list[Row]:
        trace, rows = motion.trace, lives(motion)
        assert trace is not None
        error = (motion.velocity - motion.command)[settle:]
        target, torque = trace.need("joint_target"), trace.need("joint_torque")
        for n, row in enumerate(rows):
            row |= {"velocity": velocity, "rate_hz": float(rate)}
            row |= {"delay_ms": float(self.delays_ms[n // self.robots]), "robot": n % self.robots}
            if not motion.alive[-1, n]:
                row |= dict.fromkeys(c.name for c in self.robot_columns)
                continue
            change = np.diff(target[:, n].astype(np.float64), axis=0) / motion.dt
            row |= {"rmse_xy": _rms(np.linalg.norm(error[:, n, :2], axis=-1)), "rmse_yaw": _rms(error[:, n, 2])}
            row |= {"target_rate": _rms(change), "torque_rms": _rms(torque[:, n].astype(np.float64))}
        return rows

    def derived(self, rows: Sequence[Row]) -> list[Derived]:
        """Return by how much the error falls from the slower to the faster rate, of the same robots."""
        text = "error at {:g} Hz - error at {:g} Hz, of robots standing at both".format(*self.slower_faster)
        return [
            Derived("faster_is_better", "m/s", text, {"velocity": v, "delay_ms": float(d)}, "higher", self._gain)
            for v in self.velocities
            for d in self.delays_ms
        ]

    def _gain(self, rows: Sequence[Row]) -> float:
        """Mean over robots of the difference; a robot drawn twice counts twice in both."""
        slow, fast = ([r for r in rows if r["rate_hz"] == rate] for rate in self.slower_faster)
        if len(slow) != len(fast):
            return np.nan
        difference = values(slow, "rmse_xy") - values(fast, "rmse_xy")
        return float(np.nanmean(difference)) if np.isfinite(difference).any() else np.nan

    def compared(self, plays: Mapping[str, Played], summaries: Summaries) -> list[plots.Drawing]:
        """Draw errors, falls and action rate over the rate; of several subjects at the smallest delay."""
        text = "95 % intervals over robots that did not fall; a line for each delay, of several subjects the smallest."
        return [plots.Drawing("rate", "Error, falls and effort over the rate", text, partial(_over_rate, summaries))]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


SHOWN = (("rmse_xy", "RMSE xy (m/s)"), ("fell", "share that fell"), ("target_rate", "target rate (rad/s)"))


def _over_rate(summaries: Summaries) -> plots.Figure:
    first = [e["condition"] for e in next(iter(summaries.values())) if "rate_hz" in e["condition"]]
    velocities = list(dict.fromkeys(c["velocity"] for c in first))
    delays = sorted({c["delay_ms"] for c in first})
    figure, axes = plots.panels(len(SHOWN), len(velocities), sharex=True, sharey="row")
    for w, (who, summary) in enumerate(summaries.items()):
        for d, delay in enumerate(delays if len(summaries) == 1 else delays[:1]):
            for column, velocity in enumerate(velocities):
                wanted = {"velocity": velocity, "delay_ms": delay}.items()
                entries = [e for e in summary if wanted <= e["condition"].items() and "rate_hz" in e["condition"]]
                at = [e["condition"]["rate_hz"] * 1.02 ** (d + w) for e in entries]
                for row, (name, _) in enumerate(SHOWN):
                    colour = plots.COLOURS[(d + w) % len(plots.COLOURS)]
                    plots.intervals(axes[row, column], at, entries, name, colour, who or f"{delay:g} ms delay")
    for row, (_, text) in enumerate(SHOWN):
        axes[row, 0].set_ylabel(text)
    for column, velocity in enumerate(velocities):
        axes[0, column].set_title(f"{velocity} velocity", loc="left")
        ticks = sorted({c["rate_hz"] for c in first})
        axes[-1, column].set_xscale("log")
        axes[-1, column].set_xticks(ticks, [f"{t:.0f}" for t in ticks], fontsize=6.5)
        axes[-1, column].minorticks_off()
        axes[-1, column].set_xlabel("rate (Hz)")
    plots.legend(figure, axes[0, 0])
    return figure
