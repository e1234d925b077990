"""Requests of the viewer's user to a simulation: plain data, and the task that they select."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast, get_args

from go1exp import robot
from go1exp.config.choices import choice_files, config_folder, load
from go1exp.config.schema.joint_values import JointValues, numbers
from go1exp.config.schema.physics import BackendConfig, ContactConfig, fitting_step
from go1exp.config.schema.registry import ConfigError, Term
from go1exp.config.schema.settings import subset
from go1exp.evaluate.controller.types import TrunkVelocity
from go1exp.evaluate.protocol.ground import UNITS, GroundName, Lanes
from go1exp.evaluate.protocol.stage import delay_of_effects
from go1exp.evaluate.rollout import EvalConfig, delayed, evaluation_task
from go1exp.sim.effects.base import Param
from go1exp.sim.effects.rules import actuator_problems
from go1exp.sim.effects.tolerances import Tolerances
from go1exp.sim.task import TaskConfig, parse_parts
from go1exp.sim.terrain import TerrainConfig, build_terrain

Velocity = tuple[float, float, float]  # x and y, m/s, and yaw rate, rad/s, in the trunk's frame


@dataclass(frozen=True)
class Command:
    """Command another velocity."""

    velocity: Velocity


@dataclass(frozen=True)
class Push:
    """Push the trunk once: a half sine over ``session.PUSH_S``."""

    impulse: float  # N s
    direction: float  # of the force, from the robot's heading counter-clockwise, rad


@dataclass(frozen=True)
class SelectPolicy:
    """Select another policy, run, bundle or controller by its label; the robot continues from its state."""

    label: str


@dataclass(frozen=True)
class SetEffects:
    """Set the active effects."""

    sizes: dict[str, float]  # by name; 1 is the effect as its choice or the run has it, 0 its absence


@dataclass(frozen=True)
class SelectGround:
    """Restart on another ground."""

    ground: str
    level: float = 0.0  # difficulty: the row of graded tiles, or a lane's difficulty in its own unit
    tile: str | None = None  # kind of tile, of graded tiles


@dataclass(frozen=True)
class Conditions:
    """Set sensors, delay and physics step."""

    noise: bool = False  # add sensor noise to the observations
    delay: float = 0.0  # additional command delay, s
    physics_dt: float | None = None  # physics step, s; None takes that of training
    trunk_velocity: TrunkVelocity = "exact"  # the true one, or that of the Kalman filter


@dataclass(frozen=True)
class Pace:
    """Set the speed of the simulation."""

    paused: bool
    speed: float = 1.0  # simulated seconds per second


@dataclass(frozen=True)
class Step:
    """Simulate one period of the policy while paused."""


@dataclass(frozen=True)
class Reset:
    """Reset the robot to the start."""


class Ended(Exception):
    """The simulation or the recording has ended."""


Request = Command | Push | SelectPolicy | SetEffects | SelectGround | Conditions | Pace | Step | Reset


LARGEST = 3.0  # largest size of an effect, relative to its choice


def catalogue(effects: tuple[Term, ...], randomize: bool) -> tuple[dict[str, Term], dict[str, float]]:
    """Return every effect by name at size 1, and the sizes of those that the robot has.

    An effect of the robot with nominal values of null (only randomised in training) is inactive, as its choice has it.
    ``randomize`` keeps the randomisation of the robot's own effects.
    """
    known: dict[str, Term] = {}
    for file in choice_files("effect", [config_folder()]).values():
        parts, problems = parse_parts({"effect": load(file)}, ("effect",))
        if not problems:
            known |= {term.key: term for term in parts["effect"]}
    sizes = dict.fromkeys(known, 0.0)
    for term in effects:
        spread = randomize and any(term.slots.get("spread", {}).values())
        nulls = {p.name: p.null for p in params_of(term)}
        if spread or any(v != nulls[name] for name, value in term.parameters.items() for v in numbers(value)):
            known[term.key] = term if spread else dataclasses.replace(term, slots={"spread": {}})
            sizes[term.key] = 1.0
    return dict(sorted(known.items())), sizes


def active(
    sizes: Mapping[str, float], effects: Mapping[str, Term], actuator: Term, contact: ContactConfig
) -> tuple[Term, ...]:
    """Return effects of sizes above 0, at that size (``effects``: all at size 1); raise ConfigError of misfits."""
    if strange := [name for name in sizes if name not in effects]:
        raise ConfigError([f"effect {strange[0]!r}: known are {', '.join(effects)}"])
    chosen = {name: size for name, size in sizes.items() if size > 0.0}
    terms = tuple(
        effects[name] if size == 1.0 else resized(effects[name], size, contact) for name, size in chosen.items()
    )
    if problems := actuator_problems(actuator, terms, robot.JOINTS):
        raise ConfigError(problems)
    return terms


def resized(term: Term, size: float, contact: ContactConfig) -> Term:
    """Return an effect with parameters ``size`` times as far from null, clipped to their limits, without randomisation.

    A parameter per joint keeps its joints; one whose values are all null stays. Null is that of a robot with this
    contact.
    """
    parameters, known = dict(term.parameters), Tolerances(contact=contact)
    for p in params_of(term):
        left_alone = p.least is not None and parameters.get(p.name) == p.null  # what the model has stays
        if p.name in parameters and not left_alone:
            parameters[p.name] = _scaled(parameters[p.name], known.param((term.entry.name, p.name)), size)
    return dataclasses.replace(term, parameters=parameters, slots={**term.slots, "spread": {}})


def params_of(term: Term) -> tuple[Param, ...]:
    """Return the declarations of an effect's parameters."""
    return vars(term.entry.target)["params"]


def _scaled(value: JointValues, param: Param, size: float) -> JointValues:
    def one(v: float) -> float:
        return min(max(param.null + size * (v - param.null), param.low), param.high)

    if isinstance(value, Mapping):
        return {joint: one(v) for joint, v in value.items()}
    if isinstance(value, tuple | list):
        return tuple(one(v) for v in value)
    return one(float(value))


def lines(effects: Mapping[str, Term]) -> dict[str, str]:
    """Return a description of each effect: its title, and its parameters at size 1."""
    about = {}
    for key, term in effects.items():
        units = {p.name: "" if p.unit == "-" else f" {p.unit}" for p in params_of(term)}
        values = ", ".join(f"{name} {value}{units.get(name, '')}" for name, value in term.parameters.items())
        about[key] = f"{cast(Any, term.entry.target).title}; at size 1: {values}"
    return about


HARDEST: dict[GroundName, float] = {
    **{"slope_up": 30.0, "slope_down": 30.0, "stairs_up": 0.25, "stairs_down": 0.25},
    **{"gravel": 0.15, "waves": 0.4, "crossed_waves": 0.8, "boxes": 0.3, "obstacles": 0.3},
}
"""Largest difficulty of each lane, in the unit of ``protocol.ground.UNITS`` (chosen: beyond all shipped policies)."""

FLAT = "flat"
FOREVER = 1e7  # time limit of an episode, s


@dataclass(frozen=True)
class Ground:
    """A selectable ground."""

    config: TerrainConfig | None  # graded tiles or a plane; None for a lane
    lane: GroundName | None = None
    hardest: float = 0.0
    unit: str = ""  # of a level; empty for rows of tiles
    tiles: tuple[str, ...] = ()  # kinds of tile

    def built(self, level: float) -> TerrainConfig:
        """Return the terrain at a level."""
        if self.lane is not None:
            return Lanes(ground=self.lane, levels=(min(max(level, 0.0), self.hardest),))
        assert self.config is not None
        return self.config


def grounds(files: Mapping[str, TerrainConfig]) -> dict[str, Ground]:
    """Return every ground by name: those of ``conf/terrain`` or of a run, and the lanes of the protocols."""
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
class Setup(Conditions):
    """Conditions of a simulation; ``level`` and ``tile`` as in ``SelectGround``."""

    ground: str = FLAT
    level: float = 0.0
    tile: str | None = None
    sizes: Mapping[str, float] = field(default_factory=dict)
    randomize: bool = False
    push: bool = False
    engine: BackendConfig | None = None
    seed: int = 1


def task_under(task: TaskConfig, setup: Setup, known: Mapping[str, Ground], effects: Mapping[str, Term]) -> TaskConfig:
    """Return a policy's task under ``setup``, the physics step rounded down to fit; raise ConfigError of misfits."""
    if setup.ground not in known:
        raise ConfigError([f"ground = {setup.ground!r}: known are {', '.join(known)}"])
    step = fitting_step(task.sim.policy_dt, setup.physics_dt or task.sim.physics_dt)
    config = subset(EvalConfig, setup, commands=(), episodes=1, seconds=FOREVER, physics_dt=step)
    ground, effect = known[setup.ground].built(setup.level), active(setup.sizes, effects, task.actuator, task.contact)
    made = dataclasses.replace(evaluation_task(task, config), terrain=ground, effect=effect)
    return delayed(made, setup.delay + delay_of_effects(made)) if setup.delay > 0.0 else made
