"""Names from walks: ``python -m benchmarks.gap_walks out=FILE seed=INT [scale=1] [policy=clock]``.

``[episodes=4] [seconds=6] [phase=swing] [kinds=hidden,null] [effects=coulomb,strength] [size=5]``: walks of a case and
their length; what of them is compared; what is drawn; which effects are hidden, and how large, in tolerances.

A shipped policy walks under the random commands of its training, on a robot in which one effect is hidden, at all
joints or at those of one kind, or on its trunk; or nothing that a leg in the air feels (nulls: no
effect, a payload, slippery feet). With ``phase=auto`` or ``whole`` the trunk and the ground are compared as well, so a
null is a robot with no effect. Each is one case for each unit of ``scale``. The logger has the noise of
``conf/record.yaml``; the robot's step is 0.5 ms, the search's 1 ms. Counted: hidden effects that are the first name,
or do as well as it and are named with it; cases of all in which anything else is named; and, of those named right, at
exactly the joints where they are. Adds the figures to FILE, with Wilson's 95 % intervals,
after each case.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.results import write_results

USAGE = (
    "usage: python -m benchmarks.gap_walks out=FILE seed=INT [scale=1] [policy=clock] [episodes=4] [seconds=6] "
    "[phase=swing] [kinds=hidden,null] [effects=coulomb,strength] [size=5]"
)

HIDDEN: dict[str, tuple[str, float]] = {
    "coulomb": ("bound", 1.0),
    "viscous": ("damping", 1.0),
    "armature": ("added", 1.0),
    "torque_delay": ("delay", 1.0),
    "command_delay": ("delay", 1.0),
    "strength": ("scale", -1.0),
    "encoder_offset": ("offset", 1.0),
    "payload": ("mass", 1.0),
}
"""Effect -> its parameter, and in which direction it leaves its null value."""

USUAL = "coulomb,viscous,armature,torque_delay,command_delay,strength"
"""Effects that are hidden by default: those that a leg in the air feels."""

NULLS: tuple[Mapping[str, Mapping[str, float]], ...] = (
    {},
    {"payload": {"mass": 2.0}},
    {"foot_friction": {"scale": 0.6}},
)
"""What no leg in the air feels."""

WRONG = "walk_false_share"
"""Figure: share of the cases with a name that is not what is hidden in them; ``walk_false_names`` is their number."""

KINDS = ("all", "hip", "thigh", "calf")


@dataclass(frozen=True)
class Case:
    """A robot to be recorded.

    Attributes:
        name: for people.
        effect: what is hidden in it, as a configuration has it.
        hidden: the effect to be named; empty for a null.
        joints: where it is.
        seed: of its walks.
    """

    name: str
    effect: Mapping[str, Any]
    hidden: str
    joints: tuple[str, ...]
    seed: int


def cases(seed: int, scale: int, kinds: Sequence[str], effects: Sequence[str], size: float, phase: str) -> list[Case]:
    """Draw the cases; ``size`` in tolerances."""
    from go1exp import robot
    from go1exp.sim.effects.tolerances import declared

    rng, drawn = np.random.default_rng(seed), []
    for turn in range(scale):
        for effect in effects:
            parameter, sign = HIDDEN[effect]
            kind, p = KINDS[int(rng.integers(len(KINDS)))], declared((effect, parameter))
            value = p.null + sign * size * p.tolerance
            if p.per != "joint":
                drawn.append(Case(f"{effect}_{turn}", {effect: {parameter: value}}, effect, (), 0))
                continue
            joints = tuple(j for j in robot.JOINTS if kind in ("all", j.split("_")[1]))
            values = dict.fromkeys(robot.JOINTS, p.null) | dict.fromkeys(joints, value)
            drawn.append(Case(f"{effect}_{kind}_{turn}", {effect: {parameter: values}}, effect, joints, 0))
        for null in NULLS if phase == "swing" else NULLS[:1]:
            drawn.append(Case(f"null_{'_'.join(null) or 'plain'}_{turn}", null, "", (), 0))
    seeded = [Case(c.name, c.effect, c.hidden, c.joints, int(rng.integers(2**31))) for c in drawn]
    return [c for c in seeded if ("hidden" if c.hidden else "null") in kinds]


def solved(case: Case, policy: str, episodes: int, seconds: float, phase: str) -> Any:
    """Let a case's robot walk, and return what the search answers (``GapResult``)."""
    from go1exp.cli.app import parse
    from go1exp.cli.places import trained
    from go1exp.cli.record import RIG, RecordSettings
    from go1exp.config.compose import compose
    from go1exp.gap.result import GapSettings
    from go1exp.gap.stages.explain import explain
    from go1exp.logs.record import simulate
    from go1exp.sim.task import parse_parts
    from go1exp.train.policy import load_run

    config, acts, _ = load_run(trained(None, policy, "", None)[0])
    gains = [f"actuator.{g}={simulate.configured(config.task.actuator, g)[0]}" for g in ("kp", "kd")]  # type: ignore[index]
    container = compose("record", ["backend.threads=1", "actuator=pd", *gains])
    container["effect"] = case.effect
    parts, problems = parse_parts(container, RIG)
    if problems:
        raise SystemExit("\n".join(problems))
    settings = parse(
        RecordSettings, {k: v for k, v in container.items() if k not in (*RIG, "excitation", "controller")}
    )
    rig = simulate.Rig(**parts, physics_dt=settings.physics_dt)
    names = [f"{case.name}_{k}" for k in range(episodes)]
    walk = simulate.Walk(config.task, acts, names, seconds, None)
    logs = simulate.play_policy(rig, walk, settings.sensors, case.seed, lambda done, total: None)
    nominal = parse_parts(compose("gap", ["logs=none"]), ("robot",))[0]["robot"]
    search = GapSettings(phase=phase, threads=1, overlays=0)  # type: ignore[arg-type]
    return explain(logs, nominal, search)


def figures(counts: Mapping[str, Sequence[bool]]) -> dict[str, float | int | str | None]:
    """Return shares, and the number of cases with a wrong name, as a file of results has them."""
    from go1exp.evaluate.statistics.intervals import share_interval

    flat: dict[str, float | int | str | None] = {}
    for name, each in counts.items():
        share = share_interval(sum(each), len(each))
        if share.n:
            flat |= {name: share.estimate, f"{name}_n": share.n, f"{name}_low": share.low, f"{name}_high": share.high}
    flat["walk_false_names"] = sum(counts[WRONG])
    return flat


def main(arguments: Sequence[str]) -> None:
    """Walk, search, count."""
    given = dict(a.split("=", 1) for a in arguments if "=" in a)
    usual = {"scale": "1", "policy": "clock", "episodes": "4", "seconds": "6", "phase": "swing", "kinds": "hidden,null"}
    usual |= {"effects": USUAL, "size": "5"}
    if not {"out", "seed"} <= set(given) <= {"out", "seed", *usual} or len(given) != len(arguments):
        raise SystemExit(USAGE)
    usual |= given
    try:
        seed, scale, episodes, seconds = (int(usual[k]) for k in ("seed", "scale", "episodes", "seconds"))
        size = float(usual["size"])
    except ValueError as error:
        raise SystemExit(f"{USAGE}\n{error}") from error
    effects, phase = usual["effects"].split(","), usual["phase"]
    if unknown := sorted({*effects} - {*HIDDEN}):
        raise SystemExit(f"effects={unknown[0]}: there are {', '.join(HIDDEN)}")
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    todo, begun = cases(seed, scale, usual["kinds"].split(","), effects, size, phase), time.monotonic()
    counts: dict[str, list[bool]] = {"walks_named": [], "walks_certified": [], "walks_joints_right": [], WRONG: []}
    command = " ".join(f"{k}={v}" for k, v in usual.items() if k != "out")
    for done, case in enumerate(todo, start=1):
        result = solved(case, usual["policy"], episodes, float(seconds), phase)
        first = result.named[0] if result.named else None
        right = first is not None and case.hidden in first.alias_set
        counts[WRONG].append(any(case.hidden not in n.alias_set for n in result.named))
        if case.hidden:
            counts["walks_named"].append(right)
        if first is not None and right:
            counts["walks_certified"].append(first.status == "certified")
            counts["walks_joints_right"].append(set(first.joints) == set(case.joints))
        left = (time.monotonic() - begun) / done * (len(todo) - done) / 60
        print(f"[{done}/{len(todo)}, {left:.0f} min left] {case.name}: {result.verdict}, {result.seconds:.0f} s.")
        print(f"  {result.sentence}", flush=True)
        write_results(Path(usual["out"]), f"python -m benchmarks.gap_walks {command}", figures(counts))
    for name, value in figures(counts).items():
        print(f"{name} {value:.3g}")


if __name__ == "__main__":
    main(sys.argv[1:])
