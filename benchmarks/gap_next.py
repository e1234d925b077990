"""Robot seconds until two similar effects are separated: by ``gap next``, standard recordings, random designs.

    python -m benchmarks.gap_next out=DIR [pairs=tilt,kd] [strategies=next,standard] [n=2] [designs=24] [most=6]
        [seconds=6] [search=true] [jobs=1]

A simulated Go1 has one effect of a pair, whose size is taken as known. It is first recorded in slow ramps, 2 x 3 s.
Recordings of ``seconds`` are added one by one until the rival, fitted to all of them, is separated with a power of
80 %. The power is computed on the windows of the recordings, not of the rehearsals. With ``search``, ``go1exp gap`` is
then asked what it makes of them, with no knowledge of the pair: whether the hidden effect is named, with how many
equals, and whether a certified name is wrong. Writes ``OUT/next.json``, a row for each pair, strategy and seed, and
figures to ``OUT/gap.json``; rows that are there are not made again.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import go1exp.logs.excitations  # noqa: F401  (registers every excitation)
from benchmarks.results import write_results
from go1exp.base.tensors.threads import one_thread
from go1exp.config.compose import compose
from go1exp.config.schema.registry import bind
from go1exp.config.schema.settings import parse
from go1exp.evaluate.statistics.intervals import bootstrap_interval
from go1exp.gap.comparison import Comparison, compare
from go1exp.gap.design.choice import COARSE, ENOUGH, Evaluator, Pair, choose
from go1exp.gap.design.plan import Attitude, Design, DesignSettings, Limits, library, limits_of
from go1exp.gap.design.rehearsal import Rehearsal, Stage
from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import GapSettings
from go1exp.gap.robots.go1 import suspended
from go1exp.gap.robots.protocol import Robot
from go1exp.gap.stages.explain import explain
from go1exp.logs.record.plan import Episode, make_motion
from go1exp.logs.record.sensors import SensorConfig
from go1exp.logs.record.simulate import Rig, held_quat, play
from go1exp.logs.recording import Recording
from go1exp.sim.task import parse_parts

FIRST_SECONDS = 3.0
GAINS = ((20.0, 0.5), (35.0, 0.6), (35.0, 1.2))
"""Of the standard recordings (docs/notebook/gap_next.md), one set after the other; the first are those at hand."""

KINDS = ("chirp", "steps", "slow_ramps")
STRATEGIES = ("next", "standard", "random")
SEPARATED = "separated"

Row = dict[str, Any]
"""What one strategy took for one pair and seed."""


@dataclass(frozen=True)
class Case:
    """A pair: the hidden effect with its value, and what looks like it."""

    truth: str
    parameter: str
    value: float
    rival: str

    @property
    def theta(self) -> Theta:
        """Values of the hidden robot."""
        wide = 1 if self.truth == "base_tilt" else 12
        return {(self.truth, self.parameter): np.full(wide, self.value)}


CASES = {
    "tilt": Case("base_tilt", "pitch", 0.03, "encoder_offset"),
    "kd": Case("viscous", "damping", 0.2, "kd_scale"),
    "delay": Case("torque_delay", "delay", 0.004, "lag"),
    "strength": Case("strength", "scale", 0.85, "armature"),
    "load": Case("strength", "scale", 0.85, "link_mass"),
    "spring": Case("flexibility", "compliance", 0.002, "lag"),
}


class Bench:
    """A hidden robot, and the recordings of it so far."""

    def __init__(self, case: Case, seed: int, threads: int) -> None:
        """Record what is at hand."""
        container = compose("record", [f"backend.threads={threads}"])
        container["effect"] = {case.truth: {case.parameter: case.value}}
        parts, problems = parse_parts(container, ("robot", "actuator", "effect", "terrain", "backend"))
        assert not problems, problems
        self.case, self.seed, self.rng = case, seed, np.random.default_rng(seed)
        self.rig = Rig(**parts, physics_dt=0.0005)
        self.sensors: SensorConfig = parse(SensorConfig, container["sensors"])
        self.robot: Robot = suspended(parts["robot"])
        self.settings = GapSettings(threads=threads, physics_dt=0.002)
        self.recordings: list[Recording] = []
        for k in range(2):
            self.add(self.standard("slow_ramps", FIRST_SECONDS, GAINS[0], 100 * seed + k))

    def standard(self, kind: str, seconds: float, gains: tuple[float, float], seed: int) -> Episode:
        """Return a recording of a usual motion, the trunk level."""
        term, _ = bind("excitation", kind, {}, kind)
        assert term is not None
        motion = make_motion(term, seconds, self.sensors.rate_hz, seed)
        return Episode(f"{kind}_{seed}_{len(self.recordings)}", kind, motion, *gains, (0.0, 0.0), None, seed)

    def add(self, episode: Episode) -> None:
        """Record an episode."""
        episode = replace(episode, seed=1000 * self.seed + len(self.recordings))
        self.recordings += play(self.rig, [episode], self.sensors, self.seed, lambda done, total: None)

    def evaluated(self) -> tuple[Comparison, Evaluator, float]:
        """Return the recordings compared, the pair, and the power so far."""
        comparison = compare(self.recordings, self.robot, self.settings)
        case = self.case
        pair = Pair(case.truth, case.rival, case.theta, {}, (case.rival,), 0.0, 0.02)
        evaluator = Evaluator(pair, comparison.scorer, comparison.settings, COARSE * comparison.dt)
        return comparison, evaluator, evaluator.worth(evaluator.at_hand).power

    def searched(self) -> Row:
        """Return what ``go1exp gap`` makes of the recordings, which knows nothing of the pair."""
        nominal = parse_parts(compose("gap", ["logs=none"]), ("robot",))[0]["robot"]
        result = explain(self.recordings, nominal, replace(self.settings, overlays=0))
        right = [named for named in result.named if self.case.truth in named.alias_set]
        wrong = [n for n in result.named if n.status == "certified" and self.case.truth not in n.alias_set]
        names = [f"{' or '.join(n.alias_set)} ({n.status})" for n in result.named]
        equals = len(right[0].alias_set) if right else 0
        evaluated = {"named": bool(right), "equals": equals, "false": len(wrong)}
        return evaluated | {"answer": ", ".join([result.verdict, *names])}

    def stage(self, comparison: Comparison, settings: DesignSettings) -> Stage:
        """Return where designs are rehearsed."""
        targets = [r.joint("q_target") for r in comparison.recordings]
        limits: Limits = limits_of(self.robot, comparison.windows, targets, settings.limits)
        return Stage(comparison, limits, self.case.theta, settings.seconds)


def _attitudes(settings: DesignSettings) -> list[Attitude]:
    return [Attitude(roll, pitch, held_quat((roll, pitch))) for roll, pitch in settings.hang]


def _episode(played: Rehearsal, name: str) -> Episode:
    attitude = played.design.attitude
    assert attitude.roll is not None
    assert attitude.pitch is not None
    hang = (attitude.roll, attitude.pitch)
    return Episode(name, played.design.excitation, played.motion, played.kp[0], played.kd[0], hang, None, 0)


def _designed(bench: Bench, comparison: Comparison, evaluator: Evaluator, settings: DesignSettings) -> Episode | None:
    choice = choose(
        bench.stage(comparison, settings), [evaluator], _attitudes(settings), settings, lambda what, share: None
    )
    return _episode(choice.best, f"next_{len(bench.recordings)}") if choice.best else None


def _drawn(bench: Bench, comparison: Comparison, settings: DesignSettings) -> Episode:
    every: list[Design] = library(10_000, settings.gains, _attitudes(settings), bench.rng)
    stage = bench.stage(comparison, settings)
    while True:
        (pick,) = bench.rng.choice(len(every), 1)
        played = stage.rehearsed([every[pick]], comparison.dt)
        if played and stage.limits.allow(played[0].used):
            return _episode(played[0], f"random_{len(bench.recordings)}")


def _usual() -> Iterator[tuple[str, tuple[float, float]]]:
    while True:
        yield from ((kind, gains) for gains in GAINS for kind in KINDS)


def run(
    case: Case, strategy: str, seed: int, most: int, settings: DesignSettings, threads: int, search: bool = False
) -> Row:
    """Add recordings until the pair is separated; return what it took."""
    bench, usual, begun = Bench(case, seed, threads), _usual(), time.perf_counter()
    powers: list[float] = []
    ended = "not separated"
    for turn in range(most + 1):
        comparison, evaluator, power = bench.evaluated()
        powers.append(power)
        if power >= ENOUGH:
            ended = SEPARATED
            break
        if turn == most:
            break
        if strategy == "standard":
            kind, gains = next(usual)
            bench.add(bench.standard(kind, settings.seconds, gains, 100 * seed + 10 + turn))
            continue
        if strategy == "next":
            episode = _designed(bench, comparison, evaluator, settings)
        else:
            episode = _drawn(bench, comparison, settings)
        if episode is None:
            ended = "called not separable"
            break
        bench.add(episode)
    added = len(bench.recordings) - 2
    about = {"truth": case.truth, "rival": case.rival, "strategy": strategy, "seed": seed, "ended": ended}
    about |= {"seconds": settings.seconds * added, "powers": powers, "wall_s": round(time.perf_counter() - begun, 1)}
    return about | (bench.searched() if search else {})


# ---------------------------------------------------------------------- what came of it


def ratios(rows: Sequence[Row], most: int, seconds_each: float) -> list[float]:
    """Return, for each pair and seed, the robot seconds of ``next`` over those of the standard recordings.

    A pair that was not separated counts as one recording more than were made. That is too little, so a ratio to
    standard recordings that did not separate the two is too large. Pairs that neither separated have no ratio.
    """
    late = seconds_each * (most + 1)
    seconds: dict[tuple[str, str, int], dict[str, float]] = {}
    for row in rows:
        pair = seconds.setdefault((row["truth"], row["rival"], row["seed"]), {})
        pair[row["strategy"]] = row["seconds"] if row["ended"] == SEPARATED else late
    both = [(each["next"], each["standard"]) for each in seconds.values() if {"next", "standard"} <= {*each}]
    # Nor has a pair that the recordings at hand tell apart.
    return [a / b for a, b in both if min(a, b) < late and b > 0.0]


def figures(rows: Sequence[Row], most: int, seconds_each: float) -> dict[str, float | int | str | None]:
    """Return the figures that a file of results holds."""
    each = np.array(ratios(rows, most, seconds_each))
    flat: dict[str, float | int | str | None] = {}
    if len(each):
        middle = bootstrap_interval(lambda picked: float(np.median(each[picked])), len(each))
        flat |= {"next_over_standard": middle.estimate, "next_over_standard_n": middle.n}
        flat |= {"next_over_standard_low": middle.low, "next_over_standard_high": middle.high}
    for strategy in dict.fromkeys(row["strategy"] for row in rows):
        asked = [row for row in rows if row["strategy"] == strategy and "named" in row]
        if asked:
            alone = sum(row["named"] and row["equals"] == 1 for row in asked)
            flat |= {f"{strategy}_one_name": alone, f"{strategy}_false_names": sum(row["false"] for row in asked)}
            flat[f"{strategy}_searches"] = len(asked)
    return flat


def line_of(row: Row) -> str:
    """Return a row of the table."""
    powers = " ".join(f"{p:.0%}" for p in row["powers"])
    line = f"{row['truth']}/{row['rival']:17} {row['strategy']:9} {row['seed']:4d} {row['seconds']:8.0f}  {powers}"
    searched = f"; {row['answer']}" if "answer" in row else ""
    return f"{line} ({row['ended']}{searched})"


Task = tuple[str, int, str]
"""Key of a pair, seed, strategy."""


def _made(task: Task, most: int, settings: DesignSettings, search: bool, threads: int) -> Row:
    name, seed, strategy = task
    with one_thread():
        return run(CASES[name], strategy, seed, most, settings, threads, search)


def main(arguments: list[str]) -> None:
    """Run all pairs with all strategies and print a table."""
    given = dict(word.split("=", 1) for word in arguments if "=" in word)
    usual = {"pairs": ",".join(CASES), "strategies": ",".join(STRATEGIES), "n": "1", "designs": "24", "most": "6"}
    usual |= {"seconds": "6", "search": "false", "jobs": "1", "threads": "1"}
    if not {"out"} <= set(given) <= {"out", *usual} or len(given) != len(arguments):
        raise SystemExit(__doc__)
    usual |= given
    if unknown := sorted({*usual["pairs"].split(",")} - {*CASES}):
        raise SystemExit(f"pairs={unknown[0]}: there are {', '.join(CASES)}")
    if unknown := sorted({*usual["strategies"].split(",")} - {*STRATEGIES}):
        raise SystemExit(f"strategies={unknown[0]}: there are {', '.join(STRATEGIES)}")
    settings = DesignSettings(seconds=float(usual["seconds"]), designs=int(usual["designs"]), refine=1)
    most, search, file = int(usual["most"]), usual["search"] == "true", Path(usual["out"]) / "next.json"
    rows: list[Row] = json.loads(file.read_text()) if file.is_file() else []
    have = {(row["truth"], row["rival"], row["seed"], row["strategy"]) for row in rows}
    every = product(usual["pairs"].split(","), range(int(usual["n"])), usual["strategies"].split(","))
    todo = [t for t in every if (CASES[t[0]].truth, CASES[t[0]].rival, t[1], t[2]) not in have]
    work = partial(_made, most=most, settings=settings, search=search, threads=int(usual["threads"]))
    file.parent.mkdir(parents=True, exist_ok=True)
    print(f"{'pair':28} {'strategy':9} {'seed':>4} {'robot s':>8}  powers")
    with multiprocessing.get_context("spawn").Pool(int(usual["jobs"]), maxtasksperchild=1) as pool:
        for row in pool.imap_unordered(work, todo):
            rows.append(row)
            print(line_of(row), flush=True)
            file.write_text(json.dumps(rows, indent=1))
    flat = figures(rows, most, settings.seconds)
    words = " ".join(f"{key}={value}" for key, value in usual.items() if key not in ("out", "jobs", "threads"))
    write_results(file.with_name("gap.json"), f"python -m benchmarks.gap_next {words}", flat)
    print(json.dumps(flat, indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
