"""``go1exp eval protocol=...``: everything but the grid."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from go1exp.cli import other_robot
from go1exp.cli.app import spinner
from go1exp.config.schema.registry import ConfigError

if TYPE_CHECKING:
    from go1exp.cli.subjects import Named
    from go1exp.evaluate.agents import Agent
    from go1exp.evaluate.protocol.base import Chosen
    from go1exp.evaluate.protocol.playing import Rates, Result

RATES = "rate"
"""Kind of protocol that only policies can play."""

GRID_ONLY = (
    *("grid", "episodes", "duration_s", "settle_s", "noise", "randomize", "push", "train_ground", "trunk_velocity"),
    *("measures", "delay_margin", "out"),
)
"""Keys of ``go1exp eval`` that are the grid's."""


def chosen(container: dict[str, Any], plain: dict[str, Any]) -> tuple[list[Chosen], bool]:
    """Return the protocols of a configuration, and whether the grid is among them.

    Args:
        container: the configuration.
        plain: ``conf/eval.yaml`` as it stands, to see which keys have been changed.

    Raises:
        ConfigError: with every problem; also for keys of the grid where it is not played.
    """
    import go1exp.evaluate.protocol.kinds  # noqa: F401  (registers them)
    from go1exp.evaluate.protocol.base import chosen as checked

    protocols, grid = checked(container.get("protocol"))
    changed = [key for key in GRID_ONLY if not grid and key in plain and container.get(key) != plain[key]]
    if changed:
        rule = "is of protocol=grid; others have keys of their own"
        raise ConfigError([f"{key} = {container[key]!r}: {rule} ({_example(key, protocols)})" for key in changed])
    return protocols, grid


def _example(key: str, protocols: Sequence[Chosen]) -> str:
    first = protocols[0]
    equivalent = {"episodes": "robots", "grid": "claims", "out": ""}.get(key, key)
    if key == "out":
        return "their folder is folder="
    return (
        f"protocol.{first.key}.{equivalent}" if hasattr(first.protocol, equivalent) else "go1exp eval --help protocol"
    )


def refuse(protocols: Sequence[Chosen], agent: Agent) -> None:
    """Refuse protocols that an agent cannot play; raise ConfigError."""
    problems = []
    for c in protocols:
        for key, velocity in c.protocol.policy_velocities().items():
            problems += agent.problems(velocity, f"protocol.{c.key}.{key}")
    if problems:
        raise ConfigError(problems)


def refuse_rates(protocols: Sequence[Chosen], controller: str | None, policy_dt: float | None) -> None:
    """Raise ConfigError where the rates of a policy cannot be varied.

    Args:
        protocols: what is to be played.
        controller: name of another controller with a rate of its own, or None.
        policy_dt: the period that is asked for, s, or None.
    """
    kinds = [c.kind for c in protocols]
    if controller is not None and set(kinds) == {RATES}:
        raise ConfigError([f"protocol={RATES}: varies the rate of a policy; {controller} has one of its own"])
    if policy_dt is not None and RATES in kinds:
        raise ConfigError([f"policy_dt = {policy_dt:g}: protocol={RATES} has rates of its own, rates_hz"])


def playable(protocols: Sequence[Chosen], agent: Agent) -> list[Chosen]:
    """Return the protocols that an agent can play, and say which one of several it cannot."""
    if agent.senses and any(c.kind == RATES for c in protocols):
        print(f"{RATES}: not played, it varies the rate of a policy; {agent.label} has one of its own\n")
        return [c for c in protocols if c.kind != RATES]
    return list(protocols)


def writable_file(out: Path) -> None:
    """Make the folder of a file for results, before the work begins; ``/dev/stdout`` and pipes are taken as they are.

    Raises:
        ConfigError: if nothing can be written there.
    """
    from go1exp.cli.logs import writable

    if out.exists() and not out.is_file():
        return
    try:
        writable(str(out.resolve().parent))
    except ConfigError as error:
        reason = error.problems[0].partition(": ")[2]
        raise ConfigError([f"out = {str(out)!r}: its folder {reason}"]) from None


def note_replaced(folder: Path, files: Sequence[str]) -> None:
    """Say which results of an earlier call the new ones will replace."""
    present = [name for name in files if (folder / name).exists()]
    if present:
        print(f"note: {folder} holds {', '.join(present)} of an earlier call; new ones replace them (or: folder=NAME)")


def play(protocols: Sequence[Chosen], subject: Named, folder: Path, other: dict[str, Any], rates: Rates) -> None:
    """Play protocols one after the other, write what came of each, and print the verdicts."""
    from go1exp.cli.logs import writable
    from go1exp.cli.subjects import agent
    from go1exp.evaluate.protocol.playing import play as played
    from go1exp.evaluate.protocol.playing import refuse_lengths
    from go1exp.evaluate.protocol.report.pages import write

    drives = agent(subject, other)
    refuse(protocols, drives)
    protocols = playable(protocols, drives)
    refuse_lengths(protocols, drives, rates)
    writable(str(folder), "folder")
    note_replaced(folder, [f"{c.key}.json" for c in protocols])
    for k, c in enumerate(protocols):
        show = spinner(1, f"{c.key} ({k + 1} of {len(protocols)})")
        result = played(c, drives, rates, {"robot": other_robot.described(other)}, show)
        files = write(result, folder)
        print("\n".join(lines(result)))
        print(f"  written to {', '.join(map(str, files))}\n", flush=True)


def lines(result: Result) -> list[str]:
    """Return what a terminal shows of a result."""
    from go1exp.base.report.table import interval_text
    from go1exp.evaluate.protocol.claims import limits
    from go1exp.evaluate.protocol.report.tables import condition_text, falls

    text_lines = [f"{result.chosen.key}: {result.label}, {result.seconds:.0f} s; {falls(result)}"]
    for v in result.verdicts:
        value = interval_text(v.figure.estimate, v.figure.low, v.figure.high)
        where = condition_text(v.condition)
        text_lines.append(f"  {v.word:12} {v.claim.quantity} {value}, {limits(v.claim)}, n {v.figure.n} ({where})")
    return [*text_lines, *(f"  note: {note}" for note in result.played.notes)]
