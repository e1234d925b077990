"""What gait terms give to which gait: ``python -m benchmarks.gait_scores [simulate=true]``.

Patterns made by hand pass through the foot timers at 2 ms and are scored every 20 ms, as in training; ``bounces``
adds what simulated feet do as they lift off and land. Beside the
registered ``gait`` (absolute time) and ``trot`` (phases) stands a kernel that was tried: the timers' differences over
the mean phase P, exp(-E / scale), which is free of time scale too. The last table is the share of phase offsets from
which steepest ascent of the mean score ends in the trot. ``simulate=true`` adds random actions and the shipped policy.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from go1exp.base.paths import data_root
from go1exp.config.compose import compose
from go1exp.config.schema.registry import members
from go1exp.evaluate.rollout import EvalConfig, evaluation_task
from go1exp.mdp.derived import ASYNC_PAIRS, SYNC_PAIRS
from go1exp.mdp.feet import Feet
from go1exp.mdp.measures import gait
from go1exp.mdp.types import TermSetup
from go1exp.sim.env.core import Go1Core
from go1exp.sim.task import parse_train
from go1exp.train.policy import load_run

PHYSICS_DT, SUBSTEPS = 0.002, 10

GAITS = {
    **{name: gait.GAITS[name] for name in ("trot", "pace", "bound", "pronk")},
    "walk": gait.GAITS["lateral sequence"],
    "amble": gait.GAITS["diagonal sequence"],
    "gallop": (0.0, 0.1, 0.6, 0.5),
    "hop of version 0.1": (0.0, 0.11, 0.71, 0.05),
}
"""Touchdown of FR FL RR RL, cycles."""

RATES = (1.5, 2.5, 4.5, 8.0, 25.0)
"""Strides per second."""

Score = Callable[[Any], Tensor]
"""Robots with foot timers -> (N,); called at every policy step, since it may remember."""

Moment = tuple[bool, Any]
"""Whether a policy step counts, and the robots in it."""


class Pattern(NamedTuple):
    """N rows of footfalls; a duty below 0 is a foot that never lands, above 1 one that never lifts."""

    rate: Tensor
    """(N, 1) Hz"""
    offset: Tensor
    """(N, 4) touchdown, cycles"""
    duty: Tensor
    """(N, 4) share of the cycle on the ground"""


def pattern(rate: float, offset: Sequence[float], duty: float | Sequence[float] = 0.5) -> Pattern:
    """Return one row."""
    duties = torch.tensor(duty).expand(1, 4)
    return Pattern(torch.tensor([[rate]]), torch.tensor([list(offset)]), duties)


def robots(timers: Feet) -> Any:
    """Return what a gait term looks at: robots that are commanded to walk, with these timers."""
    n = len(timers.air)
    return SimpleNamespace(
        command=torch.tensor([0.5, 0.0, 0.0]).expand(n, 3),
        base_lin_vel_b=torch.zeros(n, 3),
        foot_air_time=timers.air,
        foot_contact_time=timers.contact,
        foot_last_air_time=timers.last_air,
        foot_last_contact_time=timers.last_contact,
        foot_touchdown=timers.touchdown,
    )


def steps(contacts: Callable[[int], Tensor], n: int, first: int, last: int) -> Iterator[Moment]:
    """Yield robots after each policy step; those from ``first`` on count. ``contacts``: who touches in a substep."""
    timers = Feet(n, PHYSICS_DT, torch.device("cpu"))
    for step in range(last):
        timers.begin_step()
        for substep in range(SUBSTEPS):
            timers.touch(contacts(step * SUBSTEPS + substep))
        yield step >= first, robots(timers)


def walking(p: Pattern, cycles: int = 4, bounces: bool = False) -> Iterator[Moment]:
    """Yield robots that walk in this pattern; what counts are ``cycles`` after the first three."""
    cycle = SUBSTEPS * PHYSICS_DT * p.rate.min().item()

    def contacts(substep: int) -> Tensor:
        # A hair early, so that rounding never moves a touchdown that falls on a step.
        phase = (substep * PHYSICS_DT * p.rate - p.offset + 1e-4) % 1.0
        # 8 ms of air after 6 ms of contact, and 4 ms of contact after 10 ms of air.
        after, beyond = phase / p.rate, (phase - p.duty) / p.rate
        flipped = ((after > 0.006) & (after < 0.014)) | ((beyond > 0.010) & (beyond < 0.014))
        return (phase < p.duty) ^ (flipped & bounces)

    yield from steps(contacts, len(p.offset), int(3 / cycle) + 2, int((3 + cycles) / cycle) + 2)


def trembling(share: float, n: int = 200, seconds: float = 4.0) -> Iterator[Moment]:
    """Yield robots each of whose feet changes between air and ground in a substep with this probability."""
    generator = torch.Generator().manual_seed(0)
    touching = torch.rand(n, 4, generator=generator) < 0.5

    def contacts(_: int) -> Tensor:
        touching.logical_xor_(torch.rand(n, 4, generator=generator) < share)
        return touching

    yield from steps(contacts, n, 50, int(seconds / (SUBSTEPS * PHYSICS_DT)))


def timer_differences(s: Any, scale: float) -> Tensor:
    """Return the kernel that was tried: ``gait`` with times over P, the mean phase, held in 0.04 to 0.5 s."""
    p = ((s.foot_last_air_time + s.foot_last_contact_time).mean(-1) / 2).clamp(0.04, 0.5)
    air, contact = s.foot_air_time, s.foot_contact_time
    pairs = [(x[:, i], x[:, j]) for i, j in SYNC_PAIRS for x in (air, contact)]
    pairs += [pair for i, j in ASYNC_PAIRS for pair in ((air[:, i], contact[:, j]), (contact[:, i], air[:, j]))]
    error = sum((((a - b) / p).square().clamp(max=4.0) for a, b in pairs), torch.zeros_like(p))
    return torch.exp(-error / scale)


def registered(name: str, **parameters: float) -> Callable[[], Score]:
    """Return a maker of scores from a reward term."""
    entry = members("reward")[name]

    def make() -> Score:
        terms: list[Score] = []

        def score(s: Any) -> Tensor:
            if not terms:
                setup = TermSetup(len(s.foot_air_time), s.foot_air_time.device, SUBSTEPS * PHYSICS_DT)
                made = entry.target(setup, **parameters) if entry.remembers else partial(entry.target, **parameters)
                terms.append(made)
            return terms[0](s)

        return score

    return make


SCORES: dict[str, Callable[[], Score]] = {
    "gait": registered("gait"),
    "differences 0.33": lambda: lambda s: timer_differences(s, 0.33),
    "differences 8": lambda: lambda s: timer_differences(s, 8.0),
    "trot": registered("trot"),
    "trot, full_cycle 0.4": registered("trot", full_cycle=0.4),
}


def mean_scores(moments: Iterator[Moment], makers: dict[str, Callable[[], Score]] = SCORES) -> dict[str, Tensor]:
    """Return the mean of each score over the steps that count, (N,)."""
    scores = {name: make() for name, make in makers.items()}
    values = [(counts, {name: score(s).clone() for name, score in scores.items()}) for counts, s in moments]
    return {name: torch.stack([v[name] for counts, v in values if counts]).mean(0) for name in scores}


def climbing(make: Callable[[], Score], duty: float, rate: float = 2.5, points: int = 16) -> float:
    """Return the share of a grid of phase offsets from which steepest ascent ends next to the trot."""
    axis = torch.arange(points) / points
    offset = torch.cartesian_prod(torch.zeros(1), axis, axis, axis)
    n = len(offset)
    p = Pattern(torch.full((n, 1), rate), offset, torch.full((n, 4), duty))
    value = mean_scores(walking(p, cycles=2), {"": make})[""].reshape(points, points, points)
    best, where = value.clone(), torch.arange(n).reshape(value.shape)
    for shift in itertools.product((-1, 0, 1), repeat=3):
        neighbour = value.roll(shift, (0, 1, 2))
        better = neighbour > best + 1e-6
        best = torch.where(better, neighbour, best)
        where = torch.where(better, torch.arange(n).reshape(value.shape).roll(shift, (0, 1, 2)), where)
    end = where.flatten()
    for _ in range(points):
        end = end[end]
    from_trot = (offset[end][:, 1:] - torch.tensor(GAITS["trot"][1:]) + 0.5) % 1.0 - 0.5
    return float((from_trot.abs().amax(-1) < 1.5 / points).float().mean())


def simulated() -> Iterator[tuple[str, dict[str, Tensor]]]:
    """Yield the mean scores of random actions and of the shipped policy, on flat ground."""
    task = parse_train(compose("train", ["rand=none", "event=none", "command=forward"])).task
    core = Go1Core(task, 64, 0)
    core.reset()
    generator = torch.Generator().manual_seed(0)

    def shake() -> Iterator[Moment]:
        for step in range(500):
            core.step(torch.randn(64, 12, generator=generator))
            yield step >= 50, core.snapshot()

    yield "random actions, standard deviation 1", mean_scores(shake())
    config, policy, _ = load_run(data_root() / "assets" / "policies" / "paper")
    wanted = EvalConfig(
        *(((1.0, 0.0, 0.0),), 16, 20.0, 2.0),
        noise=True,
        randomize=False,
        push=False,
        train_ground=False,
        policy_dt=None,
        seed=1,
    )
    shipped = Go1Core(evaluation_task(config.task, wanted), 16, 1)
    shipped.command.value.copy_(torch.tensor(wanted.commands).expand(16, 3))

    def walk() -> Iterator[Moment]:
        observation = shipped.reset()
        for step in range(500):
            observation = shipped.step(policy(observation)).observation
            yield step >= 100, shipped.snapshot()

    yield "policy=paper, 1 m/s", mean_scores(walk())


def main(arguments: Sequence[str]) -> None:
    """Print the tables."""
    if not set(arguments) <= {"simulate=true"}:
        raise SystemExit("usage: python -m benchmarks.gait_scores [simulate=true]")
    torch.set_num_threads(1)

    def line(name: str, values: dict[str, Tensor]) -> None:
        print(f"| {name} |" + "".join(f" {v.mean():.2f} |" for v in values.values()), flush=True)

    print("| | " + " | ".join(SCORES) + " |\n|---|" + "---|" * len(SCORES))
    for name, offset in GAITS.items():
        for duty in (0.35, 0.5, 0.65) if name == "trot" else (0.5,):
            for rate in RATES:
                line(f"{name}, duty {duty}, {rate} Hz", mean_scores(walking(pattern(rate, offset, duty))))
    for name, duties in (("never lands", (0.5, 0.5, -1.0, 0.5)), ("never lifts", (0.5, 0.5, 2.0, 0.5))):
        line(f"trot of three legs, RR {name}", mean_scores(walking(pattern(2.5, GAITS["trot"], duties))))
    for rate in (1.5, 2.5, 4.5):
        bouncing = walking(pattern(rate, GAITS["trot"]), bounces=True)
        line(f"trot, feet that bounce at liftoff and touchdown, {rate} Hz", mean_scores(bouncing))
    for share in (0.05, 0.2, 0.5):
        line(f"each foot changes in {100 * share:.0f} % of the substeps", mean_scores(trembling(share)))
    if arguments:
        for name, values in simulated():
            line(name, values)
    print("\nShare of phase offsets that climb to the trot, %\n| duty | " + " | ".join(SCORES) + " |")
    for duty in (0.35, 0.5, 0.65):
        print(f"| {duty} |" + "".join(f" {100 * climbing(s, duty):.0f} |" for s in SCORES.values()), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
