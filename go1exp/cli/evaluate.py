"""``go1exp eval``."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from go1exp.cli import subjects
from go1exp.cli.app import App, announce, parse, spinner
from go1exp.cli.places import writable
from go1exp.cli.subjects import Named, agent
from go1exp.config.choices import config_folder, load
from go1exp.config.schema import settings as schema
from go1exp.config.schema.physics import PhysicsStep
from go1exp.config.schema.registry import ConfigError, Count, Duration, FolderName, NonNegative, Speed, Term, bind_list

if TYPE_CHECKING:
    from go1exp.config.schema.physics import BackendConfig
    from go1exp.evaluate.agents import Agent
    from go1exp.evaluate.controller.settings import MpcSettings
    from go1exp.evaluate.protocol.base import Chosen
    from go1exp.evaluate.protocol.playing import Rates, Result


@schema.settings
class Grid:
    """Commanded velocities.

    Attributes:
        x: forward velocities, m/s.
        y: velocities to the left, m/s.
        yaw: yaw rates, rad/s.
        cross: every combination of the three axes; false: one axis at a time, the others zero.
    """

    x: tuple[Speed, ...]
    y: tuple[Speed, ...]
    yaw: tuple[Speed, ...]
    cross: bool


@schema.settings
class EvalSettings:
    """``conf/eval.yaml``.

    Attributes:
        controller: what moves the robots: policy, the one of run or policy, or mpc.
        run: run folder to evaluate; or give policy.
        policy: name of a policy that comes with the package, such as paper, in place of run.
        bundle: file that go1exp export wrote, in place of run; not for protocol=grid.
        checkpoint: file of the run; null takes the newest.
        grid: commanded velocities.
        episodes: episodes of each command, all at once.
        seconds: length of an episode, s.
        settle_s: time at the start of an episode that does not count for tracking, s.
        noise: add the observation noise of training.
        randomize: randomise robots and starts as in training; false takes the nominal robot.
        push: push the robot as in training.
        train_ground: use the ground of training; false is flat.
        trunk_velocity: what the policy sees of it, exact, or estimated by the robot's filter from its sensors.
        policy_dt: another period of the policy, s; null keeps that of training.
        physics_dt: another physics step, s, such as 0.00125 for policy_dt=0.0025; null keeps that of training.
        measures: gait and contact measures by name (go1exp list measure), [] for none; null takes all of them. With
            parameters as {slip_share: {speed: 0.1}}.
        delay_margin: also run the grid with targets delayed by 10, 20, 30 and 40 ms, until a robot falls.
        seed: seed of everything random.
        out: JSON file; null writes eval.json in the run folder (of a shipped policy paper_eval.json here).
        folder: for the files of other protocols than the grid; null takes protocols in the run folder (of a shipped
            policy paper_protocols here).
    """

    controller: Any = None
    run: FolderName | None
    policy: str | None
    bundle: str | None
    checkpoint: str | None
    grid: Grid
    episodes: Count
    seconds: Duration
    settle_s: NonNegative
    noise: bool
    randomize: bool
    push: bool
    train_ground: bool
    trunk_velocity: Literal["exact", "estimated"]
    policy_dt: Annotated[float, Field(gt=0, le=0.1)] | None
    physics_dt: PhysicsStep | None
    measures: Any
    delay_margin: bool
    seed: Annotated[int, Field(ge=0)]
    out: str | None
    folder: str | None

    def __post_init__(self) -> None:
        """Check what concerns two settings."""
        if self.settle_s >= self.seconds:
            raise ValueError(f"settle_s = {self.settle_s}: must be shorter than seconds = {self.seconds}")


RATES = "rate"  # kind of protocol that only policies can play

GRID_ONLY = (
    *("grid", "episodes", "seconds", "settle_s", "noise", "randomize", "push", "train_ground", "trunk_velocity"),
    *("measures", "delay_margin", "out"),
)
"""Keys of ``go1exp eval`` that are the grid's."""


def chosen_protocols(container: dict[str, object], plain: dict[str, Any]) -> tuple[list[Chosen], bool]:
    """Return the protocols of a configuration, and whether the grid is one; raise ConfigError with every problem.

    ``plain`` is ``conf/eval.yaml`` as it stands: changed keys of the grid are a problem where it is not played.
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
    equivalent = {"episodes": "robots", "grid": "claims"}.get(key, key)
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
    """Raise ConfigError where rates cannot vary: of a ``controller`` with its own, or with another ``policy_dt``, s."""
    kinds = [c.kind for c in protocols]
    if controller is not None and set(kinds) == {RATES}:
        raise ConfigError([f"protocol={RATES}: varies the rate of a policy; {controller} has one of its own"])
    if policy_dt is not None and RATES in kinds:
        raise ConfigError([f"policy_dt = {policy_dt:g}: protocol={RATES} has rates of its own, rates_hz"])


def playable(protocols: Sequence[Chosen], agent: Agent) -> list[Chosen]:
    """Return the protocols that an agent can play, and print which one of several it cannot."""
    if agent.senses and any(c.kind == RATES for c in protocols):
        print(f"{RATES}: not played, it varies the rate of a policy; {agent.label} has one of its own\n")
        return [c for c in protocols if c.kind != RATES]
    return list(protocols)


def writable_file(out: Path) -> None:
    """Make the folder of a file for results, but of no device or pipe; raise ConfigError if it cannot be written."""
    if out.exists() and not out.is_file():
        return
    try:
        writable(str(out.resolve().parent))
    except ConfigError as error:
        reason = error.problems[0].partition(": ")[2]
        raise ConfigError([f"out = {str(out)!r}: its folder {reason}"]) from None


def note_replaced(folder: Path, files: Sequence[str], other: str = "folder=NAME") -> None:
    """Print which results of an earlier call the new ones will replace, and the setting that keeps them."""
    present = [name for name in files if (folder / name).is_file()]
    if present:
        print(f"note: {folder} holds {', '.join(present)} of an earlier call; new ones replace them (or: {other})")


def play_protocols(
    protocols: Sequence[Chosen], subject: Named, folder: Path, other: dict[str, object], rates: Rates
) -> None:
    """Play protocols one after the other, write what came of each, and print the verdicts."""
    from go1exp.evaluate.protocol.pages import write
    from go1exp.evaluate.protocol.playing import play as played
    from go1exp.evaluate.protocol.playing import refuse_lengths

    drives = agent(subject, other)
    refuse(protocols, drives)
    protocols = playable(protocols, drives)
    refuse_lengths(protocols, drives, rates)
    writable(str(folder), "folder")
    note_replaced(folder, [f"{c.key}.json" for c in protocols])
    for k, c in enumerate(protocols):
        show = spinner(1, f"{c.key} ({k + 1} of {len(protocols)})")
        result = played(c, drives, rates, {"robot": subjects.robot_as_data(other)}, show)
        files = write(result, folder)
        print("\n".join(result_lines(result)))
        print(f"  written to {', '.join(map(str, files))}\n", flush=True)


def result_lines(result: Result) -> list[str]:
    """Return what a terminal shows of a result."""
    from go1exp.base.report.table import interval_text
    from go1exp.evaluate.protocol.claims import limits
    from go1exp.evaluate.protocol.pages import condition_text, falls

    text_lines = [f"{result.chosen.key}: {result.label}, {result.seconds:.0f} s; {falls(result)}"]
    for v in result.verdicts:
        value = interval_text(v.figure.estimate, v.figure.low, v.figure.high)
        where = condition_text(v.condition)
        text_lines.append(f"  {v.word:12} {v.claim.quantity} {value}, {limits(v.claim)}, n {v.figure.n} ({where})")
    return [*text_lines, *(f"  note: {note}" for note in result.played.notes)]


def _measures(given: object) -> list[Term]:
    from go1exp.mdp.measures import every_measure

    if given is None:
        return every_measure()
    if not isinstance(given, list):
        raise ConfigError([f"measures = {given!r}: must be a list, such as [stride_rate], or null for all of them"])
    return bind_list("measure", given, "measures")


@dataclass(frozen=True)
class _Conditions:
    """Conditions of an evaluation: the robot's parts that differ, the engine, another controller than a policy."""

    other: dict[str, object]
    engine: BackendConfig
    controller: MpcSettings | None


def _protocols(settings: EvalSettings, protocols: list[Chosen], conditions: _Conditions) -> None:
    refuse_rates(protocols, conditions.controller.name if conditions.controller else None, settings.policy_dt)
    subject = subjects.subject_of(settings, conditions.controller, "protocols")
    announce(f"evaluating {subject.label}")
    folder = Path(settings.folder or subject.folder)
    if folder.exists() and not folder.is_dir():
        raise ConfigError([f"folder = {str(folder)!r}: is a file"])
    from go1exp.evaluate.protocol.playing import Rates

    rates = Rates(settings.seed, settings.policy_dt, settings.physics_dt, conditions.engine)
    play_protocols(protocols, subject, folder, conditions.other, rates)


def _task(container: dict[str, object]) -> None:
    engine, container = subjects.split_engine(container)
    other, container = subjects.split_robot(container)
    choice = {"protocol": container.pop("protocol")}
    settings = parse(EvalSettings, container)
    protocols, grid_too = chosen_protocols({**container, **choice}, load(config_folder() / "eval.yaml"))
    conditions = _Conditions(other, engine, subjects.chosen_controller(settings.controller))
    measures = _measures(settings.measures)
    if conditions.controller is not None and settings.checkpoint:
        raise ConfigError([f"checkpoint = {settings.checkpoint!r}: is of a policy; controller=mpc has none"])
    if not protocols and settings.folder is not None:
        raise ConfigError([f"folder = {settings.folder!r}: is of other protocols; the file of protocol=grid is out="])
    subject = None
    if grid_too:
        _check_grid(settings)
        subject = subjects.subject_of(settings, conditions.controller, "eval.json", settings.out)
        out = subject.folder
        writable_file(out)
        note_replaced(out.parent, [out.name, out.with_suffix(".parquet").name], "out=FILE")
    if protocols:
        _protocols(settings, protocols, conditions)
    if subject:
        _grid(settings, measures, conditions, subject)


def _check_grid(settings: EvalSettings) -> None:
    if settings.bundle is not None:
        raise ConfigError([f"bundle = {settings.bundle!r}: protocol=grid takes run or policy; choose another protocol"])
    grid_is_empty = not all((settings.grid.x, settings.grid.y, settings.grid.yaw))
    if settings.grid.cross and grid_is_empty:
        raise ConfigError(["grid: with cross=true every axis needs at least one value, such as grid.yaw=[0.0]"])


def _grid(settings: EvalSettings, measures: list[Term], conditions: _Conditions, subject: Named) -> None:
    show = spinner(1, "evaluating", at_once=True)
    from go1exp.config.schema.settings import subset
    from go1exp.evaluate import criteria, table
    from go1exp.evaluate.quantities import write as write_report
    from go1exp.evaluate.rollout import EvalConfig, delay_margin, evaluate, grid
    from go1exp.train.policy import load_run

    policy, make, run = None, None, subject.run
    assert run is not None
    if conditions.controller is None:
        of_run, policy, about = load_run(run, subject.checkpoint)
        task = of_run.task
    else:
        task = subjects.task_of_run(run)
        make = subjects.controller_maker(conditions.controller, task)
        about = {"controller": dataclasses.asdict(conditions.controller)}
    commands = grid(settings.grid.x, settings.grid.y, settings.grid.yaw, settings.grid.cross)
    config = subset(EvalConfig, settings, commands=commands, engine=conditions.engine)
    task = subjects.with_robot(task, conditions.other)
    report = {
        "policy": about,
        "robot": subjects.robot_as_data(conditions.other),
        **evaluate(task, policy, config, show, measures, make),
    }
    if settings.delay_margin:
        falls = report["distinct_falls"]
        report["delay_margin"] = delay_margin(task, policy, config, falls, spinner(1, "with a delay"), make)
    report["criteria"] = [dataclasses.asdict(verdict) for verdict in criteria.evaluated(report)]
    write_report(report, subject.folder)
    print(table.text(report))
    print(f"\nwritten to {subject.folder}")


APP = App("eval", _task, EvalSettings)
