"""A protocol from settings to result: refused if too long, played, summarised, evaluated."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from go1exp import __version__
from go1exp.base import memory
from go1exp.base.wording import counted
from go1exp.config.schema.registry import ConfigError, TooLongError
from go1exp.evaluate.agents import Agent, Progress
from go1exp.evaluate.protocol.base import Chosen, Length, Played, Protocol
from go1exp.evaluate.protocol.claims import Verdict, evaluated
from go1exp.evaluate.protocol.stage import Rates, Setting, Stage
from go1exp.evaluate.quantities import ROBOT, Derived, Row, about, by_condition, coarse_note, distinct, plain, summary
from go1exp.evaluate.statistics.intervals import Interval, SummaryEntry, bootstrap_interval


@dataclass
class Result:
    """Result of one protocol with one agent."""

    chosen: Chosen  # the protocol
    label: str  # name of the agent
    about: dict[str, object]  # origin of the agent, robot, seed and rates: plain data
    played: Played  # rows without repeats, curves, notes
    repeats: int  # number of rows that repeated another one and do not count
    summary: list[SummaryEntry]  # figures with n and interval, by condition
    verdicts: list[Verdict]  # of its claims
    seconds: float  # what it took, s


def as_json(result: Result) -> dict[str, object]:
    """Return a result as plain data, without its rows."""
    verdicts = [
        {
            "claim": v.name,
            "verdict": v.word,
            **{k: w for k, w in dataclasses.asdict(v.claim).items() if w is not None},
            "figure": plain(v.figure, ""),
            "condition": dict(v.condition),
            "conditions": v.conditions,
        }
        for v in result.verdicts
    ]
    return {
        "protocol": result.chosen.key,
        "kind": result.chosen.kind,
        "subject": result.label,
        "settings": dataclasses.asdict(result.chosen.protocol),
        **result.about,
        "repeats": result.repeats,
        "seconds": round(result.seconds, 1),
        "notes": result.played.notes,
        "claims": verdicts,
        "summary": result.summary,
        "curves": result.played.curves,
    }


def play(
    chosen: Chosen,
    agent: Agent,
    rates: Rates,
    origin: Mapping[str, object] | None = None,
    on_step: Progress = lambda done, total: None,
) -> Result:
    """Play a protocol, evaluate its claims; ``origin`` is for the report; raise ConfigError of a wrong length first."""
    began, protocol = time.monotonic(), chosen.protocol
    stage = _stage(protocol, agent, rates, on_step)
    refuse(chosen, stage)
    stage.expect(protocol.steps(stage))
    played = protocol.play(stage)
    rows = distinct(played.rows, protocol.keys, protocol.noise or protocol.randomize or not protocol.identical)
    repeats, played.rows = len(played.rows) - len(rows), rows
    figures = summarised(chosen, rows)
    stage.finished()
    if note := coarse_note(stage.physics_dt(stage.policy_dt)):
        played.notes.append(note)
    about_play = {"agent": agent.about, "rates": dataclasses.asdict(rates), "go1exp": __version__, **(origin or {})}
    verdicts = evaluated(protocol.claims, figures)
    return Result(chosen, agent.label, about_play, played, repeats, figures, verdicts, time.monotonic() - began)


def refuse_lengths(protocols: Sequence[Chosen], agent: Agent, rates: Rates) -> None:
    """Refuse one of several protocols that is too long or too short, as ``play`` does, before the first is played."""
    for chosen in protocols:
        refuse(chosen, _stage(chosen.protocol, agent, rates))


def _stage(protocol: Protocol, agent: Agent, rates: Rates, on_step: Progress = lambda done, total: None) -> Stage:
    noise, randomize, velocity = protocol.noise, protocol.randomize, protocol.trunk_velocity
    return Stage(agent, Setting(**vars(rates), noise=noise, randomize=randomize, trunk_velocity=velocity), on_step)


def summarised(chosen: Chosen, rows: Sequence[Row]) -> list[SummaryEntry]:
    """Return every figure of a protocol's rows with n and interval: by condition, then those of all robots together."""
    protocol = chosen.protocol
    entries = summary(rows, protocol.keys, protocol.columns())
    for derived in protocol.derived(rows):
        interval = _threshold(derived, rows)
        figures = {derived.name: plain(interval, derived.unit)}
        entries.append({"condition": dict(derived.condition), "n": interval.n, "figures": figures})
    return entries


def _threshold(derived: Derived, rows: Sequence[Row]) -> Interval:
    of_robots = list(by_condition(about(rows, derived.condition), (ROBOT,)).values())
    return bootstrap_interval(lambda k: derived.function([r for n in k for r in of_robots[n]]), len(of_robots))


def refuse(chosen: Chosen, stage: Stage) -> None:
    """Refuse what is too long for memory (TooLongError), or leaves no step that counts (ConfigError), by setting."""
    _refuse_too_long(chosen, stage)
    for length in chosen.protocol.lengths():
        dt = length.policy_dt or stage.policy_dt
        if stage.steps(length.seconds, dt) <= stage.steps(length.settle_s, dt):
            cause = length.causes[0]
            left = f"of these {length.seconds:g} s no step of the policy ({dt:g} s) is left"
            after = f" after the first {length.settle_s:g} s" if length.settle_s else ""
            raise ConfigError([f"protocol.{chosen.key}.{cause.key} = {cause.value:g}: {left}{after}"])


def _refuse_too_long(chosen: Chosen, stage: Stage) -> None:
    """Raise TooLongError, with a setting and what would fit of it, if robots for certain do not fit into memory."""
    available, lengths = memory.free(), chosen.protocol.lengths()
    if available is None or not lengths:
        return
    length = max(lengths, key=lambda one: _needed(one, stage))  # what mends the largest batch mends the others
    if (needed := _needed(length, stage)) > available:
        plain, recorded = stage.bytes_per_second(length.robots, length.policy_dt, length.figures)
        fitting = available / plain
        if length.recorded and length.settle_s < fitting:
            fitting = (available + length.settle_s * recorded) / (plain + recorded)
        raise TooLongError([_problem(chosen, length, needed, available, fitting)])


def _needed(length: Length, stage: Stage) -> float:
    plain, recorded = stage.bytes_per_second(length.robots, length.policy_dt, length.figures)
    listening = max(length.seconds - length.settle_s, 0.0) if length.recorded else 0.0
    return length.seconds * plain + listening * recorded


def _problem(chosen: Chosen, length: Length, needed: float, available: float, fitting: float) -> str:
    """Return the message for a length that does not fit: the first setting that alone can shorten it, or all."""
    path, robots = f"protocol.{chosen.key}", chosen.protocol.robots
    amounts = memory.too_much(needed, available)
    what = f"to play {length.seconds:g} s with {counted(length.robots, 'robot')} {amounts}"
    for cause in length.causes:
        if limit := cause.limit(fitting):
            return f"{path}.{cause.key} = {cause.value:g}: {what}; {limit} would fit"
    fewer = math.floor(robots * available / needed)
    if fewer:
        return f"{path}.robots = {robots}: {what}; {fewer} at most would fit"
    given = ", ".join(f"{cause.key} = {cause.value:g}" for cause in length.causes)
    return f"{path}: {given}, robots = {robots}: {what}; {0.994 * fitting:.3g} s at most would fit"
