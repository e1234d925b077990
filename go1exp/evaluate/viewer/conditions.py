"""What a robot of the window walks under, made into a task: ground, effects, delay, physics rate."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from go1exp.config.schema.backends import BackendConfig
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.evaluate.protocol.ground import UNITS, GroundName, Lanes
from go1exp.evaluate.protocol.stage import delay_of_effects
from go1exp.evaluate.rollout import EvalConfig, delayed, evaluation_task
from go1exp.evaluate.viewer.effects import acting
from go1exp.sim.task import TaskConfig
from go1exp.sim.terrain import TerrainConfig

HARDEST: dict[GroundName, float] = {
    "slope_up": 30.0,
    "slope_down": 30.0,
    "gravel": 0.15,
    "waves": 0.4,
    "stairs_up": 0.25,
    "stairs_down": 0.25,
    "boxes": 0.3,
}
"""Where the slider of a lane's difficulty ends, in the unit of ``protocol.ground.UNITS`` (chosen: beyond any of our
policies)."""

FLAT = "flat"

FOREVER = 1e7
"""Time limit of an episode, s."""


@dataclass(frozen=True)
class Ground:
    """A ground to choose.

    Attributes:
        config: graded tiles or a plane; of a lane None.
        lane: what its difficulty is of; None for the others.
        hardest: largest level.
        unit: of a level; empty for rows of tiles.
        tiles: kinds of tile.
    """

    config: TerrainConfig | None
    lane: GroundName | None = None
    hardest: float = 0.0
    unit: str = ""
    tiles: tuple[str, ...] = ()

    def built(self, level: float) -> TerrainConfig:
        """Return the ground at a level."""
        if self.lane is not None:
            return Lanes(ground=self.lane, levels=(min(max(level, 0.0), self.hardest),))
        assert self.config is not None
        return self.config


def grounds(files: Mapping[str, TerrainConfig]) -> dict[str, Ground]:
    """Return every ground by name: those of ``conf/terrain`` or of a run, and the lanes of the protocols."""
    from go1exp.sim.terrain import build_terrain

    known: dict[str, Ground] = {}
    for name, config in files.items():
        if config.kind == "flat":
            known[name] = Ground(config)
        else:
            kinds = tuple(dict.fromkeys(build_terrain(config).tile_types))
            known[name] = Ground(config, hardest=config.rows - 1.0, tiles=kinds)
    lanes: tuple[GroundName, ...] = get_args(GroundName)
    return known | {lane: Ground(None, lane, HARDEST[lane], UNITS[lane]) for lane in lanes}


@dataclass(frozen=True)
class Setup:
    """What a robot walks under.

    Attributes:
        ground: its name.
        level: as in ``requests.Walk``.
        tile: as in ``requests.Walk``.
        sizes: effects that act, by name, and their sizes.
        noise: as in ``requests.Conditions``.
        delay: as in ``requests.Conditions``, s.
        physics_dt: as in ``requests.Conditions``, s.
        trunk_velocity: as in ``requests.Conditions``.
        randomize: randomise robots and starts as in training.
        push: push as in training.
        engine: what moves the robot; None for MuJoCo on the processor.
        seed: of everything random.
    """

    ground: str = FLAT
    level: float = 0.0
    tile: str | None = None
    sizes: Mapping[str, float] = field(default_factory=dict)
    noise: bool = False
    delay: float = 0.0
    physics_dt: float | None = None
    trunk_velocity: Literal["exact", "estimated"] = "exact"
    randomize: bool = False
    push: bool = False
    engine: BackendConfig | None = None
    seed: int = 1


def task_under(task: TaskConfig, setup: Setup, known: Mapping[str, Ground], effects: Mapping[str, Term]) -> TaskConfig:
    """Return the task in which a robot walks under ``setup``; a physics step that does not fit is made to.

    Args:
        task: of the policy.
        setup: under what.
        known: grounds by name.
        effects: by name, at size 1.

    Raises:
        ConfigError: if effects and drives do not go together, or a name is not known.
    """
    if setup.ground not in known:
        raise ConfigError([f"ground = {setup.ground!r}: known are {', '.join(known)}"])
    period = task.sim.policy_dt
    step = setup.physics_dt or task.sim.physics_dt
    config = EvalConfig(
        commands=(),
        episodes=1,
        duration_s=FOREVER,
        settle_s=0.0,
        noise=setup.noise,
        randomize=setup.randomize,
        push=setup.push,
        train_ground=False,
        policy_dt=None,
        seed=setup.seed,
        physics_dt=period / math.ceil(period / step - 1e-6),
        engine=setup.engine,
    )
    ground, effect = known[setup.ground].built(setup.level), acting(setup.sizes, effects, task.actuator, task.contact)
    made = dataclasses.replace(evaluation_task(task, config), terrain=ground, effect=effect)
    return delayed(made, setup.delay + delay_of_effects(made)) if setup.delay > 0.0 else made
