"""Sizes of ``benchmarks/closed_loop.py``: how much is trained, recorded, searched and walked."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.gap import hidden
from benchmarks.gap.walking import Ground

Command = tuple[float, float, float]


@dataclass(frozen=True)
class Size:
    """How much is done.

    Attributes:
        robots: names of ``hidden.SECRETS``.
        task: overrides of all trainings.
        first: further ones of the training from nothing; it may take coarser physics than all that follow.
        walker: further ones of the training after it, which makes the policy that all others start from.
        tuned: further ones of every fine-tuning, the number of its iterations among them.
        physics_dt: step of fine-tuning, s.
        ground: that the robots walk on, where they hide none.
        recordings: suspended ones of each robot, and squats.
        seconds: of each recording.
        search: further settings of ``go1exp gap``.
        for_net: further suspended ones, which the actuator net alone is fitted to, and their seconds.
        net: further settings of ``go1exp fit-actuator``.
        commands: of the walks that are evaluated, m/s, m/s, rad/s.
        walks: with each command.
        walk_s: of each walk, s.
    """

    robots: tuple[str, ...]
    task: tuple[str, ...]
    first: tuple[str, ...]
    walker: tuple[str, ...]
    tuned: tuple[str, ...]
    physics_dt: float
    ground: Ground
    recordings: int
    seconds: float
    search: tuple[str, ...]
    for_net: tuple[int, float]
    net: tuple[str, ...]
    commands: tuple[Command, ...]
    walks: int
    walk_s: float


SLOW = ((0.5, 0.0, 0.0), (-0.4, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, -0.3, 0.0), (0.0, 0.0, 0.8), (0.4, 0.2, -0.5))
FAST = ((1.5, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.3, 0.5), (0.0, 0.0, 1.5))
NET = ("target=joint_torque", "smoothing=0.02", "history=8", "period=0.004", "half_net=false", "plots=false")

SIZES = {
    "full": Size(
        robots=tuple(hidden.SECRETS),
        # A policy that has seen ideal drives on nominal robots only.
        task=("experiment=clock", "actuator=pd", "effect=none", "rand=none"),
        first=(),
        walker=("ppo.iterations=50",),
        # At the task's 3e-4 one update of one of 21 trainings threw its policy away.
        tuned=("ppo.iterations=100", "ppo.learning_rate=0.0001", "ppo.max_kl=0.1"),
        physics_dt=0.002,
        ground=Ground(time_constant=0.005),
        recordings=8,
        seconds=5.0,
        search=("contact=stiff",),  # that of experiment=clock, with 5 ms
        for_net=(20, 5.0),
        net=(*NET, "epochs=60"),
        commands=(*SLOW, *FAST),
        walks=20,
        walk_s=10.0,
    ),
    "small": Size(
        robots=("friction", "late"),  # those that stand take minutes more
        task=("experiment=minute", "ppo.num_envs=768", "ppo.iterations=160", "ppo.schedule=fixed"),
        first=(),
        walker=("sim.physics_dt=0.005", "ppo.iterations=30"),
        tuned=("sim.physics_dt=0.005", "ppo.iterations=25"),
        physics_dt=0.005,
        ground=Ground(),
        recordings=6,
        seconds=3.0,
        search=("search.max_terms=2", "search.shortlist=3", "search.iterations=2", "search.bootstraps=12"),
        for_net=(13, 4.0),
        net=(*NET, "epochs=20"),
        commands=SLOW,
        walks=8,
        walk_s=6.0,
    ),
    "tiny": Size(  # for a test: nothing is learnt in it
        robots=("friction",),
        task=("experiment=minute", "ppo.num_envs=32", "ppo.iterations=1"),
        first=(),
        walker=("sim.physics_dt=0.005",),
        tuned=("sim.physics_dt=0.005",),
        physics_dt=0.005,
        ground=Ground(),
        recordings=6,
        seconds=1.2,
        search=("search.max_terms=1", "search.shortlist=1", "search.iterations=1", "search.bootstraps=4"),
        for_net=(3, 1.0),
        net=(*NET, "epochs=1"),
        commands=SLOW[:2],
        walks=2,
        walk_s=1.5,
    ),
}
