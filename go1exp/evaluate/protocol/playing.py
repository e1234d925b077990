"""A protocol from settings to result: played, counted, judged."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from go1exp import __version__
from go1exp.config.schema.backends import BackendConfig
from go1exp.evaluate.drivers import Driver, Progress
from go1exp.evaluate.protocol.base import Chosen, Protocol
from go1exp.evaluate.protocol.claims import judged
from go1exp.evaluate.protocol.quantities import Derived, Row, about, distinct, plain, resampled, summary
from go1exp.evaluate.protocol.refusing import refuse
from go1exp.evaluate.protocol.result import Result
from go1exp.evaluate.protocol.stage import Setting, Stage
from go1exp.evaluate.statistics.intervals import Interval, bootstrap_interval


@dataclass(frozen=True)
class Rates:
    """What a command line says for all protocols.

    Attributes:
        seed: seed of everything random.
        policy_dt: another period of the policy, s; None keeps that of training.
        physics_dt: another physics step, s; None keeps that of training.
        engine: physics engine; None takes MuJoCo on the CPU.
    """

    seed: int
    policy_dt: float | None = None
    physics_dt: float | None = None
    engine: BackendConfig | None = None


def play(
    chosen: Chosen,
    driver: Driver,
    rates: Rates,
    origin: dict[str, Any] | None = None,
    on_step: Progress = lambda done, total: None,
) -> Result:
    """Play a protocol and judge it; ``origin`` is what a report shall say beside that of the driver.

    Raises:
        ConfigError: before anything is played, if it is too long for the memory, or too short.
    """
    began, protocol = time.monotonic(), chosen.protocol
    stage = _stage(protocol, driver, rates, on_step)
    refuse(chosen, stage)
    stage.expect(protocol.steps(stage))
    played = protocol.play(stage)
    rows = distinct(played.rows, protocol.keys, protocol.noise or protocol.randomize or not protocol.alike)
    repeats, played.rows = len(played.rows) - len(rows), rows
    figures = summarised(chosen, rows)
    stage.finished()
    about_play = {"driver": driver.about, "rates": dataclasses.asdict(rates), "go1exp": __version__, **(origin or {})}
    verdicts = judged(protocol.claims, figures)
    return Result(chosen, driver.label, about_play, played, repeats, figures, verdicts, time.monotonic() - began)


def refuse_lengths(protocols: Sequence[Chosen], driver: Driver, rates: Rates) -> None:
    """Refuse one of several protocols that is too long or too short, as ``play`` does, before the first is played."""
    for chosen in protocols:
        refuse(chosen, _stage(chosen.protocol, driver, rates))


def _stage(protocol: Protocol, driver: Driver, rates: Rates, on_step: Progress = lambda done, total: None) -> Stage:
    setting = Setting(
        protocol.noise,
        protocol.randomize,
        protocol.trunk_velocity,
        rates.seed,
        rates.policy_dt,
        rates.physics_dt,
        rates.engine,
    )
    return Stage(driver, setting, on_step)


def summarised(chosen: Chosen, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return every figure of a protocol's rows with n and interval: by condition, then those of all robots together."""
    protocol = chosen.protocol
    entries = summary(rows, protocol.keys, protocol.columns())
    for derived in protocol.derived(rows):
        interval = thresholds(derived, rows)
        figures = {derived.name: plain(interval, derived.unit)}
        entries.append({"condition": dict(derived.condition), "n": interval.n, "figures": figures})
    return entries


def thresholds(derived: Derived, rows: Sequence[Row]) -> Interval:
    """Return a figure of all robots together with its interval."""
    n, sample = resampled(about(rows, derived.condition))
    return bootstrap_interval(lambda robots: derived.function(sample(robots)), n)
