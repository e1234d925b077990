"""Hydra in, plain frozen dataclasses out. Nothing below this module sees a YAML or an OmegaConf.

``compose.compose`` turns overrides into a plain dict. ``parse_train`` turns that dict into a ``TrainConfig``, or raises
one ``ConfigError`` that lists everything wrong with it. Neither imports torch's machinery nor builds anything.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError

import go1exp.mdp  # noqa: F401  (registers every term)
from go1exp import robot
from go1exp.config.schema import physics, plugins
from go1exp.config.schema.physics import BACKENDS, MUJOCO_CONTACT, BackendConfig, ContactConfig, CpuBackend
from go1exp.config.schema.registry import (
    STRICT,
    ConfigError,
    Duration,
    FolderName,
    NonNegative,
    Positive,
    Strict,
    Term,
    as_json,
    bind,
    explain,
    one_of,
    unknown_name,
)
from go1exp.config.schema.settings import adapter
from go1exp.config.schema.training import BESIDE, EVALUATED, EstimatorConfig, EvalDuring, Ramp, StopRule, VideoDuring
from go1exp.config.schema.training import CheckpointConfig as CheckpointConfig
from go1exp.config.schema.training import LoggerConfig as LoggerConfig
from go1exp.config.schema.training import PPOConfig as PPOConfig
from go1exp.config.schema.training import WandbConfig as WandbConfig
from go1exp.mdp import mirror
from go1exp.robot.config import RobotConfig
from go1exp.sim import schedule
from go1exp.sim.effects.rules import actuator_problems
from go1exp.sim.terrain import TerrainConfig


@dataclass(frozen=True)
class SimConfig(Strict):
    """Time.

    Attributes:
        physics_dt: physics step, s.
        policy_dt: period of the policy, s.
        episode_s: length of an episode, s.
        spread_starts: first episodes begin at random times, so that not all end together.
    """

    physics_dt: physics.PhysicsStep
    policy_dt: Annotated[float, Field(gt=0, le=0.1)]
    episode_s: Duration
    spread_starts: bool

    @property
    def decimation(self) -> int:
        """Physics steps per policy step."""
        return round(self.policy_dt / self.physics_dt)

    @property
    def episode_steps(self) -> int:
        """Policy steps per episode."""
        return round(self.episode_s / self.policy_dt)


@dataclass(frozen=True)
class ActionConfig(Strict):
    """Action to joint target: target = nominal stance + ``scale`` x action cut at +-``clip``.

    Attributes:
        scale: rad per unit of action.
        clip: bound of the policy's output.
        max_step: largest change of a target from one policy step to the next, rad; null for any.
    """

    scale: Positive
    clip: Positive
    max_step: Positive | None = None  # runs of older versions have none

    @property
    def limits(self) -> tuple[float, float | None]:
        """Bounds of an action and of its change, as ``limited`` takes them."""
        return self.clip, None if self.max_step is None else self.max_step / self.scale


@dataclass(frozen=True)
class TaskConfig:
    """One environment: everything that shapes what a policy sees, does and is rewarded for.

    ``critic`` is what the value function sees beside the policy's observation, in training alone.
    """

    sim: SimConfig
    action: ActionConfig
    robot: RobotConfig
    terrain: TerrainConfig
    contact: ContactConfig
    backend: BackendConfig
    actuator: Term
    effect: tuple[Term, ...]
    command: Term
    reward: tuple[Term, ...]
    rand: tuple[Term, ...]
    observation: tuple[Term, ...]
    event: tuple[Term, ...]
    termination: tuple[Term, ...]
    curriculum: tuple[Term, ...]
    critic: tuple[Term, ...] = ()


@dataclass(frozen=True)
class ProcessConfig(Strict):
    """Settings at the top level of the YAML.

    Attributes:
        seed: seed of everything random.
        device: torch device of policy and update, ``auto`` for that of the environment, which is its backend's.
        devices: GPUs of this machine that share the robots and each minibatch; more than 1 needs backend=warp.
        torch_threads: threads of torch in an update, 0 for its own choice; a rollout takes one.
        resume: run folder to continue; nothing but iterations, checkpoints, threads, devices and backend may change.
        sweep: sweep folder to go on with: its jobs that are not done; launcher, threads and so on may change.
        start_from: run folder, or name of a shipped policy, whose weights a new run begins with.
        plugins: files and packages with terms of your own, such as [my_terms.py] (docs/extending.md).
    """

    seed: Annotated[int, Field(ge=0, le=2**32 - 1)]
    device: Annotated[str, one_of(r"auto|cpu|cuda(:\d+)?", "auto, cpu, cuda, or one of several as cuda:1")]
    torch_threads: physics.Threads
    resume: FolderName | None
    start_from: FolderName | None = None  # runs of older versions have none of these keys
    sweep: FolderName | None = None
    plugins: str | tuple[str, ...] = ()
    devices: Annotated[int, Field(ge=1, le=64)] = 1


@dataclass(frozen=True)
class TrainConfig:
    """One training run."""

    task: TaskConfig
    ppo: PPOConfig
    logger: LoggerConfig
    checkpoint: CheckpointConfig
    process: ProcessConfig
    eval: EvalDuring = BESIDE["eval"]
    video: VideoDuring = BESIDE["video"]
    stop: StopRule = BESIDE["stop"]
    estimator: EstimatorConfig = BESIDE["estimator"]
    schedule: Mapping[str, Ramp] = field(default_factory=dict)


class RewardSlots(BaseModel):
    """What a reward group reads beside the term's own parameters.

    Attributes:
        weight: factor of the term in the reward, per second.
    """

    model_config = STRICT
    weight: float


class ObservationSlots(BaseModel):
    """What an observation group reads beside the term's own parameters.

    Attributes:
        noise: half-width of the uniform noise added to the term.
        correlation_time: time in which the noise forgets, s: a first-order Gauss-Markov process of the same standard
            deviation (noise / sqrt(3)), as an estimator's error is one. 0: drawn anew in each step.
        history: policy steps whose values are observed, the newest first.
    """

    model_config = STRICT
    noise: NonNegative = 0.0
    correlation_time: NonNegative = 0.0
    history: Annotated[int, Field(ge=1, le=64)] = 1


class RandomizationSlots(BaseModel):
    """What a randomisation group reads beside the term's own parameters.

    Attributes:
        when: startup draws once per environment, reset at each of its resets.
    """

    model_config = STRICT
    when: Literal["startup", "reset"] = "reset"


class EffectSlots(BaseModel):
    """What an effect group reads beside the term's own parameters.

    Attributes:
        spread: half-widths of the uniform distributions from which each environment draws its parameters, once.
    """

    model_config = STRICT
    spread: dict[str, NonNegative] = {}


SECTIONS: dict[str, type] = {
    "sim": SimConfig,
    "action": ActionConfig,
    "robot": RobotConfig,
    "terrain": TerrainConfig,
    "contact": ContactConfig,
    "backend": CpuBackend,
    "ppo": PPOConfig,
    "logger": LoggerConfig,
    "checkpoint": CheckpointConfig,
    **{name: type(default) for name, default in BESIDE.items()},
}
"""Sections of the configuration that are one dataclass each (of the backend, one for each engine)."""

ENGINES = ("backend", "engine")
"""Groups of which a configuration uses one engine: the one that trains, and the one that evaluates."""

OF_OLDER_RUNS: dict[str, Any] = {"contact": MUJOCO_CONTACT, "critic": (), **BESIDE}
"""Parts that runs of older versions do not name, and what they were."""

ONE_TERM = ("actuator", "command")
"""Groups of which a configuration uses one member; its key ``term`` names it."""

MANY_TERMS: dict[str, type[BaseModel] | None] = {
    "reward": RewardSlots,
    "rand": RandomizationSlots,
    "observation": ObservationSlots,
    "critic": ObservationSlots,
    "effect": EffectSlots,
    "event": None,
    "termination": None,
    "curriculum": None,
}
"""Groups that are a mapping of terms, with the keys that the group reads beside each term's parameters."""

REGISTERED_AS = {"critic": "observation"}
"""Groups whose terms are those of another group."""


def _section(kind: type, settings: object, path: str) -> tuple[Any, list[str]]:
    if not isinstance(settings, Mapping):
        return None, [f"{path} = {settings!r}: must be a mapping"]
    try:
        return adapter(kind).validate_json(as_json(settings)), []
    except ValidationError as error:
        return None, explain(error, path, [f.name for f in fields(kind)])


def _terms(group: str, settings: object) -> tuple[tuple[Term, ...], list[str]]:
    if not isinstance(settings, Mapping):
        return (), [f"{group} = {settings!r}: must be a mapping of terms"]
    kind, slots = REGISTERED_AS.get(group, group), MANY_TERMS[group]
    bound = [bind(kind, key, value, f"{group}.{key}", slots) for key, value in settings.items()]
    return tuple(term for term, _ in bound if term), [p for _, problems in bound for p in problems]


def parse_parts(container: Mapping[str, object], wanted: tuple[str, ...]) -> tuple[dict[str, Any], list[str]]:
    """Validate the named parts of a composed configuration; return them by name, and the problems."""
    parts: dict[str, Any] = {}
    problems: list[str] = []
    for name in wanted:
        if name not in container and name in OF_OLDER_RUNS:
            parts[name] = OF_OLDER_RUNS[name]
            continue
        if name not in container:
            problems.append(f"{name}: required, but not given")
            continue
        settings = container[name]
        if name in SECTIONS or name in ENGINES:
            kind = SECTIONS.get(name, CpuBackend)
            if name in ENGINES and isinstance(settings, Mapping) and "name" in settings:
                if settings["name"] not in BACKENDS:
                    problems.append(unknown_name(f"{name}.name", str(settings["name"]), BACKENDS, "engine"))
                    continue
                kind = BACKENDS[settings["name"]]
            parts[name], complaints = _section(kind, settings, name)
        elif name in MANY_TERMS:
            parts[name], complaints = _terms(name, settings)
        elif not isinstance(settings, Mapping) or "term" not in settings:
            complaints = [f"{name}.term: required, but not given"]
        else:
            parts[name], complaints = bind(name, str(settings["term"]), settings, name)
        problems += complaints
    return parts, problems


def required_parts(container: Mapping[str, object]) -> dict[str, Any]:
    """Return every part of a configuration by name; raise ConfigError with every problem."""
    parts, problems = parse_parts(container, tuple(container))
    if problems:
        raise ConfigError(problems)
    return parts


def time_rules(sim: SimConfig) -> list[str]:
    """Return what is wrong with the periods of a simulation: each must be a whole multiple of the next shorter one."""
    problems = []
    for name, longer, unit, shorter in (
        ("policy_dt", sim.policy_dt, "physics_dt", sim.physics_dt),
        ("episode_s", sim.episode_s, "policy_dt", sim.policy_dt),
    ):
        ratio = longer / shorter
        if not math.isfinite(ratio) or ratio < 1 - 1e-9 or not math.isclose(ratio, round(ratio), rel_tol=1e-6):
            problems.append(f"sim.{name} = {longer}: must be a whole multiple of sim.{unit} = {shorter}")
    return problems


def _randomization_rules(terms: tuple[Term, ...]) -> list[str]:
    problems, setters = [], dict[str, str]()
    for term in terms:
        what = term.entry.traits.get("sets")
        if what in setters:
            problems.append(f"rand.{term.key}: sets the {what}, as rand.{setters[what]} does; use one of the two")
        elif what:
            setters[what] = term.key
        if term.entry.traits["kind"] == "state" and term.slots["when"] == "startup":
            problems.append(
                f"rand.{term.key}.when = 'startup': a random initial state is drawn at every reset; use reset"
            )
    return problems


def _cross_rules(parts: Mapping[str, Any]) -> list[str]:
    problems = []
    if actuator := parts.get("actuator"):
        problems += actuator_problems(actuator, parts.get("effect") or (), robot.JOINTS)
    if sim := parts.get("sim"):
        problems += time_rules(sim)
    if (ppo := parts.get("ppo")) and ppo.num_envs * ppo.steps % ppo.minibatches:
        problems.append(
            f"ppo.minibatches = {ppo.minibatches}: must divide ppo.num_envs x ppo.steps = {ppo.num_envs * ppo.steps}"
        )
    if ppo and not ppo.learning_rate_range[0] <= ppo.learning_rate <= ppo.learning_rate_range[1]:
        problems.append(
            f"ppo.learning_rate = {ppo.learning_rate}: must lie in ppo.learning_rate_range = "
            f"{list(ppo.learning_rate_range)}"
        )
    if ppo and ppo.symmetry:
        for group in ("observation", "critic"):
            problems += mirror.problems(group, parts.get(group) or ())
    if (estimator := parts.get("estimator")) and estimator.latent and not parts.get("critic"):
        problems.append("estimator: learns what the critic alone sees; use critic=privileged, or estimator=none")
    if "observation" in parts and not parts["observation"]:
        problems.append("observation: at least one term is required")
    terrain: Any = parts.get("terrain")
    for rule in (parts.get("curriculum") or ()) if terrain else ():
        top, start = terrain.rows - 1, rule.parameters.get("start_level_max", 0)
        if terrain.kind == "flat":
            problems.append(f"curriculum.{rule.key}: needs graded ground; use terrain=rough, or curriculum=none")
        elif start > top:
            problems.append(
                f"curriculum.{rule.key}.start_level_max = {start}: terrain.rows = {top + 1} allows up to {top}"
            )
    return problems + _randomization_rules(parts.get("rand") or ())


def parse_task(container: Mapping[str, object]) -> TaskConfig:
    """Load the plugins of a composed configuration, validate its task; raise ConfigError with every problem."""
    plugins.use(container.get(plugins.KEY))
    wanted = tuple(f.name for f in fields(TaskConfig))
    parts, problems = parse_parts(container, wanted)
    problems += _cross_rules(parts)
    if problems:
        raise ConfigError(problems)
    return TaskConfig(**parts)


def parse_train(container: Mapping[str, object]) -> TrainConfig:
    """Load the plugins of a training configuration and validate it; raise ConfigError with every problem."""
    plugins.use(container.get(plugins.KEY))
    task_names = tuple(f.name for f in fields(TaskConfig))
    others = ("ppo", "logger", "checkpoint", *BESIDE)
    top = tuple(f.name for f in fields(ProcessConfig))
    known = (*task_names, *others, *top, "schedule")
    problems = [
        f"{unknown_name(key, key, known, 'key')} (given: {value!r})"
        for key, value in container.items()
        if key not in known
    ]
    parts, of_parts = parse_parts(container, (*task_names, *others))
    process, of_process = _section(ProcessConfig, {k: container[k] for k in top if k in container}, "")
    ramps, of_ramps = schedule.parse(container.get("schedule", {}), parts)
    problems += of_parts + of_process + _cross_rules(parts) + of_ramps
    stop, during = parts.get("stop"), parts.get("eval")
    if stop and during and (stop.figure or "").startswith(EVALUATED) and not during.every:
        problems.append(f"stop.figure = {stop.figure!r}: is of the evaluations beside a training; set eval.every")
    if problems:
        raise ConfigError(problems)
    task = TaskConfig(**{name: parts[name] for name in task_names})
    return TrainConfig(task=task, **{name: parts[name] for name in others}, process=process, schedule=ramps)
