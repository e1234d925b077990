"""The stage ``loop``: record, search, design, and again, on a simulated robot, until one name is left."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from go1exp.gap.comparison import Progress
from go1exp.gap.design.plan import DesignError, DesignSettings
from go1exp.gap.result import GapResult, GapSettings
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.stages.explain import explain
from go1exp.gap.stages.next import NextResult, design
from go1exp.logs.record.plan import Episode
from go1exp.logs.record.sensors import SensorConfig
from go1exp.logs.record.simulate import Rig, play
from go1exp.logs.recording import Recording


@dataclass(frozen=True)
class Round:
    """One turn of the loop."""

    number: int  # from 0, the recordings that it begins with
    recordings: int  # how many there are
    robot_seconds: float  # of all recordings so far
    verdict: str  # of the search
    # effects that are named, each with the rivals that are not yet excluded behind it; without a design, with those
    # that the search took for its equals
    names: tuple[tuple[str, ...], ...]
    # least chance to tell a name from a rival, by the recordings so far; 1 if no rival is left. None if that is not
    # known: nothing is named, or no design could be made
    power: float | None
    next: str  # what was designed, in words; empty if the loop ends here
    ended: str  # why it ends here; empty if it goes on


@dataclass(frozen=True)
class Turn:
    """What a round leaves beside its row: the recordings so far, the answer, and the design if there was one."""

    row: Round
    recordings: tuple[Recording, ...]
    result: GapResult
    design: NextResult | None


def names_left(result: GapResult, planned: NextResult | None) -> tuple[tuple[str, ...], ...]:
    """Return each named effect, and behind it the rivals that are not yet excluded, or its equals without a design."""
    if planned is None:
        return tuple((n.effect, *(a for a in n.alias_set if a != n.effect)) for n in result.named)
    return tuple((n.effect, *(p.rival for p in planned.pairs if p.truth == n.effect and p.rival)) for n in result.named)


def as_episode(planned: NextResult, number: int, seed: int) -> Episode:
    """Return a design as an episode to record on a Go1."""
    best = planned.best
    assert best is not None
    attitude = best.design.attitude
    assert attitude.roll is not None  # a Go1's
    assert attitude.pitch is not None
    hang = (attitude.roll, attitude.pitch)
    name = f"next_{number}_{best.design.excitation}"
    return Episode(name, best.design.excitation, best.motion, best.kp[0], best.kd[0], hang, None, seed)


def loop(
    rig: Rig,
    episodes: Sequence[Episode],
    sensors: SensorConfig,
    robot: Robot,
    search: GapSettings,
    settings: DesignSettings,
    rounds: int,
    on_round: Callable[[Turn], None],
    on_progress: Progress = lambda what, share: None,
) -> list[Round]:
    """Close the loop without a user in between: record the hidden robot (``rig``), search, design, and again.

    It begins with ``episodes``, adds ``rounds`` designed recordings at most, and hands each search and design to
    ``on_round``. The searches compare with the model ``robot``.

    Returns:
        A row for each round; the last one says why it ended.
    """
    recordings = play(rig, episodes, sensors, settings.seed, lambda done, total: None)
    rows: list[Round] = []
    for number in range(rounds + 1):
        result = explain(recordings, robot, search, on_progress)
        planned, ended = _designed(result, recordings, robot, search, settings, on_progress)
        if not ended and number == rounds:
            ended = "rounds are used up"
        rows.append(_row(number, recordings, result, planned, ended))
        on_round(Turn(rows[-1], tuple(recordings), result, planned))
        if ended:
            break
        assert planned is not None
        new = as_episode(planned, number + 1, settings.seed + number + 1)
        recordings = [*recordings, *play(rig, [new], sensors, settings.seed, lambda done, total: None)]
    return rows


def _designed(
    result: GapResult,
    recordings: Sequence[Recording],
    robot: Robot,
    search: GapSettings,
    settings: DesignSettings,
    on_progress: Progress,
) -> tuple[NextResult | None, str]:
    """Return the design for a result, and why the loop ends with it; empty if it goes on."""
    if not result.named:
        return None, f"nothing is named: {result.verdict}"
    try:
        planned = design(result, recordings, robot, search, settings, on_progress, names_only=True)
    except DesignError as error:
        return None, str(error)
    ends = {"nothing left": "one name is left", "not separable": "not separable"}
    return planned, ends.get(planned.verdict, "")


def _row(
    number: int, recordings: Sequence[Recording], result: GapResult, planned: NextResult | None, ended: str
) -> Round:
    seconds = round(sum(float(r.t[-1] - r.t[0]) for r in recordings), 3)
    power = min((p.before.power for p in planned.pairs), default=1.0) if planned else None
    best = planned.best if planned else None
    words = ""
    if best and not ended:
        attitude = best.design.attitude
        words = f"{best.design.excitation}, kp {best.kp[0]:g}, kd {best.kd[0]:g}"
        words += f", roll {attitude.roll:g}, pitch {attitude.pitch:g}"
    return Round(number, len(recordings), seconds, result.verdict, names_left(result, planned), power, words, ended)


def table(rows: Sequence[Round]) -> str:
    """Return rounds as lines for people."""
    lines = [f"{'round':>5} {'robot s':>8} {'power':>6}  names left"]
    for row in rows:
        names = "; ".join(" or ".join(each) for each in row.names) or "none"
        power = "–" if row.power is None else f"{row.power:.0%}"
        lines.append(f"{row.number:5d} {row.robot_seconds:8.1f} {power:>6}  {names} ({row.verdict})")
        lines.append(" " * 23 + (f"ended: {row.ended}" if row.ended else f"next: {row.next}"))
    return "\n".join(lines)
