"""Robot seconds until two effects that look alike are told apart: by ``gap next``, standard recordings, random designs.

    python -m benchmarks.gap_next [out=FILE.json] [pairs=tilt,kd] [n=2] [designs=24] [most=6]

A simulated Go1 has one effect of a pair, whose size is taken as known. It is first recorded in slow ramps, 2 x 3 s.
Recordings of 6 s are added one by one until the rival, fitted to all of them, is told apart with a power of 80 %. The
power is computed on the windows of the recordings, not of the rehearsals. No search is run, so false names are not
counted.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import go1exp.excitations  # noqa: F401  (registers every excitation)
from go1exp.compose import compose
from go1exp.config import parse_parts
from go1exp.gap.comparison import Comparison, compare
from go1exp.gap.design.choice import COARSE, ENOUGH, choose
from go1exp.gap.design.limits import Limits, limits_of
from go1exp.gap.design.plan import Attitude, Design, library
from go1exp.gap.design.power import Judge, Pair
from go1exp.gap.design.rehearsal import Rehearsal, Stage
from go1exp.gap.design.settings import DesignSettings
from go1exp.gap.replay.rows import Theta
from go1exp.gap.result import GapSettings
from go1exp.gap.robots.hung import hung
from go1exp.gap.robots.protocol import Robot
from go1exp.record.plan import Episode, make_motion
from go1exp.record.sensors import SensorConfig
from go1exp.record.simulate import Rig, held_quat, play
from go1exp.recording import Recording
from go1exp.schema.registry import bind
from go1exp.schema.settings import parse
from go1exp.tensors.threads import one_thread

SECONDS, FIRST_SECONDS = 6.0, 3.0
GAINS = ((20.0, 0.5), (35.0, 0.6), (35.0, 1.2))
"""Of the standard recordings (docs/gap.md), one set after the other; the first are those at hand."""

KINDS = ("chirp", "steps", "slow_ramps")
STRATEGIES = ("next", "standard", "random")


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
        self.robot: Robot = hung(parts["robot"])
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

    def judged(self) -> tuple[Comparison, Judge, float]:
        """Return the recordings compared, the pair, and the power so far."""
        comparison = compare(self.recordings, self.robot, self.settings)
        case = self.case
        pair = Pair(case.truth, case.rival, case.theta, {}, (case.rival,), 0.0, 0.02)
        judge = Judge(pair, comparison.scorer, comparison.settings, COARSE * comparison.dt)
        return comparison, judge, judge.worth(judge.at_hand).power

    def stage(self, comparison: Comparison, settings: DesignSettings) -> Stage:
        """Return where designs are rehearsed."""
        targets = [r.joint("q_target") for r in comparison.recordings]
        limits: Limits = limits_of(self.robot, comparison.windows, targets, settings.limits)
        return Stage(comparison, limits, self.case.theta, SECONDS)


def _attitudes(settings: DesignSettings) -> list[Attitude]:
    return [Attitude(roll, pitch, held_quat((roll, pitch))) for roll, pitch in settings.hang]


def _episode(played: Rehearsal, name: str) -> Episode:
    attitude = played.design.attitude
    assert attitude.roll is not None
    assert attitude.pitch is not None
    hang = (attitude.roll, attitude.pitch)
    return Episode(name, played.design.excitation, played.motion, played.kp[0], played.kd[0], hang, None, 0)


def _designed(bench: Bench, comparison: Comparison, judge: Judge, settings: DesignSettings) -> Episode | None:
    choice = choose(
        bench.stage(comparison, settings), [judge], _attitudes(settings), settings, lambda what, share: None
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


def run(case: Case, strategy: str, seed: int, most: int, settings: DesignSettings, threads: int) -> dict[str, Any]:
    """Add recordings until the pair is told apart; return what it took."""
    bench, usual, begun = Bench(case, seed, threads), _usual(), time.perf_counter()
    powers: list[float] = []
    ended = "not told apart"
    for turn in range(most + 1):
        comparison, judge, power = bench.judged()
        powers.append(power)
        if power >= ENOUGH:
            ended = "told apart"
            break
        if turn == most:
            break
        if strategy == "standard":
            kind, gains = next(usual)
            bench.add(bench.standard(kind, SECONDS, gains, 100 * seed + 10 + turn))
            continue
        if strategy == "next":
            episode = _designed(bench, comparison, judge, settings)
        else:
            episode = _drawn(bench, comparison, settings)
        if episode is None:
            ended = "called not separable"
            break
        bench.add(episode)
    added = len(bench.recordings) - 2
    about = {"truth": case.truth, "rival": case.rival, "strategy": strategy, "seed": seed, "ended": ended}
    return about | {"seconds": SECONDS * added, "powers": powers, "wall_s": round(time.perf_counter() - begun, 1)}


def main(arguments: list[str]) -> None:
    """Run all pairs with all strategies and print a table."""
    given = dict(word.split("=", 1) for word in arguments)
    settings = DesignSettings(seconds=SECONDS, designs=int(given.get("designs", 24)), refine=1)
    most, threads = int(given.get("most", 6)), int(given.get("threads", 1))
    rows = []
    print(f"{'pair':28} {'strategy':9} {'seed':>4} {'robot s':>8}  powers")
    with one_thread():
        for name in given.get("pairs", ",".join(CASES)).split(","):
            for seed in range(int(given.get("n", 1))):
                for strategy in given.get("strategies", ",".join(STRATEGIES)).split(","):
                    row = run(CASES[name], strategy, seed, most, settings, threads)
                    rows.append(row)
                    powers = " ".join(f"{p:.0%}" for p in row["powers"])
                    pair = f"{row['truth']}/{row['rival']}"
                    print(
                        f"{pair:28} {strategy:9} {seed:4d} {row['seconds']:8.0f}  {powers} ({row['ended']})", flush=True
                    )
                    if "out" in given:
                        Path(given["out"]).write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
